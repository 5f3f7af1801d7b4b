r"""The object's pose, size and code from a wrong start: 15 degrees, 15 % and 3 cm off.

    python experiments/alignment.py --meshes cad_chairs/

CAD seats with a Kinect's noise, 1, 4 and 8 frames along an arc, true camera poses. The start is
turned by 15 degrees, larger or smaller by 15 % along all axes, shifted by 3 cm, and has the mean
code. From this start, `place` moves box and code together. It is run once by itself, and once with
the faces of the box moved to where the frames saw the object end, as `reconstruct` does after every
placement.

Medians over the seats: yaw error in degrees; error of the extents in per cent, all three axes and
the largest of each seat; distance of the centre in cm. The target is 3 degrees and 2 %.

Results: experiments/results/alignment.json. Time: 20 minutes on one core.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import trimesh
import tyro

import runs
from jaxshape.data import meshes
from jaxshape.data.boxes import Box
from jaxshape.data.render import add_sensor_noise, render_depth
from jaxshape.files import write_json
from jaxshape.geometry import camera
from jaxshape.geometry.camera import Intrinsics
from jaxshape.mapping.placement import placing
from jaxshape.mapping.placement.faces import Cutout, faces_of, fitted
from jaxshape.mapping.placement.placing import Placement
from jaxshape.mapping.placement.rays import RaySamples, pooled, sample_rays
from jaxshape.model.shapes import ShapePrior
from jaxshape.model.weights import load_prior
from jaxshape.process import prepare_process

SHAPE, LENS = (240, 320), Intrinsics(*jnp.float32([280, 280, 160, 120]))
DISTANCE, ELEVATION, STEP = 2.0, 25.0, 30.0
LARGEST = 0.9
"""Largest extent of each seat, in metres."""
TURN, GROW, ASIDE = 15.0, 1.15, 0.03
"""Errors of the start: turn in degrees, size as a factor, and shift in metres."""


@dataclass(frozen=True)
class Config(runs.SeatsConfig):
    """Settings of the experiment."""

    frames: tuple[int, ...] = (1, 4, 8)


def main(config: Config) -> None:
    prepare_process()
    config = config.reduced(seats=1, frames=(1,))
    metrics = run(config)
    write_json(config.results / "alignment.json", metrics)
    for frames, rows in metrics["medians"].items():
        for name, row in rows.items():
            print(f"{frames} frames, {name.ljust(10)} {row}")


def run(config: Config) -> dict[str, Any]:
    """Align every seat with each number of frames; medians of the errors."""
    prior = load_prior("chair-autoencoder")
    each = {str(count): [] for count in config.frames}
    sources = meshes.list_meshes(config.meshes)
    numbers = runs.spread(len(sources), config.seats)
    for number in numbers:
        model = meshes.load(sources[number])
        assert isinstance(model, meshes.Model), model
        mesh = _centred(model.mesh)
        for count in config.frames:
            each[str(count)].append(_align(mesh, count, prior, np.random.default_rng(number)))
    settings = {"meshes": config.meshes.name, "seats": len(numbers), "frames": config.frames}
    return {"settings": settings, "medians": {count: medians(rows) for count, rows in each.items()}}


def medians(rows: list[dict[str, dict[str, Any]]]) -> dict[str, dict[str, float]]:
    """Medians over the seats of each error, for the start and both ways."""

    def of(way: str) -> dict[str, float]:
        figures = {
            "yaw_degrees": [abs(row[way]["yaw"]) for row in rows],
            "extent_percent": [row[way]["extents"] for row in rows],
            "worst_extent_percent": [max(row[way]["extents"]) for row in rows],
            "centre_cm": [row[way]["centre"] for row in rows],
        }
        return {name: round(float(np.median(values)), 2) for name, values in figures.items()}

    return {way: of(way) for way in rows[0]}


def _centred(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    mesh = mesh.copy()
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    mesh.apply_scale(LARGEST / mesh.extents.max())
    return mesh


def _align(
    mesh: trimesh.Trimesh, count: int, prior: ShapePrior, rng: np.random.Generator
) -> dict[str, dict[str, Any]]:
    seen, views = _film(mesh, count, rng)
    wrong = _wrong_start(mesh.extents, prior, rng)
    floor = jnp.float32(-mesh.extents[1] / 2)
    found = _place(prior, seen, floor, wrong)
    box = _box(found)
    exact = fitted(box, faces_of(box, views))
    ways = {"start": _box(wrong), "placed": box, "fitted": exact}
    return {way: errors(one, mesh.extents) for way, one in ways.items()}


def _film(
    mesh: trimesh.Trimesh, count: int, rng: np.random.Generator
) -> tuple[RaySamples, list[Cutout]]:
    """Frames along an arc with a random start: rays, and the depth images."""
    azimuth = rng.uniform(0, 360) + STEP * np.arange(count)
    elevation = jnp.full(count, ELEVATION)
    T = camera.on_sphere(jnp.float32(azimuth), elevation, DISTANCE)
    depth, cosine = render_depth(mesh, T, LENS, SHAPE)
    depth = add_sensor_noise(depth, cosine, rng)
    shown = np.isfinite(depth) & (depth > 0)
    each = [
        _sample(jax.random.key(i), jnp.asarray(depth[i]), jnp.asarray(shown[i]), LENS)
        for i in range(count)
    ]
    poses = np.asarray(T.as_matrix(), np.float64)
    views = list(map(Cutout, depth, shown, [LENS] * count, poses))
    return _pooled(jax.tree.map(lambda *x: jnp.stack(x), *each), T), views


def _wrong_start(extents: np.ndarray, prior: ShapePrior, rng: np.random.Generator) -> Placement:
    yaw, factor = np.radians(TURN) * rng.choice([-1, 1]), GROW ** rng.choice([-1, 1])
    aside = rng.normal(size=3)
    T = jaxlie.SE3.from_rotation_and_translation(
        jaxlie.SO3.from_y_radians(jnp.float32(yaw)),
        jnp.float32(ASIDE * aside / np.linalg.norm(aside)),
    )
    large = jnp.float32(1e3)  # a misfit worse than any other
    return Placement(T, jnp.float32(factor * extents), prior.code_mean, large, jnp.float32(0))


def _box(placement: Placement) -> Box:
    T = np.asarray(placement.T_world_object.as_matrix(), np.float64)
    return Box(T, np.asarray(placement.size, np.float64))


def errors(box: Box, extents: np.ndarray) -> dict[str, Any]:
    """Errors of a box, where the true box is centred and not turned."""
    front = box.T_world_object[:3, 2]
    return {
        "yaw": float(np.degrees(np.arctan2(front[0], front[2]))),
        "extents": (100 * np.abs(box.size / extents - 1)).tolist(),
        "centre": 100 * float(np.linalg.norm(box.T_world_object[:3, 3])),
    }


_place = jax.jit(placing.place, static_argnames="config")
_sample = jax.jit(sample_rays)
_pooled = jax.jit(pooled)

if __name__ == "__main__":
    main(tyro.cli(Config))
