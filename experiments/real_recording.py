r"""A real recording rebuilt three ways: with all given poses, with the first pose, with only a
click.

    python experiments/real_recording.py --recording kitchen/frames \
        --box experiments/kitchen_chair_box.json --click 240 150

The experiment of the paper's figure on real data (real_cma_au), on a recording that anyone can get:
the red kitchen of 7-Scenes, sequence 01, every fifth of frames 0 to 265. It shows a slatted chair
half hidden by a table. `given` takes the poses and the box. `first` takes the first pose and the
box, and tracks the other frames. `click` gets only one pixel of the first frame: no pose, no box,
no floor, no scale.

Compared with the given poses: distance and angle between cameras, as root mean square and maximum,
and how well depth images agree with each other under the given and under our poses (root mean
square distance of a keyframe's points to the planes of the one before, after the same matching).
The last figure shows that the given poses are not exact either.

Results: experiments/results/real_recording.json and .png (the meshes from three sides, no image of
the recording). Time: 5 minutes on two busy cores.
"""

import json
from collections import deque
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro

from jaxshape.data.boxes import Box, read_box
from jaxshape.data.sequences import Sequence, open_sequence
from jaxshape.files import write_json
from jaxshape.mapping.config import MappingConfig, TrackingConfig
from jaxshape.mapping.map.mapper import Mapper, build_mapper
from jaxshape.mapping.map.recording import Progress, follow, trajectory
from jaxshape.mapping.map.state import grids_of
from jaxshape.mapping.placement.finding import find_start
from jaxshape.mapping.segmentation.segment import Prompt
from jaxshape.mapping.tracking import icp
from jaxshape.mapping.tracking.keyframes import as_pose, prepare
from jaxshape.mapping.tracking.registration import displacement
from jaxshape.model.shapes import ShapePrior
from jaxshape.model.weights import load_prior
from jaxshape.process import prepare_process
from jaxshape.report.panels import Panel, grid_panel, write_panels
from jaxshape.report.pictures import render_mesh
from jaxshape.results.output import SMOOTHING
from jaxshape.results.surface import surface
from jaxshape.search.config import RefineConfig
from jaxshape.search.reconstruction import refiner_for

RESULTS = Path(__file__).parent / "results"
SIDES = {"front": 35.0, "side": 125.0, "back": -145.0}
WAYS = ("given", "first", "click")


@dataclass(frozen=True)
class Config:
    """Settings of the experiment."""

    recording: Path = Path("kitchen/frames")
    """A recording with poses."""
    box: Path = Path("experiments/kitchen_chair_box.json")
    """The object's box in the world of these poses."""
    click: tuple[float, float] = (240, 150)
    """A pixel of the object in the first frame."""
    iterations: int = 100
    """Iterations of CMA-ES at the end; after each keyframe, `MappingConfig.keyframe_iterations`."""
    results: Path = RESULTS
    smoke: bool = False
    """Few frames and iterations, in seconds, as a test."""


def main(config: Config) -> None:
    metrics, meshes = run(replace(config, iterations=2) if config.smoke else config)
    write_json(config.results / "real_recording.json", metrics)
    plot(meshes, config.results / "real_recording.png")
    print(json.dumps(metrics["ways"], indent=1))


def run(config: Config) -> tuple[dict[str, Any], dict[str, list[Panel]]]:
    """Rebuild the object each way; return figures, and pictures of the meshes."""
    sequence, box, prior = (
        open_sequence(config.recording),
        read_box(config.box),
        load_prior("chair-autoencoder"),
    )
    search = RefineConfig(iterations=config.iterations, symmetry=False)
    iterations = 2 if config.smoke else MappingConfig.keyframe_iterations
    mapping = MappingConfig(fusion="points", keyframe_iterations=iterations)
    refiner = refiner_for("cma", prior, search)
    mapper = build_mapper(prior, refiner, search, mapping, TrackingConfig())
    metrics, meshes = {}, {}
    for way in WAYS:
        metrics[way], meshes[way] = _rebuild(way, config, sequence, box, prior, mapper)
        print(way, metrics[way], flush=True)
    settings = asdict(config) | {"recording": config.recording.name, "box": config.box.name}
    settings.pop("results")
    return {"settings": settings, "ways": metrics}, meshes


def _rebuild(
    way: str,
    config: Config,
    sequence: Sequence,
    box: Box,
    prior: ShapePrior,
    mapper: Mapper,
) -> tuple[dict[str, Any], list[Panel]]:
    prompt = Prompt(click=config.click)
    alone = way == "click"
    start = find_start(sequence, prior, prompt, box=None if alone else box, use_pose=not alone)
    chosen = range(start.index, len(sequence), 4 if config.smoke else 1)
    steps = follow(sequence, start, mapper, prior, chosen=chosen, use_poses=way == "given")
    progress = deque(steps, maxlen=1).pop()  # the last
    state, shape = mapper.finish(progress.state)
    assert shape is not None
    progress = progress._replace(state=state)
    found = progress.start.box
    T_world_first = _given_pose(sequence, start.index) if alone else np.eye(4)
    found = found._replace(T_world_object=T_world_first @ found.T_world_object)
    figures = {
        "frames": len(progress.logs),
        "tracked": len(trajectory(progress)),
        "keyframes": len(state.keyframes),
        **_against_given(progress, sequence, T_world_first),
        **_against_box(found, box),
        "depth_agreement_mm": _depth_agreement(progress, sequence),
        "objective_encoder": round(float(shape.first_objective[0]), 4),
        "objective_refined": round(float(shape.objective[0]), 4),
        "seconds_per_part": _seconds(progress),
    }
    mesh = surface(shape.composed[0], state.place.frame, smoothing=SMOOTHING)
    occupied = np.asarray(grids_of(state).occupied)
    title = {"given": "poses given", "first": "first pose given", "click": "a click"}[way]
    panels = [grid_panel(f"{title}: F", occupied, "measured")]
    panels += [Panel(side, render_mesh(mesh, azimuth=a, size=400)) for side, a in SIDES.items()]
    return figures, panels


def _given_pose(sequence: Sequence, index: int) -> np.ndarray:
    given = sequence.read_pose(index)
    assert given is not None, f"{sequence.names[index]} has no pose to compare with."
    return given


def _against_given(
    progress: Progress, sequence: Sequence, T_world_first: np.ndarray
) -> dict[str, float]:
    """Camera error in cm and degrees, in the world of the given poses; no alignment."""
    errors = [
        displacement(as_pose(T_world_first @ T), as_pose(given))
        for i, T in trajectory(progress).items()
        if (given := sequence.read_pose(i)) is not None
    ]
    distance, angle = np.array(errors).T
    return {
        "rms_cm": round(100 * float(np.sqrt(np.mean(distance**2))), 2),
        "max_cm": round(100 * float(distance.max()), 2),
        "rms_degrees": round(float(np.sqrt(np.mean(angle**2))), 2),
        "max_degrees": round(float(angle.max()), 2),
    }


def _against_box(found: Box, given: Box) -> dict[str, Any]:
    """Differences between the box found and the box made by hand."""
    between = np.linalg.inv(given.T_world_object) @ found.T_world_object
    return {
        "box_center_cm": np.round(100 * between[:3, 3], 1).tolist(),
        "box_yaw_degrees": round(float(np.degrees(np.arctan2(between[0, 2], between[2, 2]))), 1),
        "box_size_m": np.round(found.size, 3).tolist(),
    }


def _depth_agreement(progress: Progress, sequence: Sequence) -> dict[str, float]:
    """Distance of each keyframe from the surface of the previous one, with our poses and with the
    given poses."""
    keyframes = [log.index for log in progress.logs if log.status == "keyframe"]
    poses = trajectory(progress)
    ours, given = [], []
    for a, b in zip(keyframes, keyframes[1:], strict=False):
        first, second = (prepare(sequence[i]).view for i in (a, b))
        T_a, T_b = _given_pose(sequence, a), _given_pose(sequence, b)
        ours.append(_rmse(first, second, np.linalg.inv(poses[a]) @ poses[b]))
        given.append(_rmse(first, second, np.linalg.inv(T_a) @ T_b))
    return {
        "ours": round(1000 * float(np.mean(ours)), 2),
        "given": round(1000 * float(np.mean(given)), 2),
    }


def _rmse(first, second, T_first_second: np.ndarray) -> float:
    return float(_measure(first, second, as_pose(T_first_second)))


@jax.jit
def _measure(first, second, T):
    match = icp.match_view(first, as_pose(np.eye(4)))
    cloud = icp.cloud_of(second, stride=2)
    return icp.align(cloud, match, T, distance=0.06, tolerance=0.01, iterations=0).rmse


def _seconds(progress: Progress) -> dict[str, float]:
    """Median seconds of the parts of a keyframe's step."""
    logs = [log for log in progress.logs[1:] if log.status == "keyframe"]
    parts = sorted({part for log in logs for part in log.figures if part.startswith("seconds_")})
    each = {part: [log.figures[part] for log in logs if part in log.figures] for part in parts}
    return {
        part.removeprefix("seconds_"): round(float(np.median(s)), 3) for part, s in each.items()
    }


def plot(meshes: dict[str, list[Panel]], path: Path) -> None:
    """The meshes from three sides, one row for each way."""
    write_panels(path, meshes.values())


if __name__ == "__main__":
    prepare_process()
    main(tyro.cli(Config))
