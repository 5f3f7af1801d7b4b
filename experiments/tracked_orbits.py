r"""Tracking and mapping of orbits without given poses: drift, and its effect on the shape.

    python experiments/tracked_orbits.py --meshes cad_chairs/

32 CAD seats, each with a full orbit of 36 frames 10 degrees apart, 240 x 240 pixels with a Kinect's
noise, at a distance of 1.2 diagonals. The first pose and the object's box are given. There are four
systems: frames are tracked against the last keyframe only or against the map as well, and keyframes
are realigned with the refined shape or not. For comparison, a fifth run uses the true poses.

ATE is the root mean square, over the frames that were tracked, of the distance between the final
and the true position of the camera, in mm. `ate` is measured after the rigid motion that fits best,
as is usual; `error` is measured without any motion, because the first pose is given. The figure
shows `ate` as a share of the diagonal of the object's bounding box. IoU is given for the refined
and the composed surface voxels after each keyframe.

Results: experiments/results/tracked_orbits.json and .png; a finished seat is not run again.
Time: 15 minutes on two cores.
"""

import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import tyro
from scipy.spatial.transform import Rotation

import runs
from figures import drawn
from jaxshape.data import meshes
from jaxshape.data.boxes import Box
from jaxshape.data.capture import Capture, capture
from jaxshape.data.virtual_cameras import VirtualCamera
from jaxshape.geometry import camera
from jaxshape.geometry.overlap import iou
from jaxshape.mapping.config import MappingConfig, TrackingConfig
from jaxshape.mapping.map.mapper import Mapper, Step, build_mapper
from jaxshape.mapping.tracking.keyframes import PreparedFrame
from jaxshape.mapping.tracking.views import view_of
from jaxshape.model.weights import load_prior
from jaxshape.process import prepare_process
from jaxshape.report.palette import BLUE, FOG, INK, ORANGE, SKY
from jaxshape.results.journal import Journal
from jaxshape.search.config import RefineConfig
from jaxshape.search.reconstruction import refiner_for

# With 10 degrees a frame, every second one is a keyframe.
MAPPING = MappingConfig(keyframe_angle=15.0, keyframe_distance=9.0, fusion="points")
ALONE = replace(MAPPING, realign=False)
SYSTEMS = {
    "keyframe": (TrackingConfig(against="keyframe"), ALONE),
    "keyframe, realigned": (TrackingConfig(against="keyframe"), MAPPING),
    "map": (TrackingConfig(), ALONE),
    "map, realigned": (TrackingConfig(), MAPPING),
}
TRUE_POSES = "true poses"


@dataclass(frozen=True)
class Config(runs.SeatsConfig):
    """Settings of the experiment."""

    seats: int = 32
    """Number of seats, spread over all seats."""
    frames: int = 36
    step: float = 10.0
    """Degrees between frames."""
    distance: float = 1.2
    """Distance of the camera from the object's centre, in diagonals of its bounding box."""
    image_size: int = 240
    iterations: int = 20
    """Steps of Adam after each keyframe."""
    workers: int = 2


def main(config: Config) -> None:
    config = config.reduced(seats=1, frames=4, image_size=96, iterations=2, workers=1)
    journal = run(config)
    plot(journal.rows, config.results / "tracked_orbits.png")
    for name, figures in summarize(journal.rows).items():
        print(name.ljust(20), figures)


def run(config: Config) -> Journal:
    """Run every system on every seat, and resume from earlier results of the same settings."""
    settings = {k: v for k, v in asdict(config).items() if k not in ("results", "workers")}
    journal = config.journal("tracked_orbits", **settings | {"meshes": config.meshes.name})
    missing = {one.name: one for one in config.chosen() if one.name not in journal.rows}
    began = time.perf_counter()
    with ProcessPoolExecutor(config.workers, get_context("spawn"), prepare_process) as pool:
        futures = {pool.submit(_run_seat, one, config): name for name, one in missing.items()}
        for number, future in enumerate(as_completed(futures), start=1):
            now = time.perf_counter()
            journal.add({futures[future]: future.result()}, now - began)
            began = now
            print(f"{number} of {len(missing)} seats", flush=True)
    journal.write({"summary": summarize(journal.rows)})
    return journal


# One seat ------------------------------------------------------------------------------------


def _run_seat(source: meshes.MeshSource, config: Config) -> dict[str, Any]:
    model = meshes.load(source)
    assert isinstance(model, meshes.Model), model
    mesh = model.mesh
    T = camera.orbit(config.frames, config.distance * float(mesh.scale), step=config.step)
    camera_model = VirtualCamera(config.image_size, config.image_size, None)
    seen = capture(mesh, T, noise=True, seed=0, camera=camera_model)
    shots = [_prepare(depth, seen.intrinsics) for depth in np.asarray(seen.depth)]
    box = Box(np.eye(4), np.asarray(mesh.extents, np.float64))
    outcome = {
        system: _follow(_mapper(*settings, config.iterations), shots, box, seen, given=False)
        for system, settings in SYSTEMS.items()
    }
    mapper = _mapper(*SYSTEMS["keyframe"], config.iterations)
    outcome[TRUE_POSES] = _follow(mapper, shots, box, seen, given=True)
    return {"diagonal": float(mesh.scale), **outcome}


@cache
def _search(iterations: int):
    prior = load_prior("chair-autoencoder")
    search = RefineConfig(iterations=iterations, symmetry=False)
    return prior, refiner_for("gradient:adam", prior, search), search


@cache
def _mapper(track: TrackingConfig, mapping: MappingConfig, iterations: int) -> Mapper:
    mapping = replace(mapping, keyframe_iterations=iterations)
    return build_mapper(*_search(iterations), mapping, track)


@jax.jit
def _prepare(depth, intrinsics) -> PreparedFrame:
    return PreparedFrame(view_of(depth, intrinsics), jnp.ones(depth.shape, bool))


def _follow(
    mapper: Mapper, shots: list[PreparedFrame], box: Box, seen: Capture, *, given: bool
) -> dict[str, Any]:
    true = [jaxlie.SE3(pose) for pose in seen.T_object_camera.wxyz_xyz]
    state, step = mapper.init(shots[0], box, true[0], poses_are_given=given)
    tracked = {0: (0, jaxlie.SE3.identity())}  # frame: its keyframe, and the pose relative to that
    shapes, seconds, keyframes = [_scores(step, seen)], [], [0]
    for i, shot in enumerate(shots[1:], start=1):
        state, step = mapper.step(state, shot, true[i] if given else None)
        if step.status == "keyframe":
            keyframes.append(i)
            shapes.append(_scores(step, seen))
            seconds.append(step.seconds)
        if step.T_world_camera is not None:
            last = state.keyframes[-1].T_world_camera
            tracked[i] = len(keyframes) - 1, last.inverse() @ step.T_world_camera
    found = [state.keyframes[k].T_world_camera @ T for k, T in tracked.values()]
    ours, truth = (
        np.array([np.asarray(T.translation(), np.float64) for T in poses])
        for poses in (found, [true[i] for i in tracked])
    )
    return {
        "ate_mm": _rms_mm(_aligned(ours, truth) - truth),
        "error_mm": _rms_mm(ours - truth),
        "lost": len(shots) - len(tracked),
        "keyframes": keyframes,
        "iou": [shape[0] for shape in shapes],
        "iou_composed": [shape[1] for shape in shapes],
        "seconds": seconds,
    }


def _aligned(points: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Points after the rigid motion that fits them best to the truth (Umeyama, no scale)."""
    centered = points - points.mean(axis=0)
    rotation = Rotation.align_vectors(truth - truth.mean(axis=0), centered)[0]
    return rotation.apply(centered) + truth.mean(axis=0)


def _rms_mm(difference: np.ndarray) -> float:
    return round(1000 * float(np.sqrt(np.mean(np.sum(difference**2, axis=1)))), 3)


def _scores(step: Step, seen: Capture) -> tuple[float, float]:
    assert step.shape is not None
    shapes = (step.shape.completed[0], step.shape.composed[0])
    return tuple(round(float(iou(shape, seen.surface)), 4) for shape in shapes)  # pyright: ignore


# All seats -----------------------------------------------------------------------------------


def summarize(seats: dict[str, Any]) -> dict[str, Any]:
    """Medians and means over the seats, for each system."""
    sizes = np.array([seat["diagonal"] for seat in seats.values()])

    def of(system: str) -> dict[str, Any]:
        each = [seat[system] for seat in seats.values()]
        ate, error = (np.array([one[k] for one in each]) for k in ("ate_mm", "error_mm"))
        last = {k: [one[k][-1] for one in each] for k in ("iou", "iou_composed")}
        return {
            "ate_mm_median": round(float(np.median(ate)), 2),
            "ate_mm_mean": round(float(ate.mean()), 2),
            "ate_percent_median": round(float(np.median(ate / sizes / 10)), 3),
            "error_mm_median": round(float(np.median(error)), 2),
            "error_mm_mean": round(float(error.mean()), 2),
            "lost": sum(one["lost"] for one in each),
        } | {k: round(float(np.mean(values)), 4) for k, values in last.items()}

    return {system: of(system) for system in (*SYSTEMS, TRUE_POSES)}


def plot(rows: dict[str, Any], path: Path) -> None:
    """Drift of the keyframes, seat by seat, and IoU against the number of keyframes."""
    seats, colors = list(rows.values()), [FOG, SKY, ORANGE, BLUE, INK]
    with drawn(path, 10, 3.8) as figure:
        drift, shape = figure.subplots(1, 2)
        for system, color in zip(SYSTEMS, colors, strict=False):
            percent = [100 * s[system]["ate_mm"] / 1000 / s["diagonal"] for s in seats]
            share = np.arange(1, len(seats) + 1) / len(seats)
            drift.step(np.sort(percent), share, where="post", color=color, label=system, lw=2)
        drift.set(xscale="log", xlabel="ATE, % of the diagonal", ylim=(0, 1.02))
        drift.set_ylabel("share of the seats")
        for system, color in zip((*SYSTEMS, TRUE_POSES), colors, strict=True):
            ious = [s[system]["iou_composed"] for s in seats]
            longest = max(map(len, ious))
            curves = [[one[min(i, len(one) - 1)] for one in ious] for i in range(longest)]
            line = {"color": color, "ls": "--" if system == TRUE_POSES else "-"}
            shape.plot(np.arange(1, longest + 1), np.mean(curves, axis=1), label=system, **line)
        shape.set(xlabel="keyframes", ylabel="IoU of the composed shape, mean")
        shape.xaxis.get_major_locator().set_params(integer=True)
        for axes in (drift, shape):
            axes.legend(frameon=False)


if __name__ == "__main__":
    main(tyro.cli(Config))
