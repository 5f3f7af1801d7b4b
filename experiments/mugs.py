"""A kind of object that is not a chair: procedural mugs, for docs/own_category.md.

    python experiments/mugs.py --output data/mugs

writes 300 mugs as PLY files, +y up and the handle along +x, in metres; a few seconds. Then

    python experiments/mugs.py --output data/mugs --weights out/mug/mug.safetensors

draws docs/mugs.png with mugs held out of the training of these weights: the true mesh, the
measurement of four frames, the encoder's shape, and the shape that CMA-ES finds. Expected: this
picture, with the IoUs under it; about a minute on two cores, most of it compiling.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
import tyro
from jaxtyping import Float, Int
from rich.progress import track

from figures import drawn
from jaxshape.data import meshes
from jaxshape.data.split import hold_out
from jaxshape.data.survey import survey
from jaxshape.files import atomic_path
from jaxshape.geometry.overlap import iou
from jaxshape.model.shapes import ShapePrior
from jaxshape.model.weights import load_prior
from jaxshape.report.palette import COLORS
from jaxshape.report.panels import Panel
from jaxshape.report.pictures import render_mesh, render_voxels
from jaxshape.results.evaluation import Case, observe
from jaxshape.search.reconstruction import reconstruct_jit, refiner_for
from study import SEARCH, SEEN

AZIMUTH = -65.0
"""Azimuth of the pictures, in degrees: it shows the handle in profile, from the side that four
frames do not see."""

Profile = Callable[[Float[np.ndarray, " n"]], Float[np.ndarray, " n"]]
"""Function from a height to the radius there, both in metres."""


@dataclass(frozen=True)
class Config:
    """Number of mugs, output folder, and pictures."""

    output: Path = Path("data/mugs")
    """Folder of the meshes."""
    mugs: int = 300
    """Meshes to write."""
    seed: int = 0
    """Seed of the shapes."""
    weights: Path | None = None
    """Draw mugs held out of the training of these weights."""
    picture: Path = Path("docs/mugs.png")
    """The picture, when there are weights."""
    iterations: int = 100
    """Iterations of the search for the picture."""
    smoke: bool = False
    """Only a dozen mugs, and two iterations."""


# ------------------------------------------------------------------ a mug


def random_mug(seed: int) -> trimesh.Trimesh:
    """A mug that stands on y = 0, its handle along +x, in metres: two closed surfaces."""
    rng = np.random.default_rng(seed)
    height = rng.uniform(0.06, 0.14)
    bottom, top = height * rng.uniform(0.28, 0.5) * np.array([1.0, rng.uniform(0.85, 1.35)])
    bend, belly = rng.uniform(0.6, 1.8), bottom * rng.uniform(-0.12, 0.25)
    wall = rng.uniform(0.003, 0.007)

    def radius(y):
        s = np.clip(y / height, 0, 1)
        return bottom + (top - bottom) * s**bend + belly * np.sin(np.pi * s)

    body, handle = _body(height, wall, radius), _handle(rng, height, wall, radius)
    return cast(trimesh.Trimesh, trimesh.util.concatenate([body, handle]))


def _body(height: float, wall: float, radius: Profile) -> trimesh.Trimesh:
    """A body of revolution: its outline goes from the axis outwards, up, over the rim and down."""
    outer = np.linspace(0, height, 24)
    inner = np.linspace(height, wall, 24)
    outline = np.concatenate([
        [[0, 0]],
        np.stack([radius(outer), outer], axis=1),
        np.stack([radius(inner) - wall, inner], axis=1),
        [[0, wall]],
    ])  # fmt: skip
    body = trimesh.creation.revolve(outline, sections=64)  # about z
    return _facing_outwards(body.vertices[:, [1, 2, 0]], body.faces)


def _handle(
    rng: np.random.Generator, height: float, wall: float, radius: Profile
) -> trimesh.Trimesh:
    """An ellipse swept along half a superellipse in the plane z = 0, its ends inside the wall."""
    length = height * rng.uniform(0.4, 0.75)
    middle = rng.uniform(0.15 * height + length / 2, 0.92 * height - length / 2)
    reach, roundness = height * rng.uniform(0.2, 0.4), rng.uniform(2, 4)
    thickness, width = rng.uniform(0.003, 0.006), rng.uniform(0.004, 0.009)  # half of each
    angle = np.linspace(-np.pi / 2, np.pi / 2, 33)
    y = middle + length / 2 * np.sign(angle) * np.abs(np.sin(angle)) ** (2 / roundness)
    x = radius(y) - wall / 2 + reach * np.abs(np.cos(angle)) ** (2 / roundness)
    tangent = np.gradient(np.stack([x, y], axis=1), axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    around = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    across = thickness * np.cos(around)
    rings = np.stack(
        np.broadcast_arrays(
            x[:, None] + across * tangent[:, 1:],
            y[:, None] - across * tangent[:, :1],
            width * np.sin(around),
        ),
        axis=-1,
    )
    return _facing_outwards(rings.reshape(-1, 3), _tube_faces(len(angle), len(around)))


def _tube_faces(rings: int, sides: int) -> Int[np.ndarray, "n 3"]:
    """Triangles between the rings of a tube, and a fan over each end."""
    ring, side = np.mgrid[: rings - 1, :sides].reshape(2, -1)
    here, beside = ring * sides + side, ring * sides + (side + 1) % sides
    walls = [(here, here + sides, beside), (beside, here + sides, beside + sides)]
    fan = np.arange(1, sides - 1)
    last = (rings - 1) * sides
    ends = [(0 * fan, fan, fan + 1), (last + 0 * fan, last + fan + 1, last + fan)]
    return np.concatenate([np.stack(corners, axis=1) for corners in (*walls, *ends)])


def _facing_outwards(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "n 3"]
) -> trimesh.Trimesh:
    mesh = trimesh.Trimesh(vertices, faces)
    if mesh.volume < 0:
        mesh.invert()
    return mesh


# ------------------------------------------------------------------ files and a picture


def run(config: Config) -> list[str]:
    """Write the mugs; returns their names."""
    names = [f"mug-{i:04d}" for i in range(12 if config.smoke else config.mugs)]
    for i, name in enumerate(track(names, "mugs")):
        with atomic_path(config.output / f"{name}.ply") as path:
            random_mug(config.seed * 1_000_000 + i).export(path)
    return names


def draw(mesh: trimesh.Trimesh, case: Any, found: Any) -> list[Panel]:
    """A mug: the mesh, its measurement in four frames (`Case`), and its `Reconstruction`."""
    occupied, occluded, _ = case.grids
    composed = np.where(occluded, 2 * found.composed, occupied.astype(int))

    def picture(title: str, labels: Any, *colors: str, scored: Any = None) -> Panel:
        note = "" if scored is None else f"IoU {float(iou(scored, case.surface)):.2f}"
        palette = [COLORS[color] for color in colors]
        return Panel(title, render_voxels(labels, palette, azimuth=AZIMUTH), note)

    first, refined = found.completed_first, found.completed
    return [
        Panel("a mug", render_mesh(mesh, color=COLORS["truth"], azimuth=AZIMUTH)),
        picture("on the grid", case.surface, "truth"),
        picture("F, four frames", occupied, "measured", scored=occupied),
        picture("encoder", first, "predicted", scored=first),
        picture("refined", refined, "predicted", scored=refined),
        picture("composed", composed, "measured", "predicted", scored=found.composed),
    ]


def plot(config: Config, prior: ShapePrior, rows: int = 4) -> None:
    """Draw mugs held out of training, a row for each."""
    found = dict(survey(meshes.list_meshes(config.output), front="x", workers=1))
    held_out = hold_out([found[i] for i in sorted(found)])[1][:rows]
    models = [cast(meshes.Model, meshes.load(one.source, front="x")) for one in held_out]
    seen = [cast(Case, observe(model, replace(SEEN, frames=(4,)))) for model in models]
    cases = jax.tree.map(lambda *x: jnp.concatenate(x), *seen)
    search = replace(SEARCH, iterations=2 if config.smoke else config.iterations)
    rebuild = reconstruct_jit(refiner_for("cma", prior, search), search)
    keys = jax.random.split(jax.random.key(0), len(models))
    found = rebuild(keys, prior, cases.grids.occupied, cases.grids.occluded)
    pictures = [
        draw(model.mesh, *jax.device_get(jax.tree.map(lambda x, i=i: x[i], (cases, found))))
        for i, model in enumerate(track(models, "pictures"))
    ]
    columns = len(pictures[0])
    with drawn(config.picture, 2.2 * columns, 2.4 * len(pictures), dpi=100) as figure:
        axes = figure.subplots(len(pictures), columns, squeeze=False)
        for axis, panel in zip(axes.flat, itertools.chain(*pictures), strict=True):
            axis.imshow(panel.image)
            axis.set_axis_off()
            axis.text(0.5, -0.02, panel.note, ha="center", va="top", transform=axis.transAxes)
        for axis, panel in zip(axes[0], pictures[0], strict=True):
            axis.set_title(panel.title, weight="bold")


def main(config: Config) -> list[str]:
    names = run(config)
    if config.weights:
        plot(config, load_prior(config.weights))
    return names


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
