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

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro

from jaxshape.model.weights import fingerprint, load_prior
from jaxshape.results.journal import Journal
from study import (
    Claim,
    TestSet,
    column,
    compare,
    conclude,
    groups,
    mean_interval,
    measurement,
    plot_curves,
    summary,
    tuned,
)

RESULTS = Path(__file__).parent / "results"
CLOSE = 0.01
"""IoU by which F may lie below CMA-ES and still be called its bound."""


@dataclass(frozen=True)
class Config:
    """Settings of the experiment."""

    test: TestSet = TestSet()
    frames: tuple[int, ...] = (1, 4, 8, 18)
    """Numbers of frames that are fused."""
    iterations: int = 60
    """Iterations of every search (paper: 350)."""
    weights: Path = Path("chair-autoencoder")
    """Weights of the shape prior; the package's by default."""
    results: Path = RESULTS
    smoke: bool = False
    """Two procedural chairs and few iterations, as a test."""


def main(config: Config) -> None:
    if config.smoke:
        test = replace(config.test, chairs=2, seats=0)
        config = replace(config, test=test, frames=(1, 4), iterations=2)
    journal = run(config)
    plot(journal, config)


def run(config: Config) -> Journal:
    """Score every method on every chair, and write the results."""
    prior = load_prior(config.weights)
    settings = {
        "frames": config.frames,
        "iterations": config.iterations,
        "weights": fingerprint(prior),
    }
    journal = Journal(config.results / "iou_by_frames.json", settings)
    contestants = tuned(prior, config.iterations) | {"F": measurement}
    compare(contestants, prior, config.test, config.frames, journal)
    conclude(journal, claims(journal, config), summary=summary(journal, config.frames))
    return journal


def claims(journal: Journal, config: Config) -> list[Claim]:
    """The paper's claims about this figure, and our findings."""
    few, many = config.frames[0], config.frames[-1]

    def gain(group: str, better: str, worse: str, k: int) -> np.ndarray:
        return column(journal, group, k, better, "iou") - column(journal, group, k, worse, "iou")

    def over_encoder(group: str) -> str:
        first, last = (mean_interval(gain(group, "CMA-ES", "encoder", k)) for k in (few, many))
        return f"{group}: {first} at {few}, {last} at {many} frames"

    def over_descent(group: str) -> str:
        descent, adam = (
            mean_interval(gain(group, "CMA-ES", name, config.frames[-2]))
            for name in ("gradient descent", "Adam")
        )
        return f"{group}: {descent} over descent, {adam} over Adam"

    def bound(group: str) -> str:
        F, found = (
            column(journal, group, many, *names).mean()
            for names in (("F", "occluded_empty"), ("CMA-ES", "iou"))
        )
        return f"{group}: F {F:.3f}, CMA-ES {found:.3f} at {many} frames"

    found = groups(journal)
    gains = [gain(group, "CMA-ES", "encoder", k) for group in found for k in (few, many)]
    grows = all(
        last.mean() > first.mean() > 0 for first, last in zip(*[iter(gains)] * 2, strict=True)
    )
    over = {
        name: all(
            gain(group, "CMA-ES", name, k).mean() > 0 for group in found for k in config.frames
        )
        for name in ("gradient descent", "Adam")
    }
    is_close = {
        k: all(
            np.mean(column(journal, group, k, "F", "occluded_empty"))
            > np.mean(column(journal, group, k, "CMA-ES", "iou")) - CLOSE
            for group in found
        )
        for k in (few, many)
    }
    return [
        Claim(
            "Fig. IoU-error",
            "CMA-ES refinement beats the auto-encoder, most with many frames",
            "IoU gained, " + "; ".join(map(over_encoder, found)),
            "yes" if grows else "partly",
        ),
        Claim(
            "Fig. IoU-error",
            "Gradient descent cannot outperform CMA-ES on average",
            f"IoU of CMA-ES at {config.frames[-2]} frames, " + "; ".join(map(over_descent, found)),
            "yes"
            if all(over.values())
            else "true of plain descent only"
            if over["gradient descent"]
            else "no",
        ),
        Claim(
            "Fig. IoU-error",
            "F with occluded voxels empty is a very accurate upper bound",
            "; ".join(map(bound, found)),
            "yes" if is_close[few] else "at many frames only" if is_close[many] else "no",
        ),
    ]


def plot(journal: Journal, config: Config) -> None:
    """A panel for each group of chairs."""
    plot_curves(config.results / "iou_by_frames", journal, config.frames, "{} {} chairs")


if __name__ == "__main__":
    main(tyro.cli(Config))
