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
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh
import tyro

from figures import save_column
from jaxshape.data.boxes import Box, read_box
from jaxshape.data.sequences import Sequence as Recording
from jaxshape.data.sequences import open_sequence
from jaxshape.mapping.config import MappingConfig, TrackingConfig
from jaxshape.mapping.map.mapper import Mapper, build_mapper
from jaxshape.mapping.map.recording import Progress, follow
from jaxshape.mapping.map.state import MapState, grids_of
from jaxshape.mapping.placement.finding import find_start
from jaxshape.mapping.segmentation.segment import Prompt
from jaxshape.mapping.tracking.keyframes import Keyframe
from jaxshape.model.shapes import ShapePrior
from jaxshape.model.weights import fingerprint, load_prior
from jaxshape.report.palette import BLUE, INK, ORANGE, PINK, SKY
from jaxshape.report.pictures import render_measurement, render_voxels
from jaxshape.results.journal import Journal
from jaxshape.results.output import SMOOTHING
from jaxshape.results.surface import surface
from jaxshape.search.config import RefineConfig
from jaxshape.search.reconstruction import Reconstruction, refiner_for
from study import Claim, conclude

RESULTS = Path(__file__).parent / "results"
WAYS = {"given": "poses given", "first": "first pose given, others tracked"}
KEYFRAMES = (1, 2, 4)
"""Numbers of keyframes after which a row is drawn, besides the last."""


@dataclass(frozen=True)
class Config:
    """Settings of the experiment."""

    recording: Path = Path("kitchen/frames")
    """A recording with poses."""
    box: Path = Path("experiments/kitchen_chair_box.json")
    """The object's box in the world of these poses."""
    iterations: int = 100
    """Iterations of CMA-ES at the end."""
    keyframe_iterations: int = 40
    """Iterations of CMA-ES after each keyframe."""
    results: Path = RESULTS
    images: Path = Path("out/real_chair")
    """Folder for the figure that shows images of the recording."""
    smoke: bool = False
    """Few frames and iterations, as a test."""


class Moment(NamedTuple):
    """The map after some number of keyframes."""

    keyframes: int
    frame: int
    """Index of the last keyframe in the recording."""
    keyframe: Keyframe
    occupied: np.ndarray
    occluded: np.ndarray
    shape: Reconstruction
    """A batch of one."""


class Rebuilt(NamedTuple):
    """All moments of one way to rebuild, and its final results."""

    moments: list[Moment]
    mesh: trimesh.Trimesh
    """The composed shape, in the object frame."""
    T_object_camera: np.ndarray
    """Poses of all keyframes."""


def main(config: Config) -> None:
    if config.smoke:
        config = replace(config, iterations=2, keyframe_iterations=2)
    recording = open_sequence(config.recording)
    journal, rebuilt = run(config, recording)
    if rebuilt:
        plot(rebuilt, config.results / "real_chair")
        plot(rebuilt, config.images / "real_chair", recording)
    for claim in claims(journal):
        print(claim.ours)


def run(config: Config, recording: Recording) -> tuple[Journal, dict[str, Rebuilt]]:
    """Rebuild the chair each way, and write the results.

    Nothing is rebuilt if the results of these settings already exist, with all pictures.
    """
    prior, box = load_prior("chair-autoencoder"), read_box(config.box)
    search = RefineConfig(iterations=config.iterations, symmetry=False)
    mapping = MappingConfig(fusion="points", keyframe_iterations=config.keyframe_iterations)
    mapper = build_mapper(
        prior, refiner_for("cma", prior, search), search, mapping, TrackingConfig()
    )
    settings = {
        "recording": config.recording.name,
        "box": config.box.name,
        "iterations": config.iterations,
        "keyframe_iterations": config.keyframe_iterations,
        "smoke": config.smoke,
        "weights": fingerprint(prior),
    }
    journal = Journal(config.results / "real_chair.json", settings)
    if len(journal.rows) == len(WAYS) and (config.images / "real_chair.svg").is_file():
        return journal, {}
    journal.rows, journal.seconds = {}, 0.0  # the pictures show more than a journal keeps
    rebuilt = {}
    for way in WAYS:
        began = time.perf_counter()
        moments = list(_moments(way, config, recording, box, prior, mapper))
        rebuilt[way] = _finished(moments, box)
        rows = {str(one.keyframes): agreement(one) for one in rebuilt[way].moments}
        journal.add({way: rows}, time.perf_counter() - began)
    conclude(journal, claims(journal))
    return journal, rebuilt


def _moments(
    way: str,
    config: Config,
    recording: Recording,
    box: Box,
    prior: ShapePrior,
    mapper: Mapper,
) -> Iterator[tuple[Moment, MapState]]:
    """The map after each keyframe, and at last after the long search."""
    start = find_start(recording, prior, Prompt(), box=box, use_pose=True)
    chosen = range(start.index, len(recording), 4 if config.smoke else 1)
    progress = None
    for progress in follow(
        recording, start, mapper, prior, chosen=chosen, use_poses=way == "given"
    ):
        if progress.logs[-1].status == "keyframe" and progress.shape is not None:
            yield _moment(progress, progress.state, progress.shape), progress.state
    assert progress is not None
    state, shape = mapper.finish(progress.state)
    if shape is not None:
        yield _moment(progress, state, shape), state


def _moment(progress: Progress, state: MapState, shape: Reconstruction) -> Moment:
    occupied, occluded, _ = grids_of(state)
    last = [log.index for log in progress.logs if log.status == "keyframe"][-1]
    return Moment(
        keyframes=len(state.keyframes),
        frame=last,
        keyframe=state.keyframes[-1],
        occupied=np.asarray(occupied),
        occluded=np.asarray(occluded),
        shape=shape,
    )


def _finished(moments: Sequence[tuple[Moment, MapState]], box: Box) -> Rebuilt:
    """The finished result; the moment after the long search replaces the one before it."""
    by_keyframes = {one.keyframes: one for one, _ in moments}
    last, state = moments[-1]
    T_world_camera = np.stack(
        [np.asarray(one.T_world_camera.as_matrix(), np.float64) for one in state.keyframes]
    )
    return Rebuilt(
        moments=list(by_keyframes.values()),
        mesh=surface(last.shape.composed[0], state.place.frame, smoothing=SMOOTHING),
        T_object_camera=np.linalg.inv(box.T_world_object) @ T_world_camera,
    )


# ------------------------------------------------------------------ evaluation


def agreement(one: Moment) -> dict[str, Any]:
    """Agreement of the encoder's and the refined shape with the measurement."""
    free = ~one.occupied & ~one.occluded
    shapes = {
        "encoder": np.asarray(one.shape.completed_first[0]),
        "refined": np.asarray(one.shape.completed[0]),
    }
    objectives = {"encoder": one.shape.first_objective, "refined": one.shape.objective}
    found = {
        name: {
            "objective": round(float(objectives[name][0]), 4),
            "explained": round(float(shape[one.occupied].mean()), 4),
            "violated": round(float(shape[free].mean()), 4),
        }
        for name, shape in shapes.items()
    }
    return {
        "frame": one.frame,
        "measured_voxels": int(one.occupied.sum()),
        "changed_voxels": int((shapes["encoder"] != shapes["refined"]).sum()),
        **found,
    }


def claims(journal: Journal) -> list[Claim]:
    """The paper's claims about this figure, as far as they can be tested without a true shape."""

    def last(way: str) -> dict[str, Any]:
        return list(journal.rows[way].values())[-1]

    def tell(way: str) -> str:
        end = last(way)
        a, b = end["encoder"], end["refined"]
        return (
            f"{WAYS[way]}, {list(journal.rows[way])[-1]} keyframes: explains "
            f"{a['explained']:.1%} -> {b['explained']:.1%} of the measured surface, fills "
            f"{a['violated']:.2%} -> {b['violated']:.2%} of the measured free space, objective "
            f"{a['objective']:.4f} -> {b['objective']:.4f}"
        )

    better = [
        last(way)["refined"]["explained"] > last(way)["encoder"]["explained"]
        and last(way)["refined"]["violated"] < last(way)["encoder"]["violated"]
        for way in journal.rows
    ]
    return [
        Claim(
            "Fig. real_cma_au",
            "On real frames, refinement recovers detail that the auto-encoder alone does not",
            "From the encoder's shape to the refined shape: " + "; ".join(map(tell, journal.rows)),
            "yes" if all(better) else "partly" if any(better) else "no",
        )
    ]


# ------------------------------------------------------------------ pictures

WIDTH, LABELS, HEADER, GAP = 7.0, 0.3, 0.24, 0.03  # inches
CELL, SIDE = 1.15, 2.3  # inches: largest height of a row, least width of the surfaces
TITLES = {"F and M": BLUE, "encoder": PINK, "refined": ORANGE}


def plot(rebuilt: dict[str, Rebuilt], stem: Path, recording: Recording | None = None) -> None:
    """Rows of keyframes with the given poses, and next to them the surfaces with all cameras.

    Images are shown only where a recording is given.
    """
    moments = rebuilt["given"].moments
    moments = [one for one in moments if one.keyframes in KEYFRAMES or one is moments[-1]]
    view = _direction(rebuilt["given"].T_object_camera)
    rows = [_pictures(one, view, recording) for one in moments]
    aspects = [image.shape[1] / image.shape[0] for image in rows[0].values()]
    cell = min(CELL, (WIDTH - LABELS - SIDE) / sum(aspects))
    lefts = LABELS + cell * np.cumsum([0, *aspects])
    height = HEADER + cell * len(rows)

    def text(figure: Any, x: float, y: float, content: Any, **style: Any) -> None:
        where = x / WIDTH, 1 - y / height
        figure.text(*where, str(content), **{"ha": "center", "va": "center"} | style)

    def draw(figure: Any) -> None:
        figure.set_layout_engine("none")
        for i, name in enumerate(rows[0]):
            style = {"color": TITLES.get(name, INK), "weight": "bold"}
            text(figure, (lefts[i] + lefts[i + 1]) / 2, HEADER / 2, name, **style)
        for i, (one, row) in enumerate(zip(moments, rows, strict=True)):
            top = HEADER + i * cell
            text(figure, GAP, top + cell / 2, one.keyframes, ha="left", weight="bold", size=9)
            for left, right, image in zip(lefts, lefts[1:], row.values(), strict=False):
                axes = _axes(figure, left + GAP, top + GAP, right - left - 2 * GAP, cell - 2 * GAP)
                axes.imshow(image, interpolation="antialiased")
        each = height / len(rebuilt)
        for i, (way, one) in enumerate(rebuilt.items()):
            side = WIDTH - lefts[-1]
            text(figure, lefts[-1] + side / 2, i * each + HEADER / 2, WAYS[way])
            size = side - 2 * GAP, each - HEADER - GAP
            axes = _axes(figure, lefts[-1] + GAP, i * each + HEADER, *size)
            draw_surface(axes, one.mesh, one.T_object_camera, view)

    save_column(stem, draw, height=height, width=WIDTH)


def _axes(figure: Any, left: float, top: float, width: float, height: float) -> Any:
    """Bare axes at a place in inches from the upper left corner."""
    w, h = figure.get_size_inches()
    axes = figure.add_axes((left / w, 1 - (top + height) / h, width / w, height / h))
    axes.axis("off")
    return axes


def _direction(T_object_camera: np.ndarray) -> tuple[float, float]:
    """Azimuth and elevation, in degrees, from which the first camera looks at the object."""
    x, y, z = T_object_camera[0, :3, 3]
    return float(np.degrees(np.arctan2(x, z))), float(np.degrees(np.arctan2(y, np.hypot(x, z))))


def _pictures(
    one: Moment, view: tuple[float, float], recording: Recording | None
) -> dict[str, np.ndarray]:
    """The cells of a row; images only where a recording is given."""
    how: dict[str, Any] = {"size": 320, "azimuth": view[0], "elevation": view[1]}
    first, refined = (np.asarray(g[0]) for g in (one.shape.completed_first, one.shape.completed))
    images = {} if recording is None else _images(one, recording)
    return images | {
        "F and M": render_measurement(one.occupied, one.occluded, **how),
        "encoder": render_voxels(first, [PINK], **how),
        "refined": render_voxels(refined, [ORANGE], **how),
    }


def _images(one: Moment, recording: Recording) -> dict[str, np.ndarray]:
    """The colour image and the segmented object; None without colour."""
    color = recording[one.frame].color
    if color is None:
        return {}
    segmented = np.asarray(one.keyframe.segmented)
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
    color = np.array([int(SKY[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    shades = light[:, None] * color
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
