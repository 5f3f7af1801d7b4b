r"""Objective and IoU along the search: CMA-ES, gradient descent and Adam (paper, Fig. gm left).

    python experiments/convergence.py --test.meshes cad_chairs/

16 procedural chairs and 12 CAD seats, each seen in 4 frames. Every search starts from the encoder's
code and takes all 350 iterations of the paper. CMA-ES and gradient descent run with the best steps
of step_size.py and with the paper's (sigma0 = 2 and steps of 0.14 in the codes themselves); Adam
runs once. The figure shows the lowest objective so far, and as a thin line the best candidate of
each iteration of CMA-ES. Objectives are relative to the start, where chairs differ most: means over
chairs with their 95 % intervals by bootstrap.

Results: experiments/results/convergence.json, .png and .svg; finished chairs are kept.
Time: 15 minutes on two cores.
"""

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Array, Float, Int

import study
from figures import LINES, PAGE, draw_mean, save_column
from jaxshape.geometry.overlap import iou
from jaxshape.model.shapes import ShapePrior, decode
from jaxshape.report.figures import tidy
from jaxshape.report.palette import PINK, RED
from jaxshape.results.evaluation import Case
from jaxshape.results.journal import Journal
from jaxshape.search.config import RefineConfig
from jaxshape.search.reconstruction import reconstruct, refiner_for
from study import (
    TUNED,
    Contestant,
    Scores,
    TestSet,
    column,
    compare,
    groups,
    mean_low_high,
    rounded,
)

AT_A_TIME = 8
OFTEN, SELDOM = 30, 12
"""Numbers of iterations at which objective and IoU are reported."""
PAPER_CMA, PAPER_DESCENT = "CMA-ES, sigma0 2 in codes", "descent, step 0.14 in codes"

SEARCHES: dict[str, tuple[str, RefineConfig]] = TUNED | {
    PAPER_CMA: ("cma", RefineConfig(space="raw", sigma0=2.0)),
    PAPER_DESCENT: ("gradient", RefineConfig(space="raw", step_size=0.14)),
}
STYLES = LINES | {
    PAPER_CMA: {"color": PINK, "dashes": (1, 1)},
    PAPER_DESCENT: {"color": RED, "dashes": (2, 2)},
}


@dataclass(frozen=True)
class Config(study.Config):
    """Settings of the experiment."""

    test: TestSet = TestSet(chairs=16, seats=12)
    frames: int = 4
    """Number of frames that are fused."""
    iterations: int = 350
    """Iterations of every search; none stops earlier."""
    early: int = 60
    """Iterations of the other experiments."""


def main(config: Config) -> None:
    config = config.reduced(iterations=2, early=1)
    journal = run(config)
    plot(journal, config)


def run(config: Config) -> Journal:
    """Follow every search on every chair, and write the results."""
    searches = {
        name: [method, repr(replace(how, objective="balanced"))]
        for name, (method, how) in SEARCHES.items()
    }
    iterations = [sampled(config, OFTEN), sampled(config, SELDOM)]
    prior, journal = config.begin(
        "convergence", frames=config.frames, searches=searches, iterations=iterations
    )
    contestants = {name: along(*search, prior, config) for name, search in SEARCHES.items()}
    compare(contestants, prior, config.test, (config.frames,), journal, at_a_time=AT_A_TIME)
    found = {group or "all": summary(journal, group, config) for group in (*groups(journal), None)}
    journal.write({"summary": found})
    return journal


def sampled(config: Config, count: int) -> list[int]:
    """About `count` iterations, evenly spaced in their logarithm, counted from 1."""
    spaced = np.geomspace(1, config.iterations, count).round().astype(int)
    return sorted({*spaced.tolist(), config.early})


def along(method: str, how: RefineConfig, prior: ShapePrior, config: Config) -> Contestant:
    """The contestant that reports its whole search, at some iterations."""
    how = replace(how, iterations=config.iterations, tolerance=0.0)
    refiner = refiner_for(method, prior, how)
    often, seldom = (jnp.array(sampled(config, n)) - 1 for n in (OFTEN, SELDOM))

    def contest(keys: Array, prior: ShapePrior, case: Case) -> Scores:
        F, M = case.grids.occupied, case.grids.occluded
        found = reconstruct(keys, prior, F, M, refiner, how)
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
        return iou(decode(prior, codes) > 0, case.surface)

    return jax.lax.map(score, codes.swapaxes(0, 1)).T


def fluctuation(
    drawn: Float[Array, "case iteration"], taken: Int[Array, " case"]
) -> dict[str, Float[Array, " case"]]:
    """Share of iterations whose loss is above the previous one, and the uphill share of all
    changes.

    `rises` is a share of the iterations that were taken, `uphill` a share of all changes of the
    loss. Both are 0 for losses that never rise; `uphill` is a half for losses that rise as much as
    they fall.
    """
    change = jnp.diff(drawn)
    was_taken = jnp.arange(1, drawn.shape[1]) < taken[:, None]
    up, down = (jnp.sum(jnp.maximum(sign * change, 0), axis=1, where=was_taken) for sign in (1, -1))
    return {
        "rises": jnp.mean(change > 0, axis=1, where=was_taken),
        "uphill": up / jnp.maximum(up + down, 1e-12),
    }


def summary(journal: Journal, group: str | None, config: Config) -> dict[str, Any]:
    """Means and intervals of each search over the chairs of a group, or of all groups.

    `fall` is the decrease of the objective as a share of the best search's decrease; `early_fall`
    and `early_gain` are the shares of a search's own decrease and gain in IoU that it reaches
    early. Leads are those of CMA-ES over the search. `waited` is the median number of iterations
    until something better than the start is found.
    """
    often = sampled(config, OFTEN)
    early = often.index(config.early)
    early_iou = sampled(config, SELDOM).index(config.early)

    def scores(name: str, score: str) -> np.ndarray:
        return column(journal, group, config.frames, name, score)

    def fall(name: str) -> np.ndarray:
        return scores(name, "start").mean() - scores(name, "best").mean(axis=0)

    def rise(name: str) -> np.ndarray:
        return scores(name, "iou").mean(axis=0) - scores(name, "start_iou").mean()

    lowest, shape = (scores("CMA-ES", score)[:, -1] for score in ("best", "iou"))
    most = max(fall(name)[-1] for name in SEARCHES)

    def of(name: str) -> dict[str, Any]:
        best, shapes = scores(name, "best"), scores(name, "iou")
        numbers = {
            "objective_start": scores(name, "start"),
            "objective_early": best[:, early],
            "objective": best[:, -1],
            "iou_start": scores(name, "start_iou"),
            "iou_early": shapes[:, early_iou],
            "iou": shapes[:, -1],
            "rises": scores(name, "rises"),
            "uphill": scores(name, "uphill"),
            "iterations": scores(name, "iterations"),
            "iou_lead": shape - shapes[:, -1],
        }
        stuck = (best >= scores(name, "start")[:, None]).sum(axis=1)
        return {key: mean_low_high(values) for key, values in numbers.items()} | {
            "fall": share(fall(name)[-1], most),
            "early_fall": share(fall(name)[early], fall(name)[-1]),
            "early_gain": share(rise(name)[early_iou], rise(name)[-1]),
            "objective_lead_on": int((best[:, -1] > lowest).sum()),
            "waited": [0, *often][int(np.median(stuck))],
        }

    return {name: of(name) for name in SEARCHES}


def share(part: float, whole: float) -> float:
    """0 where nothing was reached."""
    return rounded(part / whole) if whole else 0.0


def plot(journal: Journal, config: Config) -> None:
    """A column of panels for each group: the objective above, IoU below."""
    often, seldom = sampled(config, OFTEN), sampled(config, SELDOM)

    def draw(figure: Any) -> None:
        found = groups(journal)
        upper, lower = figure.subplots(2, len(found), sharex=True, sharey="row", squeeze=False)
        for group, objective, overlap in zip(found, upper, lower, strict=True):
            rows = [row[str(config.frames)] for row in journal.rows.values()
                    if row["group"] == group]  # fmt: skip
            for name in SEARCHES:
                start, start_iou, best, ious, drawn = (
                    np.array([row[name][score] for row in rows])
                    for score in ("start", "start_iou", "best", "iou", "drawn")
                )
                draw_mean(objective, often, best / start[:, None], label=name, **STYLES[name])
                draw_mean(overlap, seldom, ious - start_iou[:, None], **STYLES[name])
                if name == "CMA-ES":
                    share = (drawn / start[:, None]).mean(axis=0)
                    objective.plot(often, share, color=STYLES[name]["color"], lw=0.6)
            objective.set_title(f"{len(rows)} {group} chairs, {config.frames} frames")
            overlap.set(xscale="log", xlabel="iteration")
            overlap.xaxis.set_major_formatter("{x:g}")
            for axes in (objective, overlap):
                tidy(axes)
        upper[0].set_ylabel("objective, share of the start's")
        lower[0].set_ylabel("IoU over the encoder's")
        upper[0].legend(frameon=False, loc="lower left")

    save_column(config.results / "convergence", draw, height=4.6, width=PAGE)


if __name__ == "__main__":
    main(tyro.cli(Config))
