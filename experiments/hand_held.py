r"""Seats in a room, filmed by hand from close up: is the whole seat found, or is there a warning?

    python experiments/hand_held.py --meshes cad_chairs/

Each seat stands on a floor, in front of a wall, with a table next to it. The camera begins so close
that the legs are out of view, moves back and then around the seat, with a little shaking and a
Kinect's noise. Its poses are given, and one click marks the seat in the first frame. A seat is
whole if all four sides of its box lie within 4 cm of the truth. A result is wrong if a side or the
height does not, and no result may be wrong without a warning or a verdict other than good.

Results: experiments/results/hand_held.json, seat by seat: a killed run resumes.
"""

import tempfile
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import jaxlie
import numpy as np
import trimesh
import tyro

import runs
from filming import among_boxes, film, look_from
from jaxshape.data import meshes
from jaxshape.data.boxes import Box
from jaxshape.data.render import render_depth
from jaxshape.data.sequences import open_sequence
from jaxshape.geometry.camera import Intrinsics
from jaxshape.mapping.map.mapper import Mapper
from jaxshape.mapping.placement.finding import find_start
from jaxshape.mapping.segmentation.segment import Prompt
from jaxshape.model.shapes import ShapePrior
from jaxshape.process import prepare_process
from jaxshape.results.journal import Journal
from rebuilding import judgement, meshed, middle_pixel, rebuilt, usual

WIDTH, HEIGHT, FOCAL = 160, 120, 140.0
NEAR = 0.04
"""Largest error of a side of the box that counts as right, in metres."""
T_WORLD_OBJECT = np.array([[0, 0, 1, 2], [0, 1, 0, 1], [-1, 0, 0, -3], [0, 0, 0, 1]], float)


@dataclass(frozen=True)
class Config(runs.SeatsConfig):
    """Settings of the experiment."""

    seats: int = 24
    """Number of seats, spread over all seats."""
    frames: int = 12


def main(config: Config) -> None:
    prepare_process()
    print(summary(run(config.reduced(seats=1, frames=3)).rows)["summary"])


def run(config: Config) -> Journal:
    """Rebuild every seat, going on from earlier results of the same settings."""
    journal = config.journal(
        "hand_held", seats=config.seats, frames=config.frames, meshes=config.meshes.name
    )
    placer, mapper = usual()
    tasks = {
        one.name: partial(_rebuilt, one, config.frames, mapper, placer) for one in config.chosen()
    }
    runs.complete(journal, tasks, summary, _line)
    return journal


def _line(one: dict[str, Any]) -> str:
    sides = " ".join(f"{100 * x:+.0f}" for x in one["sides"])
    return f"sides [{sides}] cm  {one['verdict']}, {len(one['warnings'])} warnings"


def summary(seats: dict[str, Any]) -> dict[str, Any]:
    """Numbers of whole seats, and of wrong results with and without a warning."""
    good = {name for name, one in seats.items() if one["verdict"] == "good"}
    said = {name for name, one in seats.items() if one["warnings"]}
    wrong = {name for name, one in seats.items() if np.abs(one["sides"]).max() > NEAR}
    counts = {
        "seats": len(seats),
        "whole": sum(_is_whole(one["sides"]) for one in seats.values()),
        "wrong": len(wrong),
        "wrong and not said": len(wrong & good - said),
        "right and good": len(good - wrong),
    }
    return {"summary": counts}


def _is_whole(sides: list[float]) -> bool:
    return all(abs(sides[i]) < NEAR for i in (0, 2, 3, 5))


# One seat ---------------------------------------------------------------------------------------


class Recorded(NamedTuple):
    """A recording on disk, and its ground truth."""

    folder: Path
    click: tuple[float, float]
    middle: np.ndarray
    size: np.ndarray


def _rebuilt(
    source: meshes.MeshSource, frames: int, mapper: Mapper, placer: ShapePrior
) -> dict[str, Any]:
    model = meshes.load(source)
    assert isinstance(model, meshes.Model), model
    began = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        seen = record(Path(folder), model.mesh, frames, seed=len(source.name))
        sequence = open_sequence(seen.folder)
        start = find_start(sequence, placer, Prompt(click=seen.click))
        progress = rebuilt(sequence, start, placer, mapper, use_poses=True)
    return {
        "sides": sides_of(progress.start.box, seen).round(4).tolist(),
        "true_size": seen.size.round(4).tolist(),
        **judgement(progress, meshed(progress)),
        "cpu_seconds": round(time.process_time() - began, 1),
    }


def sides_of(box: Box, seen: Recorded) -> np.ndarray:
    """Offsets of the ends of the box from the true ones: three lower, three upper, in metres."""
    corners = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3), axis=-1).reshape(-1, 3) * box.size
    world = corners @ box.T_world_object[:3, :3].T + box.T_world_object[:3, 3]
    found = (world - T_WORLD_OBJECT[:3, 3]) @ T_WORLD_OBJECT[:3, :3] - seen.middle
    lower, upper = found.min(axis=0) + seen.size / 2, found.max(axis=0) - seen.size / 2
    return np.concatenate([lower, upper])


# The recording ----------------------------------------------------------------------------------


def record(folder: Path, mesh: trimesh.Trimesh, frames: int, seed: int) -> Recorded:
    """Film a seat in its room, and write it in the 7-Scenes layout."""
    rng = np.random.default_rng(seed)
    T = _path(mesh.bounds, frames, rng)
    rows = (HEIGHT, WIDTH)
    clean = film(folder, _in_a_room(mesh), T, rows, FOCAL, rng, T_WORLD_OBJECT @ T)
    lens = Intrinsics(*jnp.float32([FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]))
    first = jaxlie.SE3.from_matrix(jnp.float32(T[:1]))
    alone, _ = render_depth(mesh, first, lens, rows)
    shown = np.isfinite(alone[0]) & (alone[0] < clean[0] + 1e-4)
    return Recorded(
        folder, middle_pixel(shown), mesh.bounds.mean(axis=0), np.asarray(mesh.extents, float)
    )


def _in_a_room(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The seat with a floor, a wall 0.9 m behind it and a table 12 cm beside it."""
    (_, floor, behind), (right, _, _) = mesh.bounds
    near, far = right + 0.12, right + 1.12
    boxes = [
        ((-3, floor - 0.1, -3), (4, floor, 4)),
        ((-3, floor, behind - 1), (4, floor + 2.5, behind - 0.9)),
        ((near, floor + 0.7, -0.45), (far, floor + 0.74, 0.45)),
        *(
            ((x - 0.03, floor, z - 0.03), (x + 0.03, floor + 0.7, z + 0.03))
            for x in (near + 0.06, far - 0.06)
            for z in (-0.39, 0.39)
        ),
    ]
    return among_boxes([mesh], boxes)


def _path(bounds: np.ndarray, frames: int, rng: np.random.Generator) -> np.ndarray:
    """Camera poses: near the upper part, back until all is visible, then 110 degrees around."""
    middle, (width, height, depth) = bounds.mean(axis=0), np.ptp(bounds, axis=0)
    radius = np.linalg.norm([width, height, depth]) / 2
    along = np.linspace(0, 1, frames)
    away = np.minimum(1, along / 0.45)
    azimuth = np.deg2rad(rng.uniform(-20, 45) - 110 * along**1.3)
    distance = radius + 0.45 + away * (1 + 0.15 * np.sin(5 * along))
    eye = np.stack([distance * np.sin(azimuth), 0 * along, distance * np.cos(azimuth)], axis=1)
    eye[:, 1] = bounds[0, 1] + 0.8 * height + 0.35 + 0.35 * away - middle[1]
    target = np.stack([0 * along, bounds[0, 1] + height * (0.85 - 0.38 * away) - middle[1],
                       0 * along], axis=1)  # fmt: skip
    eye, target = eye + rng.normal(0, 0.01, eye.shape), target + rng.normal(0, 0.02, eye.shape)
    return np.stack([look_from(middle + a, middle + b) for a, b in zip(eye, target, strict=True)])


if __name__ == "__main__":
    main(tyro.cli(Config))
