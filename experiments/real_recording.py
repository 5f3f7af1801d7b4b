r"""A real recording rebuilt three ways: with all given poses, with the first pose, with no pose.

    python experiments/real_recording.py --recording kitchen/frames \
        --box experiments/kitchen_chair_box.json --click 240 150

The chair of the paper's figure on real data (real_cma_au), on a recording that anyone can get: the
red kitchen of 7-Scenes, sequence 01, frames 0 to 265, every fifth: a slatted chair half hidden by a
table. Every way begins with a click at one pixel of the first frame and rebuilds the chair as
`jaxshape reconstruct` does by default, without a given box, floor or scale. `given` takes all
poses, `first` takes the first pose and tracks the other frames, `none` takes no pose.

The script compares the cameras with the given poses (distance and angle, as root mean square and
maximum), and the box with a box that was measured by hand. It also measures how well the depth
images agree with each other under the given poses and under ours (root mean square distance of a
keyframe's points to the planes of the previous keyframe, after the same matching). This figure
shows that the given poses are not exact either.

Then the chair is rebuilt in each way from other first frames, with a click at the pixel that shows
its middle, to the end of the recording: is it the same chair? A run agrees if all extents are
within 3 cm of those measured by hand. A run that does not agree must say so: its verdict must not
be good, or it must warn of sides that were not seen.

Results: experiments/results/real_recording.json, .png (the meshes from three sides) and .gif (the
mesh of the given poses turning: first the measured part, then the whole), and first_frames.json,
run by run: a killed experiment resumes there. No image of the recording is kept. Time: 15 minutes
on two busy cores.
"""

import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import trimesh
import tyro
from PIL import Image

import rebuilding
import runs
from jaxshape.data.boxes import Box, points_in_box, read_box
from jaxshape.data.sequences import Frame, Sequence, SequenceError, open_sequence
from jaxshape.files import atomic_path, write_json
from jaxshape.mapping.map.mapper import Mapper
from jaxshape.mapping.map.recording import Progress, trajectory
from jaxshape.mapping.placement.finding import find_start
from jaxshape.mapping.segmentation.planes import camera_points
from jaxshape.mapping.segmentation.segment import Prompt
from jaxshape.mapping.tracking import icp
from jaxshape.mapping.tracking.keyframes import as_pose, prepare
from jaxshape.mapping.tracking.registration import displacement
from jaxshape.model.shapes import ShapePrior
from jaxshape.process import prepare_process
from jaxshape.report.paint import by_source
from jaxshape.report.panels import Panel, write_panels
from jaxshape.report.pictures import render_mesh
from jaxshape.results.output import ShapeMesh
from rebuilding import judgement, meshed, middle_pixel, rebuilt, usual

SIDES = {"left": -45.0, "right": 45.0, "back": 215.0}
WAYS = {"given": "all poses", "first": "the first pose", "none": "no pose"}
TURN = 36
"""Pictures of a full turn."""
NEAR = 0.03
"""Largest error of an extent, in metres."""


@dataclass(frozen=True)
class Config(rebuilding.Config):
    """Settings of the experiment."""

    click: tuple[float, float] = (240, 150)
    """A pixel of the object in the first frame."""
    first: tuple[str, ...] = ("000000", "000040", "000100", "000160", "000200")
    """Numbers in the names of other first frames."""


class Source(NamedTuple):
    """The recording, the true box, and what rebuilds it."""

    sequence: Sequence
    box: Box
    placer: ShapePrior
    mapper: Mapper
    step: int
    """1 to take every frame."""

    def rebuild(self, way: str, first: int, click: tuple[float, float]) -> Progress:
        """Follow the recording from its first frame or a later one."""
        start = find_start(
            self.sequence, self.placer, Prompt(click=click), first=first, use_pose=way != "none"
        )
        chosen = range(start.index, len(self.sequence), self.step)
        follow = partial(rebuilt, self.sequence, start, self.placer, self.mapper)
        return follow(use_poses=way == "given", chosen=chosen)


def main(config: Config) -> None:
    prepare_process()
    config = config.reduced(first=config.first[:1])
    sequence, box = open_sequence(config.recording), read_box(config.box)
    source = Source(sequence, box, *usual(), step=4 if config.smoke else 1)
    figures, meshes = {}, {}
    for way in WAYS:
        figures[way], meshes[way] = _compared(source, way, config.click)
        print(way, figures[way], flush=True)
    about = {"recording": config.recording.name, "box": config.box.name}
    settings = about | {"click": config.click, "smoke": config.smoke}
    write_json(config.results / "real_recording.json", {"settings": settings, "ways": figures})
    write_panels(config.results / "real_recording.png", map(_from_all_sides, WAYS, meshes.values()))
    _write_turn(meshes["given"], config.results / "real_recording.gif")
    journal = config.journal("first_frames", **about, first=config.first)
    starts = {f"{first} {way}": partial(_from_frame, source, way, first)
              for first in config.first for way in WAYS}  # fmt: skip
    runs.complete(journal, starts, summary)


# From the first frame, compared with the given poses ---------------------------------------------


def _compared(
    source: Source, way: str, click: tuple[float, float]
) -> tuple[dict[str, Any], ShapeMesh]:
    """Figures of a way, and its mesh."""
    sequence, progress = source.sequence, source.rebuild(way, 0, click)
    found, mesh = progress.start.box, meshed(progress)
    start = progress.start.index
    T_world_first = _given_pose(sequence, start) if way == "none" else np.eye(4)
    found = found._replace(T_world_object=T_world_first @ found.T_world_object)
    judged = judgement(progress, mesh)
    figures = {
        "frames": len(progress.logs),
        "tracked": len(trajectory(progress)),
        "keyframes": len(progress.state.keyframes),
        **_against_given(progress, sequence, T_world_first),
        **_against_box(found, source.box),
        "explained": round(float(judged["quality"]["explained"]), 3),
        "verdict": judged["verdict"],
        "reasons": judged["reasons"],
        "depth_agreement_mm": _depth_agreement(progress, sequence),
        "seconds_per_part": _seconds(progress),
    }
    return figures, mesh


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


def _from_all_sides(way: str, found: ShapeMesh) -> list[Panel]:
    """The mesh from three sides: its measured part blue, its predicted part orange."""
    assert found.measured is not None
    return [
        Panel(
            f"{WAYS[way]}: {side}",
            render_mesh(found.mesh, color=by_source(found.measured), azimuth=azimuth, size=400),
        )
        for side, azimuth in SIDES.items()
    ]


def _write_turn(found: ShapeMesh, path: Path) -> None:
    """An animation of two turns: of the measured part alone, then of the whole mesh."""
    assert found.measured is not None
    mesh, colors = found.mesh, by_source(found.measured)
    # Points of a circle around the mesh, without faces, keep the scale of all pictures the same.
    middle, radius = mesh.bounds.mean(axis=0), np.linalg.norm(mesh.extents[[0, 2]]) / 2
    angles = np.linspace(0, 2 * np.pi, 4 * TURN)
    circle = radius * np.stack([np.sin(angles), 0 * angles, np.cos(angles)], axis=1)
    rings = [middle + circle + [0, y * mesh.extents[1] / 2, 0] for y in (-1, 1)]
    vertices = np.concatenate([mesh.vertices, *rings])
    colors = np.concatenate([colors, np.zeros((len(vertices) - len(colors), 3), np.uint8)])
    pictures = []
    for faces in (mesh.faces[found.measured[mesh.faces].all(axis=1)], mesh.faces):
        shown = trimesh.Trimesh(vertices, faces, process=False)
        for k in range(TURN):
            image = render_mesh(shown, color=colors, azimuth=-45 + 360 * k / TURN, size=320)
            pictures.append(Image.fromarray(image).quantize(64))
    with atomic_path(path) as temporary:
        pictures[0].save(
            temporary, "GIF", save_all=True, append_images=pictures[1:], duration=90, loop=0
        )


# From other first frames -------------------------------------------------------------------------


def _from_frame(source: Source, way: str, first: str) -> dict[str, Any]:
    """The judgement of a run that starts at another frame, and its difference from the true box."""
    began = time.process_time()
    index = next(i for i, one in enumerate(source.sequence.names) if first in one)
    click = middle_of(source.sequence[index], source.box)
    try:
        progress = source.rebuild(way, index, click)
        result = judgement(progress, meshed(progress))
    except SequenceError as failure:
        return {"failed": str(failure)}
    off = np.array(result["size"]) - source.box.size
    seconds = round(time.process_time() - began, 1)
    return {"click": click, "off": off.round(4).tolist(), **result, "cpu_seconds": seconds}


def middle_of(frame: Frame, box: Box) -> tuple[float, float]:
    """The pixel of the object, u and v, that is nearest to the middle of all its pixels."""
    points = camera_points(frame.depth, frame.intrinsics)
    T = np.asarray(frame.T_world_camera)
    shown = points_in_box(points @ T[:3, :3].T + T[:3, 3], box)
    return middle_pixel(shown)


def summary(rows: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Numbers of runs that agree with the hand-measured size, and of wrong runs without warning."""
    ended = [one for one in rows.values() if "failed" not in one]
    wrong = [one for one in ended if np.abs(one["off"]).max() > NEAR]
    unsaid = [one for one in wrong if one["verdict"] == "good" and not one["warnings"]]
    counts = {
        "runs": len(rows),
        "refused": len(rows) - len(ended),
        "same chair": len(ended) - len(wrong),
        "another": len(wrong),
        "another and not said": len(unsaid),
    }
    return {"summary": counts}


if __name__ == "__main__":
    main(tyro.cli(Config))
