r"""IoU by number of frames: encoder, gradients, CMA-ES, and F alone (paper, Fig. IoU-error).

    python experiments/iou_by_frames.py --test.meshes cad_chairs/

288 procedural chairs and the 78 CAD seats, each seen by the first k frames of an orbit at 30
degrees elevation, 20 degrees apart, with true poses and no noise, as in section 4.1 of the paper.
Every search starts from the encoder's code and has the same number of iterations, with the best
values of step_size.py. The two bounds are F with all occluded voxels set to empty and to full.
Means over chairs with their 95 % intervals by bootstrap.

The same rows are then averaged over voluminous chairs alone (paper, Fig. true_false): the surfaces
of 19 of the 288 procedural chairs and of 4 of the 78 CAD seats enclose more than 0.35 of the grid,
their own voxels included. The share of empty voxels among the occluded ones makes the lower bound
good. It is given for true surfaces, as everywhere here, and for solids, which include everything
that a surface encloses. No camera can see the inside; whether it is empty depends on the definition
of a shape.

Results: experiments/results/iou_by_frames.json and voluminous.json, each with .png and .svg;
finished chairs are kept. Time: 50 minutes on two cores.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Array, Bool
from rich.progress import track

import study
from jaxshape.data.capture import SURFACE_SAMPLES, discretize
from jaxshape.data.dataset import load_object
from jaxshape.data.meshes import Skipped, sample_surface
from jaxshape.geometry.grid import fit_box
from jaxshape.model.shapes import ShapePrior
from jaxshape.results.evaluation import Case
from jaxshape.results.journal import Journal
from jaxshape.results.metrics import bounds
from study import (
    Scores,
    Subject,
    TestSet,
    column,
    compare,
    groups,
    measurement,
    plot_curves,
    subjects,
    summary,
    tuned,
)

ENCLOSED = 0.35
"""Least fraction of the grid that a voluminous chair encloses."""
INSIDE = {
    "F, occluded empty, of solids": "solid_occluded_empty",
    "F, occluded full, of solids": "solid_occluded_full",
    "occluded voxels that are empty": "empty",
    "occluded voxels that are empty, of solids": "solid_empty",
}
"""Further curves of voluminous chairs, and their scores."""


@dataclass(frozen=True)
class Config(study.Config):
    """Settings of the experiment."""

    frames: tuple[int, ...] = (1, 4, 8, 18)
    """Numbers of frames that are fused."""
    iterations: int = 60
    """Iterations of every search (paper: 350)."""


def main(config: Config) -> None:
    # the first two voluminous chairs are among the first eleven
    config = config.reduced(chairs=11, frames=(1, 4), iterations=2)
    journal = run(config)
    plot(journal, config)
    plot_voluminous(run_voluminous(journal, config), config)


def run(config: Config) -> Journal:
    """Score every method on every chair, and write the results."""
    prior, journal = config.begin(
        "iou_by_frames", frames=config.frames, iterations=config.iterations
    )
    contestants = tuned(prior, config.iterations) | {"F": measurement}
    compare(contestants, prior, config.test, config.frames, journal)
    found = {group: summary(journal, group, config.frames) for group in groups(journal)}
    journal.write({"summary": found})
    return journal


def run_voluminous(searched: Journal, config: Config) -> Journal:
    """Take the rows of voluminous chairs, and add the bounds for solids."""
    settings = {"enclosed": ENCLOSED, "frames": config.frames, "iterations": config.iterations}
    prior, journal = config.begin("voluminous", **settings)
    chairs = list(voluminous(config.test))
    for name in [one.name for one in chairs if one.name not in journal.rows]:
        if name in searched.rows:
            row = searched.rows[name]
            scores = {str(k): {**row[str(k)]} for k in config.frames}
            for one in scores.values():
                del one["F"]
            journal.rows[name] = {"group": row["group"]} | scores
    compare({"F": measured}, prior, chairs, config.frames, journal)
    journal.write({"summary": {group: inside(journal, group, config) for group in groups(journal)}})
    return journal


# ------------------------------------------------------------------ chairs and solids


def voluminous(test: TestSet) -> Iterator[Subject]:
    """The chairs whose surface encloses much of the grid, its own voxels too."""
    for chair in track(subjects(test), description="voluminous chairs"):
        model = load_object(chair.item)
        if isinstance(model, Skipped):
            continue
        points = sample_surface(model.mesh, SURFACE_SAMPLES, seed=0).astype(np.float32)
        surface = discretize(points, fit_box(*jnp.float32(model.mesh.bounds)))
        if solid(surface).mean() > ENCLOSED:
            yield chair


@jax.jit
def solid(surface: Bool[Array, "*batch x y z"]) -> Bool[Array, "*batch x y z"]:
    """A surface with everything inside it: all voxels that no path of free voxels connects with the
    outside."""
    batch = surface.ndim - 3
    free = jnp.pad(~surface, [(0, 0)] * batch + [(1, 1)] * 3, constant_values=True)
    around = jnp.zeros_like(free).at[..., 0, 0, 0].set(True)

    def spread(found):
        _, outside = found
        grown = outside
        for axis in (-3, -2, -1):
            # rolling joins opposite borders, which lie outside alike
            grown |= jnp.roll(outside, 1, axis) | jnp.roll(outside, -1, axis)
        return outside, grown & free

    changes = lambda found: jnp.any(found[0] != found[1])  # noqa: E731
    _, outside = jax.lax.while_loop(changes, spread, spread((around, around)))
    return ~outside[..., 1:-1, 1:-1, 1:-1]


def measured(keys: Any, prior: ShapePrior, case: Case) -> Scores:
    """The bounds, and the empty share of the occluded voxels, for true surfaces and solids."""
    (occupied, occluded, _), surface = case
    filled = solid(surface)
    as_solid = bounds(occupied, occluded, filled)._asdict()
    hidden = jnp.maximum(occluded.sum(axis=(-3, -2, -1)), 1)
    return {
        **measurement(keys, prior, case),
        **{f"solid_{name}": value for name, value in as_solid.items()},
        "empty": (occluded & ~surface).sum(axis=(-3, -2, -1)) / hidden,
        "solid_empty": (occluded & ~filled).sum(axis=(-3, -2, -1)) / hidden,
        "enclosed": filled.mean(axis=(-3, -2, -1)),
    }


def inside(journal: Journal, group: str, config: Config) -> dict[str, Any]:
    """The summary of a group, with the bounds for solids and the empty shares."""
    more = {
        name: [column(journal, group, k, "F", score) for k in config.frames]
        for name, score in INSIDE.items()
    }
    return summary(journal, group, config.frames, more)


# ------------------------------------------------------------------ figures


def plot(journal: Journal, config: Config) -> None:
    """A panel for each group of chairs."""
    plot_curves(config.results / "iou_by_frames", journal, config.frames, "{} {} chairs")


def plot_voluminous(journal: Journal, config: Config) -> None:
    """A panel for each group of voluminous chairs."""
    title = "{} voluminous {} chairs"
    plot_curves(config.results / "voluminous", journal, config.frames, title)


if __name__ == "__main__":
    main(tyro.cli(Config))
