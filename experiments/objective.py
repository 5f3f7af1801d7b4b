r"""Comparison of residuals as objectives of a search (beyond the paper, Eq. 7)

    python experiments/objective.py --test.meshes cad_chairs/

Variants of Eq. 7, each minimised by the same number of steps of Adam from the encoder's code,
after 1, 4 and 8 frames of 24 procedural chairs and 16 CAD seats: the weight of measured occupied
voxels (1 in the paper); alpha as printed, scaled, the same for all chairs, or scheduled over the
search; the prior re-anchored to the refined shape after every quarter of the search; the codes
themselves (paper) or whitened ones as coordinates. Unless named otherwise, the weight is 3, alpha
as printed, the codes whitened. A threefold weight of measured occupied voxels and of the prior is
the same as a third of the weight of free space, which is the `balanced` objective. Each variant is
scored by the IoU of the decoded and of the composed shape. Where the search is cut into quarters,
Adam restarts in each quarter. Some variants are repeated with depth images that have the faults of
a real sensor.

Results: experiments/results/objective.json, .png and .svg; finished chairs are kept.
Time: 16 minutes on two cores.
"""

from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Array, Bool, Float

import study
from figures import PAGE, interval, save_column
from jaxshape.geometry.overlap import iou
from jaxshape.model.shapes import ShapePrior, decode, encode
from jaxshape.report.figures import tidy
from jaxshape.report.palette import BLUE, GREY, INK, ORANGE
from jaxshape.results.evaluation import Case
from jaxshape.results.journal import Journal
from jaxshape.search.composition import compose
from jaxshape.search.config import RefineConfig
from jaxshape.search.methods import build_refiner
from jaxshape.search.reconstruction import code_penalty, search_space
from jaxshape.search.residuals import Weights, weigh
from jaxshape.search.run import refine
from study import (
    SEARCH,
    Contestant,
    TestSet,
    by_method,
    compare,
    gain,
    mean_low_high,
)


@dataclass(frozen=True)
class Residual:
    """The objective of a search."""

    occupied_weight: float = 3.0
    prior_scales: tuple[float, ...] = (1.0,)
    """Factors of alpha, one for each part of the search."""
    alpha_is_printed: bool = True
    """Whether alpha is that of Eq. 7; otherwise alpha is 1 for every measurement."""
    anchor_moves: bool = False
    """Whether the prior is the shape found so far, updated with every part of the search."""
    search: RefineConfig = RefineConfig()


SCORES = ("iou", "iou_composed")
COMMON = Residual()
QUARTERS = replace(COMMON, prior_scales=(1.0,) * 4)
CODES = RefineConfig(space="raw", step_size=0.03)
PAPER, DEFAULT = "occupied weight 1 (paper)", "alpha x 3 (balanced)"
RESIDUALS = {
    PAPER: replace(COMMON, occupied_weight=1.0),
    "occupied weight 2": replace(COMMON, occupied_weight=2.0),
    "occupied weight 3": COMMON,
    "occupied weight 5": replace(COMMON, occupied_weight=5.0),
    "occupied weight 10": replace(COMMON, occupied_weight=10.0),
    "alpha x 0": replace(COMMON, prior_scales=(0.0,)),
    "alpha x 0.3": replace(COMMON, prior_scales=(0.3,)),
    DEFAULT: replace(COMMON, prior_scales=(3.0,)),
    "alpha x 10": replace(COMMON, prior_scales=(10.0,)),
    "alpha = 1": replace(COMMON, alpha_is_printed=False),
    "in quarters": QUARTERS,
    "alpha falls, x 10 to 0.1": replace(QUARTERS, prior_scales=(10.0, 3.0, 0.3, 0.1)),
    "alpha rises, x 0.1 to 10": replace(QUARTERS, prior_scales=(0.1, 0.3, 3.0, 10.0)),
    "prior re-anchored": replace(QUARTERS, anchor_moves=True),
    "raw codes": replace(COMMON, search=CODES),
    "raw codes, weight 1 (paper)": Residual(1.0, search=CODES),
    "weight 5, alpha x 3": replace(COMMON, occupied_weight=5.0, prior_scales=(3.0,)),
}
NOISY = (PAPER, "occupied weight 3", "occupied weight 5", DEFAULT, "alpha x 10",
         "weight 5, alpha x 3")  # fmt: skip


@dataclass(frozen=True)
class Config(study.Config):
    """Settings of the experiment."""

    test: TestSet = TestSet(chairs=24, seats=16)
    frames: tuple[int, ...] = (1, 4, 8)
    """Numbers of frames that are fused."""
    iterations: int = 48
    """Steps of Adam."""


def main(config: Config) -> None:
    config = config.reduced(iterations=4)
    residuals = {name: RESIDUALS[name] for name in (PAPER, DEFAULT)} if config.smoke else RESIDUALS
    clean, noisy = run(config, residuals)
    plot({"no noise": clean, "a real sensor's noise": noisy}, config)


def run(config: Config, residuals: dict[str, Residual] = RESIDUALS) -> tuple[Journal, Journal]:
    """Minimise every residual for every chair, without and with noise; write the results."""
    settings = {"frames": config.frames, "iterations": config.iterations}
    prior, clean = config.begin("objective", **settings)
    _, noisy = config.begin("objective_noise", **settings)
    contestants = {"encoder": by_method("encoder", prior, SEARCH)} | {
        name: by_residual(residual, prior, config.iterations)
        for name, residual in residuals.items()
    }
    robust = {name: contestants[name] for name in ("encoder", *NOISY) if name in contestants}
    compare(contestants, prior, config.test, config.frames, clean)
    compare(robust, prior, config.test, config.frames, noisy, noise=True)
    for journal in (clean, noisy):
        journal.write({"summary": summary(journal, config)})
    return clean, noisy


def by_residual(residual: Residual, prior: ShapePrior, iterations: int) -> Contestant:
    """The search that minimises a residual, in as many parts as its alpha has factors."""
    search = replace(residual.search, tolerance=0.0)
    refiner = build_refiner("gradient:adam", len(prior.code_mean), search)
    steps = iterations // len(residual.prior_scales)
    penalty = code_penalty(prior)

    def contest(keys, prior: ShapePrior, case: Case):
        grids = case.grids
        code = encode(prior, grids)
        occluded = jnp.asarray(grids.occluded)
        anchor = logits = decode(prior, code)
        for scale in residual.prior_scales:
            alpha = scale if residual.alpha_is_printed else scale / printed_alpha(occluded)
            # Weights relative to measured surface; a common factor does not change Adam.
            weights = Weights(1 / residual.occupied_weight, alpha / residual.occupied_weight)
            targets = weigh(grids, anchor, weights)
            found = refine(
                keys, prior, code, targets, refiner, steps,
                space=search_space(prior, search),
                penalty=penalty, penalty_weight=search.prior_weight,
            )  # fmt: skip
            code, logits = found.code, found.logits
            anchor = logits if residual.anchor_moves else anchor
        composed = compose(grids.occupied, grids.occluded, logits > 0)
        return {"iou": iou(logits > 0, case.surface), "iou_composed": iou(composed, case.surface)}

    return contest


def printed_alpha(occluded: Bool[Array, "case x y z"]) -> Float[Array, "case 1 1 1"]:
    """alpha = sum(M) / sum(1 - M) of Eq. 7; never 0, so that one can divide by it."""
    count = occluded.sum((1, 2, 3), keepdims=True)
    return jnp.maximum(count, 1) / jnp.maximum((~occluded).sum((1, 2, 3), keepdims=True), 1)


def summary(journal: Journal, config: Config) -> dict[str, Any]:
    """Gains over the encoder by residual and number of frames, each as [mean, low, high].

    `all` is the mean gain of decoded and composed shapes over all numbers of frames, minus that of
    Eq. 7 as printed, and minus that of the default.
    """

    def overall(name: str) -> np.ndarray:
        gains = [gain(journal, None, k, name, score=s) for k in config.frames for s in SCORES]
        return np.mean(gains, axis=0)

    def of(name: str) -> dict[str, Any]:
        return {
            str(k): {s: mean_low_high(gain(journal, None, k, name, score=s)) for s in SCORES}
            for k in config.frames
        } | {"all": {r: mean_low_high(overall(name) - overall(r)) for r in (PAPER, DEFAULT)}}

    return {name: of(name) for name in _names(journal, config)}


def _names(journal: Journal, config: Config) -> list[str]:
    row = next(iter(journal.rows.values()))[str(config.frames[0])]
    return [name for name in row if name != "encoder"]


def plot(journals: dict[str, Journal], config: Config) -> None:
    """A line per residual: gain of the decoded and of the composed shape, by frames."""
    colors = (GREY, ORANGE, BLUE)
    names = {noise: _names(journal, config)[::-1] for noise, journal in journals.items()}

    def draw(figure: Any) -> None:
        heights = [len(one) for one in names.values()]
        panels = figure.subplots(2, 2, sharey="row", height_ratios=heights)
        for row, (noise, journal) in zip(panels, journals.items(), strict=True):
            for axes, score in zip(row, SCORES, strict=True):
                for i, name in enumerate(names[noise]):
                    for j, (k, color) in enumerate(zip(config.frames, colors, strict=False)):
                        values = gain(journal, None, k, name, score=score)
                        low, high = interval(values)
                        y = i + 0.24 * (1 - j)
                        axes.plot([low, high], [y, y], color=color, linewidth=1.4)
                        label = f"{k} frame{'s' * (k > 1)}" if i == 0 else None
                        axes.plot(values.mean(), y, "os^"[j], color=color, ms=3.2, label=label)
                axes.axvline(0, color=INK, linewidth=0.8)
                shape = "decoded" if score == "iou" else "composed"
                axes.set_title(f"{shape}, {noise}")
                axes.set_yticks(range(len(names[noise])), names[noise])
                tidy(axes)
        for axes in panels[1]:
            axes.set_xlabel("IoU over the encoder's")
        panels[0, 0].legend(frameon=False, loc=(0.01, 0.3))

    count = sum(len(one) for one in names.values())
    save_column(config.results / "objective", draw, height=0.19 * count + 1.4, width=PAGE)


if __name__ == "__main__":
    main(tyro.cli(Config))
