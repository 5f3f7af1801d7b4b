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

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Array, Float, Int
from scipy.stats import spearmanr

import study
from figures import LINES, PAGE, save_column
from jaxshape.geometry.overlap import iou
from jaxshape.model.shapes import ShapePrior, decode
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
    Contestant,
    TestSet,
    column,
    compare,
    groups,
    mean_low_high,
    rounded,
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
Curve = Float[np.ndarray, "chair budget"]


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
    prior, journal = config.begin(
        "equal_budget", frames=config.frames, budgets=config.budgets, gradient=GRADIENT
    )
    contestants = {
        name: contestant(search, config.budgets)
        for name, search in searches(prior, config.budgets[-1]).items()
        if name in config.searches
    }
    compare(contestants, prior, config.test, (config.frames,), journal, at_a_time=8)
    journal.write({"summary": summary(journal, config)})
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


def curves(journal: Journal, config: Config, group: str | None, score: str) -> dict[str, Curve]:
    """A score of every search: first of the encoder, then within each budget."""
    return {name: column(journal, group, config.frames, name, score) for name in config.searches}


def seconds_per_call(journal: Journal, config: Config) -> dict[str, float]:
    """The median over chairs of the seconds of one decoder call, for every search."""
    rows = [row[str(config.frames)] for row in journal.rows.values()]
    return {
        name: float(np.median([row[name]["seconds"] / max(row[name]["calls"], 1) for row in rows]))
        for name in config.searches
    }


def agreement(objective: dict[str, Curve], shape: dict[str, Curve], finished: bool) -> np.ndarray:
    """Rank correlation by chair between a low objective and a high IoU.

    It is taken over all searches and budgets, with equal codes counted once, or, with `finished`,
    over the searches at the whole budget. A chair with fewer than three codes to rank is left out.
    """
    found = np.stack([np.stack([*one.values()], axis=1) for one in (objective, shape)], axis=-1)
    pairs = found[:, :, -1] if finished else found.reshape(len(found), -1, 2)
    distinct = [np.unique(chair, axis=0) for chair in pairs]
    ranked = [spearmanr(-x[:, 0], x[:, 1])[0] for x in distinct if len(x) > 2]
    return np.nan_to_num(np.array(ranked))


def summary(journal: Journal, config: Config) -> dict[str, Any]:
    """Figures of each search, over the chairs of each group and of all groups.

    Means are given within each budget, and after shares of the time in which the fastest search
    spends its whole budget, interpolated between budgets. Leads are those over CMA-ES at the end.
    """
    budgets, half = (0, *config.budgets), np.searchsorted(config.budgets, config.budgets[-1] / 2)
    per_call = seconds_per_call(journal, config)
    times = config.budgets[-1] * min(per_call.values()) / np.array([8, 4, 2, 1])

    def after_time(name: str, curve: Curve) -> Curve:
        return np.array([np.interp(times / per_call[name], budgets, values) for values in curve])

    def of(group: str | None) -> dict[str, Any]:
        found = {score: curves(journal, config, group, score) for score in ("iou", "objective")}
        timed = {
            score: {name: after_time(name, curve) for name, curve in by_name.items()}
            for score, by_name in found.items()
        }
        shape = found["iou"]
        ended = column(journal, group, config.frames, "CMA-ES", "ended")
        return {
            "calls": by_search(found, lambda x: rounded(x.mean(axis=0))),
            "seconds": by_search(timed, lambda x: rounded(x.mean(axis=0))),
            "second half": by_search(found, lambda x: mean_low_high(x[:, -1] - x[:, 1 + half])),
            "falls in the second half": {
                name: int((x[:, -1] < x[:, 1 + half]).sum()) for name, x in shape.items()
            },
            "lead": {
                name: {
                    "calls": mean_low_high(x[:, -1] - shape["CMA-ES"][:, -1]),
                    "seconds": mean_low_high((timed["iou"][name] - timed["iou"]["CMA-ES"])[:, -1]),
                }
                for name, x in shape.items()
            },
            "rank correlation": {
                "all": mean_low_high(agreement(found["objective"], shape, finished=False)),
                "finished": mean_low_high(agreement(found["objective"], shape, finished=True)),
            },
            "CMA-ES stops by itself": int(ended.sum()),
        }

    return {
        "calls": budgets,
        "seconds": rounded(times),
        "milliseconds per call": {name: rounded(1000 * s) for name, s in per_call.items()},
    } | {group or "all": of(group) for group in (*groups(journal), None)}


def by_search(found: dict[str, dict[str, Curve]], figure: Callable[[Curve], Any]) -> dict[str, Any]:
    return {
        score: {name: figure(curve) for name, curve in by_name.items()}
        for score, by_name in found.items()
    }


# ------------------------------------------------------------------ figure


def plot(journal: Journal, config: Config) -> None:
    """IoU and objective by decoder calls, and one against the other; a row for each group."""

    def draw(figure: Any) -> None:
        found = groups(journal)
        for row, group in zip(figure.subplots(len(found), 3, squeeze=False), found, strict=True):
            shapes, objectives = (
                curves(journal, config, group, score) for score in ("iou", "objective")
            )
            for name in config.searches:
                line = DRAWN[name]
                shape, objective = (x[name].mean(axis=0) for x in (shapes, objectives))
                row[0].plot(config.budgets, shape[1:], label=name, **line)
                row[1].plot(config.budgets, objective[1:], **line)
                row[2].plot(objective, shape, marker=".", markersize=4, linewidth=0.8, **line)
            for axes, first in zip(row, (shapes, objectives), strict=False):
                axes.axhline(first["CMA-ES"][:, 0].mean(), color=GREY, linewidth=0.8)
                axes.set(xscale="log", xlabel="decoder calls")
                ticks = [
                    k for k in config.budgets if config.budgets[-1] in (k, 4 * k, 16 * k, 64 * k)
                ]
                axes.set_xticks(ticks, [str(k) for k in ticks])
                axes.minorticks_off()
            row[0].set(title=f"{len(shapes['CMA-ES'])} {group} chairs", ylabel="IoU")
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
