r"""IoU by number of frames: encoder, gradients, CMA-ES, and F alone (paper, Fig. IoU-error).

    python experiments/iou_by_frames.py --test.meshes cad_chairs/

288 procedural chairs and the 78 CAD seats, each seen by the first k frames of an orbit at 30
degrees elevation, 20 degrees apart, with true poses and no noise, as in section 4.1 of the paper.
Every search starts from the encoder's code and has the same number of iterations, with the best
values of step_size.py. The two bounds are F with all occluded voxels set to empty and to full.
Means over chairs with their 95 % intervals by bootstrap.

Results: experiments/results/iou_by_frames.json, .png and .svg; finished chairs are kept.
Time: 50 minutes on two cores.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import tyro

import study
from jaxshape.model.shapes import ShapePrior
from jaxshape.model.weights import fingerprint, load_prior
from jaxshape.results.journal import Journal
from study import (
    Claim,
    TestSet,
    column,
    compare,
    conclude,
    gain,
    groups,
    mean_interval,
    measurement,
    plot_curves,
    summary,
    tuned,
)

CLOSE = 0.01
"""Largest IoU by which F may lie below CMA-ES and still count as its bound."""
GRADIENTS = ("gradient descent", "Adam")


@dataclass(frozen=True)
class Config(study.Config):
    """Settings of the experiment."""

    test: TestSet = TestSet()
    frames: tuple[int, ...] = (1, 4, 8, 18)
    """Numbers of frames that are fused."""
    iterations: int = 60
    """Iterations of every search (paper: 350)."""


def main(config: Config) -> None:
    config = config.reduced(frames=(1, 4), iterations=2)
    journal = run(config)
    plot(journal, config)


def run(config: Config) -> Journal:
    """Score every method on every chair, and write the results."""
    prior = load_prior(config.weights)
    journal = Journal(config.results / "iou_by_frames.json", settings_of(config, prior))
    contestants = tuned(prior, config.iterations) | {"F": measurement}
    compare(contestants, prior, config.test, config.frames, journal)
    conclude(journal, claims(journal, config), summary=summary(journal, config.frames))
    return journal


def settings_of(config: Config, prior: ShapePrior) -> dict[str, Any]:
    """The settings under which rows are made."""
    weights = fingerprint(prior)
    return {"frames": config.frames, "iterations": config.iterations, "weights": weights}


def claims(journal: Journal, config: Config) -> list[Claim]:
    """The paper's claims about this figure, and our findings."""
    few, some, many = config.frames[0], config.frames[-2], config.frames[-1]
    found = groups(journal)

    def ours(group: str, k: int, rival: str) -> np.ndarray:
        return gain(journal, group, k, "CMA-ES", rival)

    def over_encoder(group: str) -> str:
        first, last = (mean_interval(ours(group, k, "encoder")) for k in (few, many))
        return f"{group}: {first} at {few}, {last} at {many} frames"

    def over_gradients(group: str) -> str:
        descent, adam = (mean_interval(ours(group, some, name)) for name in GRADIENTS)
        return f"{group}: {descent} over descent, {adam} over Adam"

    def bound_and_iou(group: str, k: int) -> tuple[float, float]:
        pairs = (("F", "occluded_empty"), ("CMA-ES", "iou"))
        bound, reached = (column(journal, group, k, *pair).mean() for pair in pairs)
        return bound, reached

    def bound(group: str) -> str:
        F, reached = bound_and_iou(group, many)
        return f"{group}: F {F:.3f}, CMA-ES {reached:.3f} at {many} frames"

    def is_bound(k: int) -> bool:
        return all(F > reached - CLOSE for F, reached in (bound_and_iou(g, k) for g in found))

    first, last = ([ours(g, k, "encoder").mean() for g in found] for k in (few, many))
    over_descent, over_adam = (
        all(ours(g, k, name).mean() > 0 for g in found for k in config.frames) for name in GRADIENTS
    )
    return [
        Claim(
            "Fig. IoU-error",
            "CMA-ES refinement beats the auto-encoder, most with many frames",
            "IoU gained, " + "; ".join(map(over_encoder, found)),
            "yes" if all(b > a > 0 for a, b in zip(first, last, strict=True)) else "partly",
        ),
        Claim(
            "Fig. IoU-error",
            "Gradient descent cannot outperform CMA-ES on average",
            f"IoU of CMA-ES at {some} frames, " + "; ".join(map(over_gradients, found)),
            {(True, True): "yes", (True, False): "true of plain descent only"}.get(
                (over_descent, over_adam), "no"
            ),
        ),
        Claim(
            "Fig. IoU-error",
            "F with occluded voxels empty is a very accurate upper bound",
            "; ".join(map(bound, found)),
            "yes" if is_bound(few) else "at many frames only" if is_bound(many) else "no",
        ),
    ]


def plot(journal: Journal, config: Config) -> None:
    """A panel for each group of chairs."""
    plot_curves(config.results / "iou_by_frames", journal, config.frames, "{} {} chairs")


if __name__ == "__main__":
    main(tyro.cli(Config))
