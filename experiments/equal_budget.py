r"""Searches at equal cost, and whether a lower objective is a better shape (not in the paper).

    python experiments/equal_budget.py --test.meshes cad_chairs/

Every search starts from the encoder's code and may spend the same number of decoder calls. A
candidate is one call. A gradient, a forward and a backward pass, takes the measured time of three
calls and counts as three; so does each evaluation of a line search, which needs gradients too. IoU
and objective belong to the best code found within a number of calls. Seconds are measured for a
batch of eight chairs and divided evenly over chairs and calls. IPOP represents BIPOP as well: both
equal CMA-ES up to the first restart. Steps and sigma0 are the best values of step_size.py.

8 procedural chairs and 8 CAD seats, seen by 4 frames as iou_by_frames.py sees them.

Results: experiments/results/equal_budget.json, .png and .svg; finished chairs are kept.
Time: 16 minutes on two cores.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Array, Float, Int
from scipy.stats import spearmanr

import study
from figures import LINES, PAGE, interval, save_column
from jaxshape.geometry.overlap import iou
from jaxshape.model.shapes import ShapePrior, decode
from jaxshape.model.weights import fingerprint, load_prior
from jaxshape.report.figures import tidy
from jaxshape.report.palette import BLUE, GREY, INK, PINK, RED, SKY
from jaxshape.results.journal import Journal
from jaxshape.search.config import RefineConfig
from jaxshape.search.methods import build_refiner
from jaxshape.search.methods.hybrid import POLISH, polished
from jaxshape.search.reconstruction import reconstruct
from jaxshape.search.refiner import Refiner, StopReason
from study import (
    TUNED,
    Claim,
    Contestant,
    TestSet,
    column,
    compare,
    conclude,
    groups,
    mean_interval,
)

GRADIENT = 3
"""Decoder calls that a gradient counts as: 3.75 ms where a candidate takes 1.25 ms."""

DRAWN: dict[str, dict[str, Any]] = {
    "CMA-ES": LINES["CMA-ES"],
    "CMA-ES, 64": {"color": SKY, "dashes": ()},
    "CMA-ES, 256": {"color": SKY, "dashes": (2, 1)},
    "IPOP": {"color": BLUE, "dashes": (1, 1)},
    "separable": {"color": PINK, "dashes": ()},
    "hybrid, L-BFGS": {"color": RED, "dashes": ()},
    "hybrid, Adam": {"color": RED, "dashes": (2, 1)},
    "gradient descent": LINES["gradient descent"],
    "Adam": LINES["Adam"],
    "L-BFGS": {"color": INK, "dashes": (3, 1)},
}
GRADIENTS = ("gradient descent", "Adam", "L-BFGS")


@dataclass(frozen=True)
class Config(study.Config):
    """Settings of the experiment."""

    test: TestSet = TestSet(chairs=8, seats=8)
    frames: int = 4
    budgets: tuple[int, ...] = (32, 64, 128, 256, 512, 768, 1024, 1536, 2048)
    """Decoder calls after which shapes are scored; the last is the budget of every search."""
    searches: tuple[str, ...] = tuple(DRAWN)
    """Searches to compare, including CMA-ES."""


def main(config: Config) -> None:
    few = ("CMA-ES", "separable", "gradient descent", "Adam")
    config = config.reduced(budgets=(17, 34), searches=few)
    journal = run(config)
    plot(journal, config)


def run(config: Config) -> Journal:
    """Give every search its budget on every chair, and write the results."""
    prior = load_prior(config.weights)
    settings = {
        "frames": config.frames,
        "budgets": config.budgets,
        "gradient": GRADIENT,
        "weights": fingerprint(prior),
    }
    journal = Journal(config.results / "equal_budget.json", settings)
    contestants = {
        name: contestant(search, config.budgets)
        for name, search in searches(prior, config.budgets[-1]).items()
        if name in config.searches
    }
    compare(contestants, prior, config.test, (config.frames,), journal, at_a_time=8)
    conclude(journal, claims(journal, config), summary=summary(journal, config))
    return journal


# ------------------------------------------------------------------ searches with a budget


class Search(NamedTuple):
    """A refiner, and the cost of its evaluations in decoder calls."""

    refiner: Refiner
    iterations: int
    """Iterations that the budget allows."""
    candidates: int
    """Number of evaluations at the beginning that need no gradient."""
    space: Literal["whitened", "raw"]

    def calls(self, evaluations: Int[Array, "..."]) -> Int[Array, "..."]:
        """Decoder calls spent, without the encoder's call at the start."""
        gradients = jnp.maximum(evaluations - 1 - self.candidates, 0)
        return evaluations - 1 + (GRADIENT - 1) * gradients


def searches(prior: ShapePrior, budget: int) -> dict[str, Search]:
    """All compared searches, each with `budget` decoder calls."""

    def built(method: str, **settings: Any) -> Refiner:
        return build_refiner(method, len(prior.code_mean), RefineConfig(**settings))

    def population(size: int, method: str = "cma") -> Search:
        iterations = max(1, budget // size)
        refiner = built(method, population=size, sigma0=TUNED["CMA-ES"][1].sigma0)
        return Search(refiner, iterations, size * iterations, "raw")

    def descent(method: str, step_size: Any = None, space: Any = "whitened") -> Search:
        refiner = built(method, tolerance=0.0, step_size=step_size)
        return Search(refiner, budget // GRADIENT, 0, space)

    def hybrid(method: str) -> Search:
        """CMA-ES for its usual share of the budget, then the gradient."""
        first = population(17)
        iterations = round((1 - POLISH) * first.iterations)
        candidates = 17 * iterations
        return Search(
            polished(first.refiner, descent(method).refiner, iterations),
            iterations + (budget - candidates) // GRADIENT,
            candidates,
            first.space,
        )

    return {
        "CMA-ES": population(17),
        "CMA-ES, 64": population(64),
        "CMA-ES, 256": population(256),
        "IPOP": population(17, "cma:ipop"),
        "separable": population(17, "evosax:Sep_CMA_ES"),
        "hybrid, L-BFGS": hybrid("gradient:lbfgs"),
        "hybrid, Adam": hybrid("gradient:adam"),
        "gradient descent": descent("gradient", TUNED["gradient descent"][1].step_size, "raw"),
        "Adam": descent("gradient:adam"),
        "L-BFGS": descent("gradient:lbfgs"),
    }


def within(budget: int, search: Search) -> Refiner:
    """The refiner, stopped once its budget is spent; its last line search may pass it."""

    def step(key, state, objective):
        state, trace = search.refiner.step(key, state, objective)
        spent = search.calls(trace.evaluations) >= budget
        stop = jnp.where(spent & (state.stop == StopReason.RUNNING), StopReason.BUDGET, state.stop)
        return state._replace(stop=stop), trace

    return Refiner(search.refiner.init, step)


def contestant(search: Search, budgets: tuple[int, ...]) -> Contestant:
    """IoU and objective of the encoder's code, and of the best code within each budget."""
    refiner = within(budgets[-1], search)
    config = RefineConfig(iterations=search.iterations, space=search.space)

    def contest(keys, prior, case):
        F, M = case.grids.occupied, case.grids.occluded
        found = reconstruct(keys, prior, F, M, refiner, config)
        assert found.trace is not None and found.path is not None and found.stop is not None
        calls = search.calls(found.trace.evaluations)  # after each iteration
        iterations = jnp.sum(calls[:, None] <= jnp.array((0, *budgets))[:, None], axis=-1)
        codes = _after(iterations, found.first_code, found.path)
        return {
            "iou": iou(decode(prior, codes) > 0, case.surface[:, None]),
            "objective": _after(iterations, found.first_objective, found.trace.best_loss),
            "calls": calls[:, -1],
            "ended": found.stop != StopReason.BUDGET,  # by its own stopping criterion
        }

    return contest


def _after(
    iterations: Int[Array, "case budget"],
    first: Float[Array, "case ..."],
    later: Float[Array, "case iteration ..."],
) -> Float[Array, "case budget ..."]:
    """The value after each number of iterations; the first value after no iteration."""
    values = jnp.concatenate([first[:, None], later], axis=1)
    return values[jnp.arange(len(values))[:, None], iterations]


# ------------------------------------------------------------------ evaluation of the rows


def curve(journal: Journal, config: Config, group: str | None, name: str, score: str) -> np.ndarray:
    """A score of a search for each chair: first of the encoder, then within each budget."""
    return column(journal, group, config.frames, name, score)


def seconds_per_call(journal: Journal, config: Config, name: str) -> float:
    """The median over chairs of the seconds of one decoder call."""
    rows = [row[str(config.frames)][name] for row in journal.rows.values()]
    return float(np.median([row["seconds"] / max(row["calls"], 1) for row in rows]))


def shared_seconds(journal: Journal, config: Config) -> float:
    """The time that the fastest search needs for its whole budget."""
    return config.budgets[-1] * min(
        seconds_per_call(journal, config, name) for name in config.searches
    )


def at_time(
    journal: Journal, config: Config, group: str | None, name: str, score: str, seconds: float
) -> np.ndarray:
    """A score by chair after some seconds, interpolated between budgets."""
    calls = seconds / seconds_per_call(journal, config, name)
    curves = curve(journal, config, group, name, score)
    return np.array([np.interp(calls, (0, *config.budgets), values) for values in curves])


def agreement(
    journal: Journal, config: Config, group: str | None, *, finished: bool = False
) -> np.ndarray:
    """Rank correlation by chair between a low objective and a high IoU.

    It is taken over all searches and budgets, with equal codes counted once, or, with `finished`,
    over the searches at the whole budget. A chair with fewer than three codes to rank is left out.
    """
    found = np.stack(
        [
            np.stack([curve(journal, config, group, name, s) for name in config.searches], axis=1)
            for s in ("objective", "iou")
        ],
        axis=-1,
    )  # chair, search, budget, score
    pairs = found[:, :, -1] if finished else found.reshape(len(found), -1, 2)
    distinct = [np.unique(chair, axis=0) for chair in pairs]
    ranked = [spearmanr(-x[:, 0], x[:, 1])[0] for x in distinct if len(x) > 2]
    return np.nan_to_num(np.array(ranked))


def last_half(
    journal: Journal, config: Config, group: str | None, name: str, score: str
) -> np.ndarray:
    """The change in the second half of the budget, by chair."""
    middle = 1 + int(np.searchsorted(config.budgets, config.budgets[-1] / 2))
    values = curve(journal, config, group, name, score)
    return values[:, -1] - values[:, middle]


def summary(journal: Journal, config: Config) -> dict[str, Any]:
    """Means over chairs: `summary[group]["calls"][score][search]`, a number for each budget."""
    whole = shared_seconds(journal, config)
    times = [whole / 8, whole / 4, whole / 2, whole]

    def rounded(values: Any) -> list[float]:
        return [round(float(x), 4) for x in np.atleast_1d(values)]

    def table(values: Callable[[str, str], Any]) -> dict[str, Any]:
        return {
            s: {name: values(name, s) for name in config.searches} for s in ("iou", "objective")
        }

    def of(group: str) -> dict[str, Any]:
        return {
            "calls": table(
                lambda name, s: rounded(curve(journal, config, group, name, s).mean(axis=0))
            ),
            "seconds": table(
                lambda name, s: rounded(
                    [at_time(journal, config, group, name, s, t).mean() for t in times]
                )
            ),
            "second half": table(
                lambda name, s: mean_interval(last_half(journal, config, group, name, s))
            ),
            "rank correlation": rounded(agreement(journal, config, group)),
        }

    return {
        "calls": [0, *config.budgets],
        "seconds": rounded(times),
        "milliseconds per call": {
            name: round(1000 * seconds_per_call(journal, config, name), 3)
            for name in config.searches
        },
    } | {group: of(group) for group in groups(journal)}


def claims(journal: Journal, config: Config) -> list[Claim]:
    """Claims of the paper, and further ones, over the chairs of all groups."""
    budget, whole = config.budgets[-1], shared_seconds(journal, config)

    def at_calls(name: str, score: str = "iou") -> np.ndarray:
        return curve(journal, config, None, name, score)[:, -1]

    def in_seconds(name: str) -> np.ndarray:
        return at_time(journal, config, None, name, "iou", whole)

    def ahead(rival: str) -> np.ndarray:
        return at_calls("CMA-ES") - at_calls(rival)

    def over(rivals: Sequence[str]) -> str:
        return ", ".join(f"{mean_interval(ahead(name))} over {name}" for name in rivals)

    def holds(rivals: Sequence[str]) -> str:
        beaten = [name for name in rivals if ahead(name).mean() > 0]
        some = f"than {' and '.join(beaten)}" if beaten else "no"
        return "yes" if beaten == [*rivals] else some

    gradients, populations = (
        [name for name in names if name in config.searches]
        for names in (GRADIENTS, ("CMA-ES, 64", "CMA-ES, 256"))
    )
    ended = column(journal, None, config.frames, "CMA-ES", "ended")
    lowest = min(config.searches, key=lambda name: at_calls(name, "objective").mean())
    objective, gain = (
        last_half(journal, config, None, lowest, score) for score in ("objective", "iou")
    )
    every, final = (agreement(journal, config, None, finished=end) for end in (False, True))
    return [
        Claim(
            "Sec. 3.3",
            "CMA-ES finds better shapes than gradient descent",
            f"IoU of CMA-ES at {budget} decoder calls " + over(gradients),
            holds(gradients),
        ),
        _ranked(config.searches, f"Which search is best after {budget} decoder calls?", at_calls),
        _ranked(config.searches, f"Which search is best after {whole:.1f} s a chair?", in_seconds),
        Claim(
            "beyond",
            "Populations of 17 are better than larger populations in fewer iterations",
            f"IoU {over(populations)}",
            holds(populations),
        ),
        Claim(
            "beyond",
            "Restarts help",
            f"CMA-ES stops by itself within {budget} calls on {ended.sum()} of {len(ended)} chairs",
            "no search to restart"
            if not ended.any()
            else "yes"
            if ahead("IPOP").mean() < 0
            else "no",
        ),
        Claim(
            "beyond",
            "A lower objective is a better shape",
            f"Rank correlation by chair {mean_interval(every)} over all searches and budgets,"
            f" {mean_interval(final)} among finished searches",
            "along a search"
            if every.mean() > 0.5 > final.mean()
            else "yes"
            if final.mean() > 0.5
            else "no",
        ),
        Claim(
            "beyond",
            "IoU still rises in the second half of the best search",
            f"Change in the second half of {lowest}: objective {objective.mean():+.4f}, IoU"
            f" {mean_interval(gain)}; IoU falls on {(gain < 0).sum()} of {len(gain)} chairs",
            "yes" if interval(gain)[0] > 0 else "no",
        ),
    ]


def _ranked(searched: Sequence[str], question: str, scores: Callable[[str], np.ndarray]) -> Claim:
    """The searches by their mean IoU."""
    ranked = sorted(searched, key=lambda name: -scores(name).mean())
    order = ", ".join(f"{name} {scores(name).mean():.3f}" for name in ranked)
    lead = mean_interval(scores(ranked[0]) - scores("CMA-ES"))
    return Claim(
        "beyond", question, f"IoU: {order}. Lead of the first over CMA-ES: {lead}", ranked[0]
    )


# ------------------------------------------------------------------ figure


def plot(journal: Journal, config: Config) -> None:
    """IoU and objective by decoder calls, and one against the other; a row for each group."""

    def means(group: str, name: str, score: str) -> np.ndarray:
        return curve(journal, config, group, name, score).mean(axis=0)

    def draw(figure: Any) -> None:
        found = groups(journal)
        for row, group in zip(figure.subplots(len(found), 3, squeeze=False), found, strict=True):
            for name in config.searches:
                line = DRAWN[name]
                shape, objective = (means(group, name, score) for score in ("iou", "objective"))
                row[0].plot(config.budgets, shape[1:], label=name, **line)
                row[1].plot(config.budgets, objective[1:], **line)
                row[2].plot(objective, shape, marker=".", markersize=4, linewidth=0.8, **line)
            for axes, score in zip(row, ("iou", "objective"), strict=False):
                axes.axhline(means(group, "CMA-ES", score)[0], color=GREY, linewidth=0.8)
                axes.set(xscale="log", xlabel="decoder calls")
                ticks = [
                    k for k in config.budgets if config.budgets[-1] in (k, 4 * k, 16 * k, 64 * k)
                ]
                axes.set_xticks(ticks, [str(k) for k in ticks])
                axes.minorticks_off()
            count = len(curve(journal, config, group, "CMA-ES", "iou"))
            row[0].set(title=f"{count} {group} chairs", ylabel="IoU")
            row[1].set(ylabel="objective")
            row[2].set(xlabel="objective", ylabel="IoU")
            row[2].invert_xaxis()
            for axes in row:
                tidy(axes)
        figure.legend(
            *row[0].get_legend_handles_labels(), frameon=False, ncols=5, loc="outside lower center"
        )

    save_column(
        config.results / "equal_budget", draw, height=0.6 + 2.0 * len(groups(journal)), width=PAGE
    )


if __name__ == "__main__":
    main(tyro.cli(Config))
