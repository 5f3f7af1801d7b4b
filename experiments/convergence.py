r"""Objective and IoU along the search: CMA-ES, gradient descent and Adam (paper, Fig. gm left).

    python experiments/convergence.py --test.meshes cad_chairs/

24 procedural chairs and 16 CAD seats, each seen in 4 frames. Every search starts from the encoder's
code and takes all 350 iterations of the paper: CMA-ES and gradient descent with the steps that
step_size.py finds best and with those of the paper (in the codes themselves, sigma0 = 2 and steps
of 0.14), and Adam. The objective is the best so far; a thin line is what CMA-ES draws, the best of
each iteration alone. Means over chairs with their 95 % intervals by bootstrap.

Results: experiments/results/convergence.json, .png and .svg; chairs that are done are kept.
Time: 12 minutes on two cores.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Array, Float, Int

from jaxshape.model.autoencoder import decode
from jaxshape.model.weights import ShapePrior, fingerprint, load_prior
from jaxshape.refine.config import RefineConfig
from jaxshape.refine.reconstruction import reconstruct, refiner_for
from jaxshape.results.evaluation import Case
from jaxshape.results.figures import LINES, PAGE, PINK, RED, draw_mean, interval, save_column, tidy
from jaxshape.results.journal import Journal
from jaxshape.results.metrics import iou
from jaxshape.results.study import (
    Claim,
    Contestant,
    Scores,
    TestSet,
    column,
    compare,
    groups,
    mean_interval,
    mean_low_high,
)

RESULTS = Path(__file__).parent / "results"
CHAIRS_AT_A_TIME = 8
PAPER_CMA, PAPER_DESCENT = "CMA-ES, sigma0 2 in codes", "descent, step 0.14 in codes"

SEARCHES: dict[str, tuple[str, RefineConfig]] = {
    "CMA-ES": ("cma", RefineConfig()),
    "gradient descent": ("gradient", RefineConfig()),
    "Adam": ("gradient:adam", RefineConfig()),
    PAPER_CMA: ("cma", RefineConfig(space="raw", sigma0=2.0)),
    PAPER_DESCENT: ("gradient", RefineConfig(space="raw", step_size=0.14)),
}
STYLES = LINES | {
    PAPER_CMA: {"color": PINK, "dashes": (1, 1)},
    PAPER_DESCENT: {"color": RED, "dashes": (2, 2)},
}


@dataclass(frozen=True)
class Config:
    """Settings of the experiment."""

    test: TestSet = TestSet(chairs=24, seats=16)
    frames: int = 4
    """Number of frames that are fused."""
    iterations: int = 350
    """Of every search, none of which stops before."""
    early: int = 60
    """Iterations that the other experiments make do with."""
    results: Path = RESULTS
    smoke: bool = False
    """Two procedural chairs and few iterations: does it run?"""


def main(config: Config) -> None:
    if config.smoke:
        test = replace(config.test, chairs=2, seats=0)
        config = replace(config, test=test, iterations=2, early=1)
    journal = run(config)
    plot(journal, config)


def run(config: Config) -> Journal:
    """Follow every search on every chair, and write what was found."""
    prior = load_prior()
    settings = {
        "frames": config.frames,
        "searches": {name: [method, repr(how)] for name, (method, how) in SEARCHES.items()},
        "iterations": [sampled(config, 30), sampled(config, 12)],
        "weights": fingerprint(prior),
    }
    journal = Journal(config.results / "convergence.json", settings)
    contestants = {name: along(*search, prior, config) for name, search in SEARCHES.items()}
    compare(
        contestants,
        prior,
        config.test,
        (config.frames,),
        journal,
        at_a_time=CHAIRS_AT_A_TIME,
    )
    journal.write(
        {
            "claims": [claim._asdict() for claim in claims(journal, config)],
            "summary": summary(journal, config),
        }
    )
    return journal


def sampled(config: Config, count: int) -> list[int]:
    """About so many iterations, evenly spaced in their logarithm, counted from 1."""
    spaced = np.geomspace(1, config.iterations, count).round().astype(int)
    return sorted({*spaced.tolist(), config.early})


def along(method: str, how: RefineConfig, prior: ShapePrior, config: Config) -> Contestant:
    """The contestant that reports of all of its search, at some iterations."""
    how = replace(how, iterations=config.iterations, tolerance=0.0)
    refiner = refiner_for(method, prior, how)
    often, seldom = (jnp.array(sampled(config, n)) - 1 for n in (30, 12))

    def contest(keys: Array, prior: ShapePrior, case: Case) -> Scores:
        found = reconstruct(keys, prior, case.occupied, case.occluded, refiner, how)
        assert found.trace is not None and found.path is not None and found.iterations is not None
        drawn = found.trace.loss
        return {
            "start": found.first_objective,
            "start_iou": iou(found.completed_first, case.surface),
            "best": found.trace.best_loss[:, often],
            "drawn": drawn[:, often],
            "iou": iou_of(found.path[:, seldom], prior, case),
            "iterations": found.iterations,
        } | fluctuation(drawn, found.iterations)

    return contest


def iou_of(
    codes: Float[Array, "case n d"], prior: ShapePrior, case: Case
) -> Float[Array, "case n"]:
    """IoU of the shapes of some codes for each case."""

    def score(codes: Float[Array, "case d"]) -> Float[Array, " case"]:
        return iou(decode(prior.params, codes) > 0, case.surface)

    return jax.lax.map(score, codes.swapaxes(0, 1)).T


def fluctuation(
    drawn: Float[Array, "case iteration"], taken: Int[Array, " case"]
) -> dict[str, Float[Array, " case"]]:
    """How often the loss of an iteration is above that before, and how much of its way is uphill.

    `rises` is a share of the iterations that were taken, `uphill` of all changes of the loss: 0 for
    losses that never go up, and a half for those that go up as much as down.
    """
    change = jnp.diff(drawn)
    was_taken = jnp.arange(1, drawn.shape[1]) < taken[:, None]
    up, down = (jnp.sum(jnp.maximum(sign * change, 0), axis=1, where=was_taken) for sign in (1, -1))
    return {
        "rises": jnp.mean(change > 0, axis=1, where=was_taken),
        "uphill": up / jnp.maximum(up + down, 1e-12),
    }


def summary(journal: Journal, config: Config) -> dict[str, Any]:
    """Means and intervals over chairs at the start, early, and at the end."""
    early = sampled(config, 30).index(config.early)

    def of(group: str, name: str) -> dict[str, Any]:
        def scores(score: str) -> np.ndarray:
            return column(journal, group, config.frames, name, score)

        numbers = {
            "objective_start": scores("start"),
            "objective_early": scores("best")[:, early],
            "objective": scores("best")[:, -1],
            "iou_start": scores("start_iou"),
            "iou_early": scores("iou")[:, sampled(config, 12).index(config.early)],
            "iou": scores("iou")[:, -1],
            "rises": scores("rises"),
            "uphill": scores("uphill"),
            "iterations": scores("iterations"),
        }
        return {key: mean_low_high(values) for key, values in numbers.items()}

    return {group: {name: of(group, name) for name in SEARCHES} for group in groups(journal)}


def claims(journal: Journal, config: Config) -> list[Claim]:
    """What the paper says of this figure, and what is found here."""
    found = groups(journal)
    early = sampled(config, 30).index(config.early)

    def scores(group: str, name: str, score: str) -> np.ndarray:
        return column(journal, group, config.frames, name, score)

    def last(group: str, name: str, score: str) -> np.ndarray:
        return scores(group, name, score)[:, -1]

    def per_group(text: Any) -> str:
        return "; ".join(f"{group}: {text(group)}" for group in found)

    def fluctuates(group: str) -> str:
        return ", ".join(
            f"{name} rises in {scores(group, name, 'rises').mean():.0%} of its iterations"
            f" and goes uphill for {scores(group, name, 'uphill').mean():.0%} of its way"
            for name in ("CMA-ES", "gradient descent")
        )

    def over(name: str, other: str, score: str) -> list[np.ndarray]:
        return [last(group, name, score) - last(group, other, score) for group in found]

    def ahead(score: str) -> str:
        sign, unit = (-1, 1000) if score == "best" else (1, 1)

        def of(group: str) -> str:
            return " and ".join(
                f"{mean_interval(unit * x)} against {other} (CMA-ES better on"
                f" {(sign * x > 0).sum()} of {len(x)})"
                for other in ("gradient descent", "Adam")
                for x in [last(group, "CMA-ES", score) - last(group, other, score)]
            )

        return per_group(of)

    def fallen(name: str, at: int) -> str:
        """Of the lowest mean that any of the searches ends at."""

        def of(group: str) -> str:
            start = scores(group, name, "start").mean()
            lowest = min(last(group, other, "best").mean() for other in SEARCHES)
            return f"{(start - scores(group, name, 'best')[:, at].mean()) / (start - lowest):.0%}"

        return per_group(of)

    def improved(group: str) -> str:
        better = last(group, PAPER_CMA, "best") < scores(group, PAPER_CMA, "start")
        first = scores(group, PAPER_CMA, "drawn")[:, 0] / scores(group, PAPER_CMA, "start")
        return (
            f"ever below the start on {better.sum()} of {len(better)}, the best of its first"
            f" candidates costs {np.median(first):.1f} times the start (median)"
        )

    def gained(name: str) -> str:
        return per_group(
            lambda group: mean_interval(last(group, name, "iou") - scores(group, name, "start_iou"))
        )

    wilder = all(
        scores(group, "CMA-ES", score).mean() > scores(group, "gradient descent", score).mean()
        for group in found
        for score in ("rises", "uphill")
    )
    smooth = all(scores(group, "gradient descent", "uphill").mean() < 0.1 for group in found)
    lower = [-x for x in over("CMA-ES", "gradient descent", "best")]
    better = over("CMA-ES", "gradient descent", "iou")
    best_descent = [
        last(group, PAPER_DESCENT, "best") - last(group, "gradient descent", "best")
        for group in found
    ]
    best_cma = [last(group, PAPER_CMA, "best") - last(group, "CMA-ES", "best") for group in found]
    settled = all(
        scores(group, name, "start").mean() - scores(group, name, "best")[:, early].mean()
        >= 0.9 * (scores(group, name, "start") - last(group, name, "best")).mean()
        for group in found
        for name in ("CMA-ES", "gradient descent", "Adam")
    )
    return [
        Claim(
            "Fig. gm left",
            "Gradient descent converges smoothly; CMA-ES declines in a fluctuating fashion",
            per_group(fluctuates),
            "yes" if wilder and smooth else "of CMA-ES" if wilder else "no",
        ),
        Claim(
            "Fig. gm left",
            "CMA-ES is much better at overcoming local minima: it ends lower",
            f"Objective in thousandths after {config.iterations} iterations, " + ahead("best"),
            verdict(lower),
        ),
        Claim(
            "Fig. gm left",
            "The shape that CMA-ES ends at is the better one",
            f"IoU after {config.iterations} iterations, " + ahead("iou"),
            verdict(better),
        ),
        Claim(
            "Sec. 4",
            "Steps of 0.14 lead to fast convergence without overshooting",
            f"Of the fall of the best search, at {config.early} and {config.iterations}: "
            + f"{fallen(PAPER_DESCENT, early)} and {fallen(PAPER_DESCENT, -1)}; with the step"
            f" chosen here {fallen('gradient descent', early)} and"
            f" {fallen('gradient descent', -1)}; IoU gained by 0.14, {gained(PAPER_DESCENT)}",
            "no"
            if all(x.mean() > 0 for x in best_descent)
            else verdict([-x for x in best_descent]),
        ),
        Claim(
            "Sec. 4",
            "sigma0 = 2 is best for CMA-ES",
            f"{per_group(improved)}; of the fall of the best search {fallen(PAPER_CMA, -1)},"
            f" with sigma0 as chosen here {fallen('CMA-ES', -1)}; IoU gained by sigma0 = 2,"
            f" {gained(PAPER_CMA)}",
            "no" if all(x.mean() > 0 for x in best_cma) else verdict([-x for x in best_cma]),
        ),
        Claim(
            "beyond",
            f"{config.early} iterations do instead of {config.iterations}",
            "Of each search's own fall of the objective, and of its gain in IoU, "
            + per_group(lambda group: settled_text(journal, config, group)),
            "yes" if settled else "no",
        ),
    ]


def settled_text(journal: Journal, config: Config, group: str) -> str:
    """What part of its way each search has gone early."""

    def part(name: str, start: str, score: str, count: int) -> str:
        first = column(journal, group, config.frames, name, start).mean()
        curve = column(journal, group, config.frames, name, score).mean(axis=0)
        way = curve[-1] - first
        return f"{(curve[sampled(config, count).index(config.early)] - first) / way:.0%}"

    return ", ".join(
        f"{name} {part(name, 'start', 'best', 30)} and {part(name, 'start_iou', 'iou', 12)}"
        for name in ("CMA-ES", "gradient descent", "Adam")
    )


def verdict(differences: Sequence[np.ndarray]) -> str:
    """Whether differences are positive in every group, and beyond the 95 % interval."""
    ends = [interval(x[:, None])[:, 0] for x in differences]
    if all(low > 0 for low, _ in ends):
        return "yes"
    if all(high < 0 for _, high in ends):
        return "no, the reverse"
    return "undecided" if all(low <= 0 <= high for low, high in ends) else "in part"


def plot(journal: Journal, config: Config) -> None:
    """A column of panels for each group: the objective above, IoU below."""
    often, seldom = sampled(config, 30), sampled(config, 12)

    def draw(figure: Any) -> None:
        found = groups(journal)
        upper, lower = figure.subplots(2, len(found), sharex=True, sharey="row", squeeze=False)
        for group, objective, overlap in zip(found, upper, lower, strict=True):
            rows = [row[str(config.frames)] for row in journal.rows.values()
                    if row["group"] == group]  # fmt: skip
            for name in SEARCHES:
                best, ious, drawn = (
                    np.array([row[name][score] for row in rows])
                    for score in ("best", "iou", "drawn")
                )
                draw_mean(objective, often, best, label=name, **STYLES[name])
                draw_mean(overlap, seldom, ious, **STYLES[name])
                if name == "CMA-ES":
                    objective.plot(often, drawn.mean(axis=0), color=STYLES[name]["color"], lw=0.6)
            objective.set_title(f"{len(rows)} {group} chairs, {config.frames} frames")
            overlap.set(xscale="log", xlabel="iteration")
            overlap.xaxis.set_major_formatter("{x:g}")
            for axes in (objective, overlap):
                tidy(axes)
        upper[0].set_ylabel("objective [nats per voxel]")
        lower[0].set_ylabel("IoU")
        starts = [column(journal, group, config.frames, "CMA-ES", "start") for group in found]
        upper[0].set_ylim(top=1.1 * max(start.mean() for start in starts))
        upper[0].legend(frameon=False, loc="lower left")

    save_column(config.results / "convergence", draw, height=4.6, width=PAGE)


if __name__ == "__main__":
    main(tyro.cli(Config))
