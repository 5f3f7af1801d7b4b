r"""Tracking and mapping of orbits whose poses are not given: drift, and what it does to the shape.

    python experiments/tracked_orbits.py --meshes cad_chairs/

32 CAD seats, a full orbit each of 36 frames 10 degrees apart, 240 x 240 pixels with a Kinect's
noise from 1.2 diagonals away. Given: the first pose and the object's box. Four systems: tracked
against the last keyframe only or against the map as well, keyframes realigned with the refined
shape or not; beside them, the shape with the true poses.

ATE is the root mean square, over all frames that were tracked, of the distance between the tracked
and the true camera, without alignment, for the first pose is given; as a share of the diagonal of
the object's bounding box in the figure, in mm in the table. IoU is that of the refined and of the
composed surface voxels after each keyframe.

Results: experiments/results/tracked_orbits.json and .png; a seat that is done is not run again.
Time: 35 minutes on two cores.
"""

import json
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import tyro
from matplotlib.figure import Figure

from jaxshape.data import meshes
from jaxshape.data.boxes import Box
from jaxshape.data.capture import Capture, capture
from jaxshape.files import atomic_path
from jaxshape.geometry import camera
from jaxshape.mapping.config import MappingConfig, TrackingConfig
from jaxshape.mapping.incremental import Mapper, Shot, Step, build_mapper
from jaxshape.mapping.views import view_of
from jaxshape.model.weights import load_prior
from jaxshape.process import prepare_process
from jaxshape.refine.config import RefineConfig
from jaxshape.refine.reconstruction import refiner_for
from jaxshape.results.metrics import iou

RESULTS = Path(__file__).parent / "results"

SYSTEMS = {
    "keyframe": (TrackingConfig(against="keyframe"), MappingConfig(realign=False)),
    "keyframe, realigned": (TrackingConfig(against="keyframe"), MappingConfig()),
    "map": (TrackingConfig(), MappingConfig(realign=False)),
    "map, realigned": (TrackingConfig(), MappingConfig()),
}
TRUE_POSES = "true poses"


@dataclass(frozen=True)
class Config:
    """Settings of the experiment."""

    meshes: Path = Path("cad_chairs")
    """Folder or archive of seats, +y up and +z in front."""
    seats: int = 32
    """How many of them, spread over all."""
    frames: int = 36
    step: float = 10.0
    """Degrees between frames."""
    distance: float = 1.2
    """Of the camera from the object's centre, in diagonals of its bounding box."""
    image_size: int = 240
    iterations: int = 25
    """Of CMA-ES after each keyframe."""
    workers: int = 2
    results: Path = RESULTS
    smoke: bool = False
    """One seat, few frames, in seconds: does it run?"""


def main(config: Config) -> None:
    if config.smoke:
        config = replace(config, seats=1, frames=4, image_size=96, iterations=2, workers=1)
    metrics = run(config)
    plot(metrics, config.results / "tracked_orbits.png")
    for name, figures in metrics["summary"].items():
        print(name.ljust(20), figures)


def run(config: Config) -> dict[str, Any]:
    """Run every system on every seat, going on from earlier results of the same settings."""
    path = config.results / "tracked_orbits.json"
    settings = {k: v for k, v in asdict(config).items() if k not in ("results", "workers")}
    settings["meshes"] = config.meshes.name
    done = _earlier(path, settings)
    missing = {name: one for name, one in _choose(config).items() if name not in done}
    with ProcessPoolExecutor(config.workers, get_context("spawn"), prepare_process) as pool:
        futures = {pool.submit(_run_seat, one, config): name for name, one in missing.items()}
        for number, future in enumerate(as_completed(futures), start=1):
            done[futures[future]] = future.result()
            print(f"{number} of {len(missing)} seats", flush=True)
            metrics = {"settings": settings, "summary": summarize(done), "seats": done}
            with atomic_path(path) as temporary:
                temporary.write_text(json.dumps(metrics, indent=1))
    return {"settings": settings, "summary": summarize(done), "seats": done}


def _earlier(path: Path, settings: dict[str, Any]) -> dict[str, Any]:
    if not path.is_file():
        return {}
    earlier = json.loads(path.read_text())
    return earlier["seats"] if earlier["settings"] == settings else {}


def _choose(config: Config) -> dict[str, meshes.MeshSource]:
    """Seats from all over the collection, by name."""
    sources = meshes.list_meshes(config.meshes)
    chosen = np.linspace(0, len(sources) - 1, config.seats).round().astype(int)
    return {sources[i].name: sources[i] for i in chosen}


# One seat ------------------------------------------------------------------------------------


def _run_seat(source: meshes.MeshSource, config: Config) -> dict[str, Any]:
    model = meshes.load(source)
    assert isinstance(model, meshes.Model), model
    mesh = model.mesh
    T = camera.orbit(config.frames, config.distance * float(mesh.scale), step=config.step)
    seen = capture(mesh, T, noise=True, seed=0, image_size=config.image_size)
    shots = [_prepare(depth, seen.intrinsics) for depth in np.asarray(seen.depth)]
    box = Box(np.eye(4), np.asarray(mesh.extents, np.float64))
    outcome = {
        system: _follow(_mapper(*settings, config.iterations), shots, box, seen, given=False)
        for system, settings in SYSTEMS.items()
    }
    mapper = _mapper(*SYSTEMS["keyframe"], config.iterations)
    outcome[TRUE_POSES] = _follow(mapper, shots, box, seen, given=True)
    return {"diagonal": float(mesh.scale), **outcome}


_mappers: dict[Any, Mapper] = {}  # of this process; each is compiled once


def _mapper(track: TrackingConfig, mapping: MappingConfig, iterations: int) -> Mapper:
    settings = (track, replace(mapping, keyframe_iterations=iterations))
    if settings not in _mappers:
        prior, search = load_prior(), RefineConfig(iterations=iterations)
        refiner = refiner_for("cma", prior, search)
        _mappers[settings] = build_mapper(prior, refiner, search, settings[1], track)
    return _mappers[settings]


@jax.jit
def _prepare(depth, intrinsics) -> Shot:
    return Shot(view_of(depth, intrinsics), jnp.ones(depth.shape, bool))


def _follow(
    mapper: Mapper, shots: list[Shot], box: Box, seen: Capture, *, given: bool
) -> dict[str, Any]:
    true = [jaxlie.SE3(pose) for pose in seen.T_object_camera.wxyz_xyz]
    state, step = mapper.init(shots[0], box, true[0], poses_are_given=given)
    live, shapes, seconds = {0: true[0]}, [_scores(step, seen)], []
    frames_of_keyframes = [0]
    for i, shot in enumerate(shots[1:], start=1):
        state, step = mapper.step(state, shot, true[i] if given else None)
        if step.T_world_camera is not None:
            live[i] = step.T_world_camera
        if step.status == "keyframe":
            frames_of_keyframes.append(i)
            shapes.append(_scores(step, seen))
            seconds.append(step.seconds)
    keyframes = {
        i: one.T_world_camera for i, one in zip(frames_of_keyframes, state.keyframes, strict=True)
    }
    return {
        "ate_mm": _ate(live, true),
        "keyframe_ate_mm": _ate(keyframes, true),
        "lost": len(shots) - len(live),
        "keyframes": frames_of_keyframes,
        "iou": [shape[0] for shape in shapes],
        "iou_composed": [shape[1] for shape in shapes],
        "seconds": seconds,
    }


def _scores(step: Step, seen: Capture) -> tuple[float, float]:
    assert step.shape is not None
    shapes = (step.shape.completed[0], step.shape.composed[0])
    return tuple(round(float(iou(shape, seen.surface)), 4) for shape in shapes)  # pyright: ignore


def _ate(poses: dict[int, jaxlie.SE3], true: list[jaxlie.SE3]) -> float:
    """Root mean square distance between cameras, in mm."""
    squares = [
        np.sum((np.asarray(T.translation()) - np.asarray(true[i].translation())) ** 2)
        for i, T in poses.items()
    ]
    return round(1000 * float(np.sqrt(np.mean(squares))), 2)


# All seats -----------------------------------------------------------------------------------


def summarize(seats: dict[str, Any]) -> dict[str, Any]:
    """Medians and means over the seats, for each system."""
    summary = {}
    for system in (*SYSTEMS, TRUE_POSES):
        each = [seat[system] for seat in seats.values()]
        live = np.array([one["ate_mm"] for one in each])
        keyframes = np.array([one["keyframe_ate_mm"] for one in each])
        sizes = np.array([seat["diagonal"] for seat in seats.values()])
        summary[system] = {
            "ate_mm_median": round(float(np.median(live)), 2),
            "ate_mm_mean": round(float(live.mean()), 2),
            "keyframe_ate_mm_median": round(float(np.median(keyframes)), 2),
            "keyframe_ate_mm_mean": round(float(keyframes.mean()), 2),
            "keyframe_ate_percent_mean": round(float((keyframes / sizes / 10).mean()), 3),
            "lost": sum(one["lost"] for one in each),
            "iou": round(float(np.mean([one["iou"][-1] for one in each])), 4),
            "iou_composed": round(float(np.mean([one["iou_composed"][-1] for one in each])), 4),
        }
    return summary


def plot(metrics: dict[str, Any], path: Path) -> None:
    """Drift of the keyframes, seat by seat, and IoU against the number of keyframes."""
    seats = list(metrics["seats"].values())
    figure = Figure(figsize=(10, 3.8), layout="constrained")
    drift, shape = figure.subplots(1, 2)
    colors = ["#B4BBC2", "#56B4E9", "#E69F00", "#0072B2", "#2B2F33"]
    for system, color in zip(SYSTEMS, colors, strict=False):
        percent = [100 * s[system]["keyframe_ate_mm"] / 1000 / s["diagonal"] for s in seats]
        share = np.arange(1, len(seats) + 1) / len(seats)
        drift.step(np.sort(percent), share, where="post", color=color, label=system, lw=2)
    drift.set(xscale="log", xlabel="ATE of the keyframes, % of the diagonal", ylim=(0, 1.02))
    drift.set_ylabel("share of the seats")
    drift.legend(frameon=False)
    for system, color in zip((*SYSTEMS, TRUE_POSES), colors, strict=True):
        longest = max(len(s[system]["iou_composed"]) for s in seats)
        curves = [[s[system]["iou_composed"][min(i, len(s[system]["iou_composed"]) - 1)]
                   for s in seats] for i in range(longest)]  # fmt: skip
        style = "--" if system == TRUE_POSES else "-"
        shape.plot(np.arange(1, longest + 1), np.mean(curves, axis=1), style, color=color,
                   label=system)  # fmt: skip
    shape.set(xlabel="keyframes", ylabel="IoU of the composed shape, mean")
    shape.legend(frameon=False)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=150)


if __name__ == "__main__":
    main(tyro.cli(Config))
