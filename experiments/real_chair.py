r"""A real chair, keyframe by keyframe: measured, proposed, refined (paper, Fig. real_cma_au).

    python experiments/real_chair.py --recording kitchen/frames \
        --box experiments/kitchen_chair_box.json

The recording of real_recording.py: the red kitchen of 7-Scenes, sequence 01, frames 0 to 265, every
fifth; a slatted chair half hidden by a table. CMA-ES continues for 40 iterations after each
keyframe, and for 100 at the end. This is done twice: with the given poses, and with the first pose
alone and all others tracked. The true shape is unknown. So the figures tell only how well a shape
agrees with the measurement: the share of F's voxels that the shape explains, and the share of free
voxels that it fills.

Results: experiments/results/real_chair.json, .png and .svg, which hold no pixel of the recording.
The figure with images goes to out/real_chair/: the recording is for research alone, and is not to
be published with the code. Time: 4 minutes on two cores.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh
import tyro

import rebuilding
from figures import Sheet, save_column
from jaxshape.data.boxes import Box, read_box
from jaxshape.data.sequences import Sequence as Recording
from jaxshape.data.sequences import open_sequence
from jaxshape.mapping.config import MappingConfig, TrackingConfig
from jaxshape.mapping.map.mapper import Mapper, build_mapper
from jaxshape.mapping.map.recording import follow
from jaxshape.mapping.map.state import MapState, grids_of
from jaxshape.mapping.placement.finding import find_start
from jaxshape.mapping.segmentation.segment import Prompt
from jaxshape.model.shapes import ShapePrior
from jaxshape.model.weights import fingerprint, load_prior
from jaxshape.report.palette import BLUE, INK, ORANGE, PINK, SKY
from jaxshape.report.pictures import render_measurement, render_voxels, rgb
from jaxshape.results.output import SMOOTHING
from jaxshape.results.surface import surface
from jaxshape.search.config import RefineConfig
from jaxshape.search.reconstruction import Reconstruction, refiner_for

WAYS = {"given": "poses given", "first": "first pose given, others tracked"}
KEYFRAMES = (1, 2, 4)
"""Numbers of keyframes after which a row is drawn, besides the last."""


@dataclass(frozen=True)
class Config(rebuilding.Config):
    """Settings of the experiment."""

    iterations: int = 100
    """Iterations of CMA-ES at the end."""
    keyframe_iterations: int = 40
    """Iterations of CMA-ES after each keyframe."""
    images: Path = Path("out/real_chair")
    """Folder for the figure that shows images of the recording."""


class Moment(NamedTuple):
    """The map after some number of keyframes."""

    frame: int
    """Index of the last keyframe in the recording."""
    state: MapState
    shape: Reconstruction
    """A batch of one."""


def main(config: Config) -> None:
    config = config.reduced(iterations=2, keyframe_iterations=2)
    recording, box = open_sequence(config.recording), read_box(config.box)
    if rebuilt := run(config, recording, box):
        plot(rebuilt, box, config.results / "real_chair")
        plot(rebuilt, box, config.images / "real_chair", recording)


def run(config: Config, recording: Recording, box: Box) -> dict[str, list[Moment]]:
    """Rebuild the chair each way, and write the results.

    Nothing is rebuilt if the results of these settings already exist, with all pictures.
    """
    prior = load_prior("chair-autoencoder")
    search = RefineConfig(iterations=config.iterations, symmetry=False)
    mapping = MappingConfig(fusion="points", keyframe_iterations=config.keyframe_iterations)
    refiner = refiner_for("cma", prior, search)
    mapper = build_mapper(prior, refiner, search, mapping, TrackingConfig())
    journal = config.journal(
        "real_chair",
        recording=config.recording.name,
        box=config.box.name,
        iterations=config.iterations,
        keyframe_iterations=config.keyframe_iterations,
        smoke=config.smoke,
        weights=fingerprint(prior),
    )
    if len(journal.rows) == len(WAYS) and (config.images / "real_chair.svg").is_file():
        return {}
    journal.rows, journal.seconds = {}, 0.0  # the pictures show more than a journal keeps
    rebuilt = {}
    for way in WAYS:
        began = time.perf_counter()
        moments = _moments(way, config, recording, box, prior, mapper)
        # the moment after the long search replaces the one before it
        rebuilt[way] = [*{len(one.state.keyframes): one for one in moments}.values()]
        rows = {str(len(one.state.keyframes)): agreement(one) for one in rebuilt[way]}
        journal.add({way: rows}, time.perf_counter() - began)
    journal.write({"summary": {way: [*rows.values()][-1] for way, rows in journal.rows.items()}})
    return rebuilt


def _moments(
    way: str, config: Config, recording: Recording, box: Box, prior: ShapePrior, mapper: Mapper
) -> Iterator[Moment]:
    """The map after each keyframe, and at last after the long search."""
    start = find_start(recording, prior, Prompt(), box=box, use_pose=True)
    chosen = range(start.index, len(recording), 4 if config.smoke else 1)
    given, last = way == "given", start.index
    state = None
    for progress in follow(recording, start, mapper, prior, chosen=chosen, use_poses=given):
        state = progress.state
        if progress.logs[-1].status == "keyframe":
            last = progress.logs[-1].index
            if progress.shape is not None:
                yield Moment(last, state, progress.shape)
    assert state is not None
    state, shape = mapper.finish(state)
    if shape is not None:
        yield Moment(last, state, shape)


def agreement(one: Moment) -> dict[str, Any]:
    """Agreement of the encoder's and the refined shape with the measurement."""
    occupied, occluded, _ = map(np.asarray, grids_of(one.state))
    shape, free = one.shape, ~occupied & ~occluded
    first, refined = (np.asarray(x[0]) for x in (shape.completed_first, shape.completed))

    def figures(grid: np.ndarray, objective: Any) -> dict[str, float]:
        return {
            "objective": round(float(objective[0]), 4),
            "explained": round(float(grid[occupied].mean()), 4),
            "violated": round(float(grid[free].mean()), 4),
        }

    return {
        "frame": one.frame,
        "measured_voxels": int(occupied.sum()),
        "changed_voxels": int((first != refined).sum()),
        "encoder": figures(first, shape.first_objective),
        "refined": figures(refined, shape.objective),
    }


# ------------------------------------------------------------------ pictures

WIDTH, LABELS, HEADER, GAP = 7.0, 0.3, 0.24, 0.03  # inches
CELL, SIDE = 1.15, 2.3  # inches: largest height of a row, least width of the surfaces
TITLES = {"F and M": BLUE, "encoder": PINK, "refined": ORANGE}


def plot(
    rebuilt: dict[str, list[Moment]], box: Box, stem: Path, recording: Recording | None = None
) -> None:
    """Rows of keyframes with the given poses, and next to them the surfaces with all cameras.

    Images are shown only where a recording is given.
    """
    cameras = {way: cameras_of(moments[-1], box) for way, moments in rebuilt.items()}
    view = _direction(cameras["given"])
    rows = {
        len(one.state.keyframes): _pictures(one, view, recording)
        for one in rebuilt["given"]
        if len(one.state.keyframes) in KEYFRAMES or one is rebuilt["given"][-1]
    }
    titles = next(iter(rows.values()))
    aspects = [image.shape[1] / image.shape[0] for image in titles.values()]
    cell = min(CELL, (WIDTH - LABELS - SIDE) / sum(aspects))
    lefts = LABELS + cell * np.cumsum([0, *aspects])
    height, each = HEADER + cell * len(rows), (HEADER + cell * len(rows)) / len(rebuilt)
    side = WIDTH - lefts[-1]

    def draw(figure: Any) -> None:
        sheet = Sheet(figure)
        for left, right, name in zip(lefts, lefts[1:], titles, strict=False):
            style = {"color": TITLES.get(name, INK), "weight": "bold"}
            sheet.text((left + right) / 2, HEADER / 2, name, **style)
        for i, (keyframes, row) in enumerate(rows.items()):
            top = HEADER + i * cell
            sheet.text(GAP, top + cell / 2, keyframes, ha="left", weight="bold", size=9)
            for left, right, image in zip(lefts, lefts[1:], row.values(), strict=False):
                sheet.show(left + GAP, top + GAP, right - left - 2 * GAP, cell - 2 * GAP, image)
        for i, (way, moments) in enumerate(rebuilt.items()):
            sheet.text(lefts[-1] + side / 2, i * each + HEADER / 2, WAYS[way])
            size = side - 2 * GAP, each - HEADER - GAP
            axes = sheet.axes(lefts[-1] + GAP, i * each + HEADER, *size)
            draw_surface(axes, mesh_of(moments[-1]), cameras[way], view)

    save_column(stem, draw, height=height, width=WIDTH)


def mesh_of(one: Moment) -> trimesh.Trimesh:
    """The composed shape, in the object frame."""
    return surface(one.shape.composed[0], one.state.place.frame, smoothing=SMOOTHING)


def cameras_of(one: Moment, box: Box) -> np.ndarray:
    """T_object_camera of all keyframes."""
    T = [np.asarray(k.T_world_camera.as_matrix(), np.float64) for k in one.state.keyframes]
    return np.linalg.inv(box.T_world_object) @ np.stack(T)


def _direction(T_object_camera: np.ndarray) -> tuple[float, float]:
    """Azimuth and elevation, in degrees, from which the first camera looks at the object."""
    x, y, z = T_object_camera[0, :3, 3]
    return float(np.degrees(np.arctan2(x, z))), float(np.degrees(np.arctan2(y, np.hypot(x, z))))


def _pictures(
    one: Moment, view: tuple[float, float], recording: Recording | None
) -> dict[str, np.ndarray]:
    """The cells of a row; images only where a recording is given."""
    how: dict[str, Any] = {"size": 320, "azimuth": view[0], "elevation": view[1]}
    occupied, occluded, _ = map(np.asarray, grids_of(one.state))
    first, refined = (np.asarray(g[0]) for g in (one.shape.completed_first, one.shape.completed))
    images = {} if recording is None else _images(one, recording)
    return images | {
        "F and M": render_measurement(occupied, occluded, **how),
        "encoder": render_voxels(first, [PINK], **how),
        "refined": render_voxels(refined, [ORANGE], **how),
    }


def _images(one: Moment, recording: Recording) -> dict[str, np.ndarray]:
    """The colour image and the segmented object; none without colour."""
    color = recording[one.frame].color
    if color is None:
        return {}
    segmented = np.asarray(one.state.keyframes[-1].segmented)
    k = color.shape[0] // segmented.shape[0]
    inside = np.zeros(color.shape[:2], bool)
    large = np.kron(segmented, np.ones((k, k), bool))[: color.shape[0], : color.shape[1]]
    inside[: large.shape[0], : large.shape[1]] = large
    return {"image": color, "segmented": np.where(inside[..., None], color, 255).astype(np.uint8)}


def draw_surface(
    axes: Any,
    mesh: trimesh.Trimesh,
    T_object_camera: np.ndarray,
    view: tuple[float, float],
) -> None:
    """The mesh and the pyramids of cameras, orthographically, from a point next to the first
    camera."""
    from matplotlib.collections import LineCollection, PolyCollection

    a, e = np.radians(view) + np.radians((60, 10))
    towards = np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
    right = np.array([np.cos(a), 0.0, -np.sin(a)])
    to_picture = np.stack([right, np.cross(towards, right)], axis=1)
    order = np.argsort(mesh.triangles_center @ towards)
    faces = mesh.triangles[order] @ to_picture
    light = 0.62 + 0.38 * np.clip(mesh.face_normals[order] @ (towards + [0, 0.6, 0]) / 1.3, 0, 1)
    shades = light[:, None] * rgb(SKY)
    axes.add_collection(
        PolyCollection(list(faces), facecolors=shades, edgecolors=shades, lw=0.2, rasterized=True)
    )
    centers = T_object_camera[:, :3, 3] @ to_picture
    axes.plot(*centers.T, color=INK, lw=0.6)
    pyramids = np.concatenate([_pyramid(T) for T in T_object_camera]) @ to_picture
    axes.add_collection(LineCollection(list(pyramids), colors=INK, linewidths=0.6))
    first = _pyramid(T_object_camera[0]) @ to_picture
    axes.add_collection(LineCollection(list(first), colors=ORANGE, linewidths=1.2))
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.margins(0.03)


def _pyramid(T_object_camera: np.ndarray, length: float = 0.16) -> np.ndarray:
    """Edges of a camera's viewing pyramid, in the object frame."""
    corners = np.array([[-0.55, -0.42, 1], [0.55, -0.42, 1], [0.55, 0.42, 1], [-0.55, 0.42, 1]])
    rim = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
    edges = np.stack([np.zeros_like(corners), corners], axis=1)
    lines = length * np.concatenate([rim, edges])
    return lines @ T_object_camera[:3, :3].T + T_object_camera[:3, 3]


if __name__ == "__main__":
    main(tyro.cli(Config))
