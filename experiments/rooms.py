r"""Rooms with several objects, filmed by hand: are they found, classified correctly and rebuilt?

    python experiments/rooms.py

Each room has a floor, a wall, and 3 to 6 objects: procedural chairs and tables that no network was
trained on, and objects of neither class. The images have a Kinect's noise and 320 x 240 pixels; the
given poses err by 4 mm and 0.3 degrees. An object is found if its box overlaps the true one by a
quarter. IoU compares the mesh's voxels with the true voxels, 32 along each side of the true box.
Further rooms hold one chair alone: they give the time that one object takes.

Results: experiments/results/rooms.json, room by room, and rooms.png: a killed run resumes.
"""

import json
import tempfile
import time
from collections import deque
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import trimesh
import tyro

import runs
from filming import among_boxes, film, look_from
from jaxshape.data.boxes import Box, in_object
from jaxshape.data.capture import SURFACE_SAMPLES, discretize
from jaxshape.data.families import FAMILIES, TEST_SEEDS
from jaxshape.data.meshes import sample_surface
from jaxshape.data.sequences import open_sequence
from jaxshape.geometry import grid
from jaxshape.geometry.overlap import iou
from jaxshape.mapping.scene.classes import SceneClasses, build_classes
from jaxshape.mapping.scene.following import Scene, SceneObject, finish_scene, follow_scene
from jaxshape.model.weights import load_prior
from jaxshape.process import prepare_process
from jaxshape.report.figures import save_figure
from jaxshape.report.palette import CYCLE
from jaxshape.results.journal import Journal
from jaxshape.results.output import only, shape_mesh
from jaxshape.results.progress import observation_of
from things import KINDS, thing

SHAPE, FOCAL = (240, 320), 262.5
FOUND = 0.25
"""Least overlap of its box with the true box for an object to be found."""


@dataclass(frozen=True)
class Config(runs.Config):
    """Settings of the experiment."""

    rooms: int = 24
    alone: int = 8
    """Rooms with one chair alone, for the time that one object takes."""
    frames: int = 16
    tables: Path = runs.TABLES
    """Weights for tables."""


class Placed(NamedTuple):
    """A true object of a room."""

    kind: str
    mesh: trimesh.Trimesh
    """Mesh in its own frame, with its box centred at the origin."""
    T_world_object: np.ndarray


def main(config: Config) -> None:
    prepare_process()
    config = config.reduced(rooms=1, alone=0, frames=4)
    journal = run(config)
    draw(journal.rows, config.results / "rooms.png")
    print(json.dumps(summary(journal.rows), indent=1))


def run(config: Config) -> Journal:
    """Rebuild every room, going on from earlier results of the same settings."""
    journal = config.journal("rooms", frames=config.frames)
    priors = {"chair": load_prior("chair"), "table": load_prior(config.tables)}
    classes = build_classes(priors, placers={"chair": load_prior("chair-autoencoder")})
    room = partial(one_room, frames=config.frames, classes=classes)
    tasks = {str(i): partial(room, furnished(i), i) for i in range(config.rooms)}
    tasks |= {f"chair {i} alone": partial(room, furnished(i)[:1], i) for i in range(config.alone)}
    runs.complete(journal, tasks, summary, json.dumps)
    return journal


# One room ---------------------------------------------------------------------------------------


def one_room(
    truth: list[Placed], number: int, frames: int, classes: SceneClasses
) -> dict[str, Any]:
    """Figures of a room with these objects."""
    with tempfile.TemporaryDirectory() as folder:
        record(Path(folder), truth, frames, number)
        sequence = open_sequence(folder)
        began, cpu = time.perf_counter(), time.process_time()
        (scene,) = deque(follow_scene(sequence, classes, use_poses=True), maxlen=1)
        scene = finish_scene(scene, classes)
        seconds = time.perf_counter() - began, time.process_time() - cpu
    matches = matched(truth, scene)
    return {
        "objects": [compared(one, matches.get(i)) for i, one in enumerate(truth)],
        "false": [
            {"class": one.decision.name if one.decision else None,
             "size": one.progress.start.box.size.round(2).tolist()}
            for one in scene.objects if one not in matches.values()
        ],
        "seconds": round(seconds[0], 2),
        "cpu_seconds": round(seconds[1], 2),
        "keyframes": len(scene.camera.state.keyframes),
        "events": scene.tracks.events,
    }  # fmt: skip


def furnished(number: int) -> list[Placed]:
    """The objects of a room: at least one chair, one table and one object of neither class."""
    rng = np.random.default_rng(number)
    kinds = ["chair", "table", str(rng.choice(KINDS))]
    kinds += rng.choice(["chair", "table", *KINDS[:3]], number % 4).tolist()
    placed: list[Placed] = []
    for i, kind in enumerate(kinds):
        seed = 100 * number + i
        mesh = (
            FAMILIES[kind](TEST_SEEDS + 7000 + seed)
            if kind in FAMILIES
            else thing(kind, 7000 + seed)
        )
        placed.append(Placed(kind, mesh, _free_place(mesh, placed, rng)))
    return placed


def _free_place(
    mesh: trimesh.Trimesh, placed: list[Placed], rng: np.random.Generator
) -> np.ndarray:
    """A pose on the floor at which an object stands 25 cm or more apart from the others."""
    radius = np.hypot(*mesh.extents[[0, 2]]) / 2
    for attempt in range(1000):
        reach = 0.9 + attempt / 500
        x, z = rng.uniform(-reach, reach, 2)
        apart = [
            np.hypot(x - one.T_world_object[0, 3], z - one.T_world_object[2, 3])
            - radius - np.hypot(*one.mesh.extents[[0, 2]]) / 2
            for one in placed
        ]  # fmt: skip
        if min(apart, default=1.0) > 0.15:
            break
    T = np.asarray(trimesh.transformations.rotation_matrix(rng.uniform(0, 2 * np.pi), [0, 1, 0]))
    T[:3, 3] = x, mesh.extents[1] / 2, z
    return T


def record(folder: Path, truth: list[Placed], frames: int, seed: int) -> None:
    """Film a room by hand, with poses that err a little."""
    rng = np.random.default_rng([seed, 1])
    meshes = [one.mesh.copy().apply_transform(one.T_world_object) for one in truth]
    bounds = among_boxes(meshes, []).bounds
    behind = bounds[0, 2] - 0.4
    floor, wall = ((-5, -0.1, -5), (5, 0, 5)), ((-5, 0, behind - 0.1), (5, 2.5, behind))
    T = path(bounds, frames, rng)
    written = np.array([_shaken(one, rng) for one in T])
    film(folder, among_boxes(meshes, [floor, wall]), T, SHAPE, FOCAL, rng, written)


def path(bounds: np.ndarray, frames: int, rng: np.random.Generator) -> np.ndarray:
    """Poses along an arc around a room, with a little shaking."""
    middle = bounds.mean(axis=0)
    radius = np.hypot(*np.ptp(bounds, axis=0)[[0, 2]]) / 2 + 0.9
    along = np.linspace(0, 1, frames)
    azimuth = np.deg2rad(rng.uniform(-85, -65) + 150 * along)
    radius = radius * (1 + 0.06 * np.sin(7 * along))
    height = 1.5 + 0.2 * np.sin(5 * along + 1)
    eye = np.stack(
        [middle[0] + radius * np.sin(azimuth), height, middle[2] + radius * np.cos(azimuth)], 1
    )
    target = middle * (1, 0, 1) + [0, 0.4, 0] + rng.normal(0, 0.03, (frames, 3))
    return np.stack(
        [look_from(a, b) for a, b in zip(eye + rng.normal(0, 0.01, eye.shape), target, strict=True)]
    )


def _shaken(T: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A pose that errs by 4 mm and 0.3 degrees along each axis."""
    angles = np.deg2rad(rng.normal(0, 0.3 / np.sqrt(3), 3))
    turn = trimesh.transformations.euler_matrix(*angles)
    turn[:3, 3] = rng.normal(0, 0.004 / np.sqrt(3), 3)
    return T @ turn


# Compared with the truth ------------------------------------------------------------------------


def matched(truth: list[Placed], scene: Scene) -> dict[int, SceneObject]:
    """The found object of each true object: pairs by their overlap, the largest first."""
    overlaps = {
        (i, k): box_overlap(_box(one), found.progress.start.box)
        for i, one in enumerate(truth)
        for k, found in enumerate(scene.objects)
    }
    matches: dict[int, int] = {}
    for i, k in sorted(overlaps, key=lambda pair: (-overlaps[pair], pair)):
        if overlaps[i, k] > FOUND and i not in matches and k not in matches.values():
            matches[i] = k
    return {i: scene.objects[k] for i, k in matches.items()}


def _box(one: Placed) -> Box:
    return Box(one.T_world_object, np.asarray(one.mesh.extents, float))


def box_overlap(a: Box, b: Box) -> float:
    """Intersection over union of two boxes, from points all over both."""
    steps = (np.arange(16) + 0.5) / 16 - 0.5
    unit = np.stack(np.meshgrid(*[steps] * 3, indexing="ij"), axis=-1).reshape(-1, 3)

    def share(one: Box, other: Box) -> float:
        world = unit * one.size @ one.T_world_object[:3, :3].T + one.T_world_object[:3, 3]
        p = in_object(world, other)
        return float((np.abs(p) < other.size / 2).all(axis=1).mean())

    both = (share(a, b) * np.prod(a.size) + share(b, a) * np.prod(b.size)) / 2
    return float(both / (np.prod(a.size) + np.prod(b.size) - both))


def compared(one: Placed, found: SceneObject | None) -> dict[str, Any]:
    """Figures of a true object, compared with the object that was found."""
    figures: dict[str, Any] = {"kind": one.kind, "found": found is not None}
    if found is None or found.decision is None:
        return figures
    box, decision = found.progress.start.box, found.decision
    front = one.T_world_object[:3, :3].T @ box.T_world_object[:3, 2]
    yaw = float(np.degrees(np.arctan2(front[0], front[2])))
    size = np.asarray(one.mesh.extents)
    quarters = round(yaw / 90) % 2
    own = box.size[[2, 1, 0]] if quarters else box.size
    return figures | {
        "class": decision.name,
        "sure": round(decision.sure, 3),
        "scores": decision.scores,
        "yaw": round(yaw, 1),
        "scale": [round(float(x), 3) for x in own / size - 1],
        "iou": round(mesh_iou(one, found), 4),
    }


def mesh_iou(one: Placed, found: SceneObject) -> float:
    """IoU of surface voxels in the true box."""
    assert found.progress.shape is not None
    shape = only(found.progress.shape)
    observation = observation_of(found.progress.state)
    mesh = shape_mesh(observation, shape.composed, shape.fill_logits).mesh
    T = np.linalg.inv(one.T_world_object) @ found.progress.start.box.T_world_object
    mesh = mesh.copy().apply_transform(T)
    bounds = jnp.float32(one.mesh.bounds)
    frame = grid.fit_box(bounds[0], bounds[1])
    grids = [
        discretize(sample_surface(each, SURFACE_SAMPLES, 0).astype(np.float32), frame)
        for each in (mesh, one.mesh)
    ]
    return float(iou(*grids))


def summary(rows: dict[str, Any]) -> dict[str, Any]:
    """Means over all rooms, by class; yaw errors of tables are modulo half a turn."""
    rooms = of_several(rows)
    objects = [one for room in rooms.values() for one in room["objects"]]
    false = [one for room in rooms.values() for one in room["false"]]
    figures: dict[str, Any] = {
        "rooms": len(rooms),
        "objects": len(objects),
        "false objects": len(false),
        "false objects of a class": sum(one["class"] is not None for one in false),
    }
    for kind in ("chair", "table", "neither"):
        those = [one for one in objects if kind_of(one) == kind]
        found = [one for one in those if one["found"]]
        figures[kind] = {"objects": len(those), "found": len(found)}
        for name in ("chair", "table", None):
            figures[kind][f"classed {name}"] = sum(one.get("class") == name for one in found)
        right = [one for one in found if (one.get("class") or "neither") == kind]
        if right:
            figures[kind] |= _errors(kind, right)
    times = {n: [room["cpu_seconds"] for room in rows.values() if len(room["objects"]) == n]
             for n in range(1, 7)}  # fmt: skip
    figures["seconds by objects"] = {
        str(n): round(float(np.median(those)), 1) for n, those in times.items() if those
    }
    return {"summary": figures}


def of_several(rows: dict[str, Any]) -> dict[str, Any]:
    """The rooms in which the objects are not alone."""
    return {name: room for name, room in rows.items() if len(room["objects"]) > 1}


def kind_of(one: dict[str, Any]) -> str:
    """The class of a true object, or `neither`."""
    return one["kind"] if one["kind"] in FAMILIES else "neither"


def _errors(kind: str, right: list[dict[str, Any]]) -> dict[str, float]:
    period = {"chair": 360, "table": 180}.get(kind, 90)
    yaw = [abs((one["yaw"] + period / 2) % period - period / 2) for one in right]
    scale = [max(map(abs, one["scale"])) for one in right]
    return {
        "iou": round(float(np.mean([one["iou"] for one in right])), 3),
        "yaw median": round(float(np.median(yaw)), 1),
        "yaw 90 %": round(float(np.percentile(yaw, 90)), 1),
        "scale median": round(float(np.median(scale)), 3),
    }


def draw(rows: dict[str, Any], path: Path) -> None:
    """Draw the decided class of each kind, and the IoU of the objects that were found."""
    rooms = of_several(rows)
    objects = [one for room in rooms.values() for one in room["objects"]]
    kinds, classes = ["chair", "table", *KINDS], ["chair", "table", "None", "not found"]
    counts = np.zeros((len(kinds), len(classes)), int)
    for one in objects:
        answer = str(one.get("class")) if one["found"] else "not found"
        counts[kinds.index(one["kind"]), classes.index(answer)] += 1

    def plot(figure: Any) -> None:
        left, right = figure.subplots(1, 2)
        left.imshow(counts, cmap="Blues", aspect="auto", vmax=2 * max(counts.max(), 1))
        left.set_xticks(range(len(classes)), ["chair", "table", "of no class", "not found"])
        for (i, j), count in np.ndenumerate(counts):
            left.text(j, i, str(count) if count else "", ha="center", va="center")
        left.set_title(
            f"{len(objects)} objects of {len(rooms)} rooms, and what they were taken for"
        )
        for i, kind in enumerate(kinds):
            values = [one["iou"] for one in objects if one["kind"] == kind and "iou" in one]
            right.plot(values, [i] * len(values), "o", color=CYCLE[0], alpha=0.6)
        right.set_ylim(len(kinds) - 0.5, -0.5)
        right.set_xlim(0, 1)
        right.set_title("IoU with the true surface, in its box")
        for axes in (left, right):
            axes.set_yticks(range(len(kinds)), kinds)

    save_figure(path, (9.6, 3.6), plot)


if __name__ == "__main__":
    main(tyro.cli(Config))
