"""Rows of titled pictures: `overview.png`, one reconstruction at a glance. [host]"""

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Integer, UInt8

from jaxshape.files import atomic_path
from jaxshape.report.paint import paints
from jaxshape.report.palette import COLORS, INK, PALE
from jaxshape.report.pictures import render_measurement, render_mesh, render_voxels, rgb
from jaxshape.results.folder import mesh_in_object, read_folder
from jaxshape.results.output import Observation, only
from jaxshape.search.reconstruction import Reconstruction

_WIDTH, _GAP, _TEXT, _CELL = 1600, 16, 34, 400  # pixels


class Panel(NamedTuple):
    """One picture of a row.

    Attributes:
        title: Text above it.
        image: Pixels of the picture.
        note: Text below it.
    """

    title: str
    image: UInt8[np.ndarray, "h w 3"]
    note: str = ""


def grid_panel(
    title: str,
    labels: Integer[np.ndarray, "x y z"] | Bool[np.ndarray, "x y z"],
    *colors: str,
    note: str = "",
) -> Panel:
    """Picture a grid, its labels 1, 2, ... in the given entries of `COLORS`."""
    return Panel(title, render_voxels(labels, [COLORS[c] for c in colors], size=_CELL), note)


def measurement_panel(
    title: str,
    occupied: Bool[np.ndarray, "x y z"],
    occluded: Bool[np.ndarray, "x y z"],
    note: str = "",
) -> Panel:
    """Picture F in colour, and M as a fog through which the F behind it shows."""
    return Panel(title, render_measurement(occupied, occluded, size=_CELL), note)


def mesh_panel(
    title: str,
    mesh: trimesh.Trimesh,
    color: str | UInt8[np.ndarray, "n 3"],
    note: str = "",
) -> Panel:
    """Picture a mesh in an entry of `COLORS`, or in the colours of its vertices."""
    paint = COLORS[color] if isinstance(color, str) else color
    return Panel(title, render_mesh(mesh, color=paint, size=_CELL), note)


def depth_panels(depth_frames: Sequence[Float[np.ndarray, "_ _"]]) -> list[Panel]:
    """Picture depth images, near ones dark, with one scale for all.

    Depth is in metres; 0 (invalid) is grey, infinity (background) pale.
    """
    from matplotlib import colormaps

    known = [depth[np.isfinite(depth) & (depth > 0)] for depth in depth_frames]
    metres = np.concatenate([*known, [] if any(map(len, known)) else [1.0]])
    low, high = np.percentile(metres, (1, 99)) + (-1e-3, 1e-3)  # a flat wall has a scale, too
    panels = []
    for number, depth in enumerate(depth_frames, start=1):
        image = colormaps["viridis"](0.95 * (depth - low) / (high - low))[..., :3]
        image[np.isinf(depth)] = rgb(PALE)
        image[~(depth > 0)] = rgb(COLORS["occluded"])
        panels.append(Panel(f"depth {number}", np.rint(image * 255).astype(np.uint8)))
    return panels


def write_overview(
    folder: str | os.PathLike[str],
    observation: Observation,
    reconstruction: Reconstruction,
    result: dict[str, Any],
) -> None:
    """Write `overview.png` of ONE object: depth images above, grids and the mesh below.

    Args:
        folder: The result folder, which holds the mesh already.
        observation: Measurement of the object.
        reconstruction: The reconstruction, a batch of one.
        result: The content of result.json; its IoUs are noted below the grids.
    """
    one = only(reconstruction)

    def note(name: str) -> str:
        return f"IoU {result[name]:.2f}" if name in result else ""

    composed = np.where(one.composed, np.where(observation.occluded, 2, 1), 0)
    found = read_folder(folder)
    columns = [
        measurement_panel("F (blue) and M", observation.occupied, observation.occluded),
        grid_panel("encoder", one.completed_first, "predicted", note=note("iou_encoder")),
        grid_panel("refined", one.completed, "predicted", note=note("iou_refined")),
        grid_panel("composed", composed, "measured", "predicted", note=note("iou_composed")),
    ]
    mesh = mesh_in_object(found)
    if mesh is not None:
        first = next(iter(paints(found).values()), None)
        columns.append(mesh_panel("mesh", mesh, "predicted" if first is None else first.colors))
    if observation.truth is not None:
        columns.append(grid_panel("truth", observation.truth, "truth"))
    write_panels(Path(folder) / "overview.png", [depth_panels(observation.depth), columns])


# Layout ----------------------------------------------------------------------------------------


def write_panels(path: str | os.PathLike[str], rows: Iterable[Sequence[Panel]]) -> None:
    """Write rows of panels, one below the other, as one picture.

    Args:
        path: The picture, 1600 pixels wide; its suffix names the format.
        rows: The panels of each row, from left to right; empty rows are left out.
    """
    from matplotlib.figure import Figure  # slow to import, and only pictures need it

    rows = [row for row in rows if row]
    heights = [_row_height(row) for row in rows]
    noted = [_TEXT * any(panel.note for panel in row) for row in rows]
    total = sum(heights) + sum(noted) + len(rows) * (_TEXT + _GAP) + _GAP
    figure = Figure(figsize=(_WIDTH / 100, total / 100), dpi=100)
    top = _GAP
    for row, height, note in zip(rows, heights, noted, strict=True):
        _draw_row(figure, row, top / total, height / total)
        top += _TEXT + height + note + _GAP
    with atomic_path(path) as temporary:
        figure.savefig(temporary)


def _row_height(row: Sequence[Panel]) -> int:
    """Height in pixels, at most 300, at which the panels of a row together fill the width."""
    aspect = sum(panel.image.shape[1] / panel.image.shape[0] for panel in row)
    return int(min(300, (_WIDTH - _GAP * (len(row) + 1)) / max(aspect, 1e-6)))


def _draw_row(figure: Any, row: Sequence[Panel], top: float, height: float) -> None:
    """Draw panels side by side in the middle; lengths are fractions of the height of the figure."""
    total = figure.get_figheight() * figure.dpi
    widths = [height * total / p.image.shape[0] * p.image.shape[1] / _WIDTH for p in row]
    gap, line = _GAP / _WIDTH, _TEXT / total
    left = (1 - sum(widths) - gap * (len(row) - 1)) / 2
    for panel, width in zip(row, widths, strict=True):
        axes = figure.add_axes((left, 1 - top - line - height, width, height))
        axes.imshow(panel.image, aspect="auto", interpolation="antialiased")
        axes.axis("off")
        middle = left + width / 2
        style = {"ha": "center", "va": "center", "color": INK}
        figure.text(middle, 1 - top - line / 2, panel.title, fontsize=16, weight="bold", **style)
        figure.text(middle, 1 - top - 1.5 * line - height, panel.note, fontsize=15, **style)
        left += width + gap
