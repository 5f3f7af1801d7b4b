"""Pictures of grids, meshes and depth images, on white, for reports and the README.

Objects are drawn orthographically with +y up. `azimuth` is 0 in front of the object (+z) and grows
towards its +x side, as for the cameras; `elevation` grows upwards; both are in degrees.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Integer, UInt8

from jaxshape.files import atomic_path
from jaxshape.report.figures import BLUE, GREEN, INK, ORANGE

AZIMUTH, ELEVATION = 35.0, 25.0

COLORS = {"measured": BLUE, "predicted": ORANGE, "truth": GREEN, "occluded": "#B4BBC2"}

_SUPERSAMPLING = 2  # pixels averaged along each axis, to smooth edges
_MARGIN = 1.02  # room around the object, as a factor of its extent
_LIGHT = np.array([-0.35, 0.8, 0.5]) / np.linalg.norm([-0.35, 0.8, 0.5])  # right, up, towards us
_AMBIENT = 0.68
_PALE = "#F1F3F4"


def _rgb(color: str) -> Float[np.ndarray, " 3"]:
    return np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)]) / 255


def _view(azimuth: float, elevation: float) -> Float[np.ndarray, "3 3"]:
    """Return the unit vectors to the right, up and towards the viewer, as rows."""
    a, e = np.radians([azimuth, elevation])
    towards = np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
    right = np.array([np.cos(a), 0.0, -np.sin(a)])
    return np.stack([right, np.cross(towards, right), towards])


def _brightness(normals: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n"]:
    """Diffuse brightness of surfaces whose normals are given as right, up, towards the viewer."""
    return np.asarray(_AMBIENT + (1 - _AMBIENT) * np.maximum(normals @ _LIGHT, 0))


def _to_image(canvas: Float[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "_ _ 3"]:
    """Average blocks of pixels and quantise."""
    h, w, _ = canvas.shape
    k = _SUPERSAMPLING
    blocks = canvas.reshape(h // k, k, w // k, k, 3).mean(axis=(1, 3))
    return np.rint(blocks.clip(0, 1) * 255).astype(np.uint8)


# Grids -----------------------------------------------------------------------------------------


def render_voxels(
    labels: Integer[np.ndarray, "x y z"] | Bool[np.ndarray, "x y z"],
    colors: Sequence[str] = (COLORS["predicted"],),
    *,
    size: int = 256,
    azimuth: float = AZIMUTH,
    elevation: float = ELEVATION,
) -> UInt8[np.ndarray, "size size 3"]:
    """Draw a grid as shaded cubes.

    Voxels labelled 0 (or False) are empty; those labelled `i` (or True, which is 1) have the
    colour `colors[i - 1]`, as `#rrggbb`. The whole grid fills the picture, so that pictures of
    different objects have the same scale.
    """
    view = _view(azimuth, elevation)
    pixels = size * _SUPERSAMPLING
    pixels_per_voxel = pixels / (_MARGIN * (np.abs(view[:2]) @ labels.shape).max())
    palette = np.stack([_rgb(color) for color in colors])
    canvas = np.ones((pixels, pixels, 3))
    nearest = np.full((pixels, pixels), -np.inf)
    for axis in (axis for axis in range(3) if abs(view[2, axis]) > 1e-6):  # not those edge-on
        cells = _facing_cells(labels != 0, axis, view[2])
        centered = cells - np.array(labels.shape) / 2
        cell, row, column, s, t = _face_pixels(centered, axis, view, pixels_per_voxel)
        row, column, towards = row + pixels // 2, column + pixels // 2, (cells @ view[2])[cell]
        top = np.flatnonzero(towards > nearest[row, column])
        winner = np.full((pixels, pixels), -1)
        winner[row[top], column[top]] = top  # the last written stays, and that is the nearest
        shown = winner >= 0
        w = winner[shown]
        nearest[shown] = towards[w]
        shade = _face_shade(labels != 0, cells, axis, view, cell[w], s[w], t[w])
        canvas[shown] = palette[labels[tuple(cells[cell[w]].T)].astype(int) - 1] * shade[:, None]
    return _to_image(canvas)


def _facing_cells(
    occupied: Bool[np.ndarray, "x y z"], axis: int, towards: Float[np.ndarray, " 3"]
) -> Integer[np.ndarray, "n 3"]:
    """Occupied cells whose face along `axis` looks at the viewer uncovered, farthest first."""
    beyond = np.roll(np.pad(occupied, 1), -int(np.sign(towards[axis])), axis)[1:-1, 1:-1, 1:-1]
    cells = np.argwhere(occupied & ~beyond)
    return cells[np.argsort(cells @ towards, kind="stable")]


def _face_pixels(
    cells: Float[np.ndarray, "n 3"],
    axis: int,
    view: Float[np.ndarray, "3 3"],
    pixels_per_voxel: float,
) -> tuple[np.ndarray, ...]:
    """Pixels that the faces cover: index of the face, row, column, and place s, t on the face.

    Faces come in the order of `cells`, whose coordinates are relative to the centre of the
    picture.
    """
    corner = cells + (np.arange(3) == axis) * (view[2, axis] > 0)
    to_pixels = view[:2].T * (pixels_per_voxel, -pixels_per_voxel)  # columns, rows
    origin = corner @ to_pixels
    edges = to_pixels[[(axis + 1) % 3, (axis + 2) % 3]]
    corners = np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) @ edges
    low, high = np.floor(corners.min(axis=0)).astype(int), np.ceil(corners.max(axis=0)).astype(int)
    window = np.mgrid[low[0] : high[0] + 1, low[1] : high[1] + 1].reshape(2, -1).T
    pixel = np.floor(origin).astype(int)[:, None] + window
    place = (pixel + 0.5 - origin[:, None]) @ np.linalg.inv(edges)
    face, which = np.nonzero(((place >= 0) & (place < 1)).all(axis=-1))
    (column, row), (s, t) = pixel[face, which].T, place[face, which].T
    return face, row, column, s, t


def _face_shade(
    occupied: Bool[np.ndarray, "x y z"],
    cells: Integer[np.ndarray, "n 3"],
    axis: int,
    view: Float[np.ndarray, "3 3"],
    cell: Integer[np.ndarray, " m"],
    s: Float[np.ndarray, " m"],
    t: Float[np.ndarray, " m"],
) -> Float[np.ndarray, " m"]:
    """Brightness at places of faces: diffuse light, darker in corners and along the edges."""
    sign = np.sign(view[2, axis])
    crowding = _corner_crowding(occupied, cells, axis, int(sign))[cell]
    weights = np.stack([(1 - s) * (1 - t), (1 - s) * t, s * (1 - t), s * t], axis=-1)
    ambient = 1 - 0.14 * (crowding * weights).sum(axis=-1)
    edge = np.minimum(np.minimum(s, 1 - s), np.minimum(t, 1 - t)) < 0.08
    return _brightness(sign * view[:, axis]) * ambient * np.where(edge, 0.86, 1.0)


def _corner_crowding(
    occupied: Bool[np.ndarray, "x y z"], cells: Integer[np.ndarray, "n 3"], axis: int, sign: int
) -> Integer[np.ndarray, "n 4"]:
    """How many of the three voxels in front of a face, around each of its corners, are filled.

    The usual cheap ambient occlusion of voxel games; two filled sides hide the third voxel.
    """
    padded = np.pad(occupied, 1)
    i, j, k = np.roll(np.eye(3, dtype=int), -axis - 1, axis=0)
    front = cells + 1 + sign * k

    def filled(step: np.ndarray) -> np.ndarray:
        return padded[tuple((front + step).T)].astype(int)

    counts = []
    for a in (-1, 1):
        for b in (-1, 1):
            side, other = filled(a * i), filled(b * j)
            counts.append(np.where(side & other, 3, side + other + filled(a * i + b * j)))
    return np.stack(counts, axis=-1)


def render_measurement(
    occupied: Bool[np.ndarray, "x y z"],
    occluded: Bool[np.ndarray, "x y z"],
    *,
    size: int = 256,
    azimuth: float = AZIMUTH,
    elevation: float = ELEVATION,
) -> UInt8[np.ndarray, "size size 3"]:
    """Draw F in colour, and M as a fog through which the F behind it shows."""
    colors = (COLORS["measured"], COLORS["occluded"])
    view = {"size": size, "azimuth": azimuth, "elevation": elevation}
    solid = render_voxels(occupied, colors, **view)
    fog = render_voxels(np.where(occupied, 1, 2 * occluded), colors, **view)
    return np.rint(0.5 * solid + 0.5 * fog).astype(np.uint8)


def draw_voxels(ax: Any, labels: Any, colors: Sequence[str] = (COLORS["predicted"],)) -> None:
    """Show `render_voxels` of a grid on a matplotlib axes."""
    ax.imshow(render_voxels(labels, colors, size=512))
    ax.axis("off")


# Meshes ----------------------------------------------------------------------------------------


def render_mesh(
    mesh: trimesh.Trimesh,
    *,
    color: str = COLORS["predicted"],
    size: int = 256,
    azimuth: float = AZIMUTH,
    elevation: float = ELEVATION,
) -> UInt8[np.ndarray, "size size 3"]:
    """Draw a mesh, smoothly shaded and scaled to fill the picture, by casting a ray per pixel.

    A mesh without faces gives a white picture. Fast where `embreex` is installed.
    """
    pixels = size * _SUPERSAMPLING
    canvas = np.ones((pixels * pixels, 3))
    if len(mesh.faces) == 0:
        return _to_image(canvas.reshape(pixels, pixels, 3))
    view = _view(azimuth, elevation)
    vertices = mesh.vertices @ view.T  # right, up, towards the viewer
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    step = _MARGIN * (high - low)[:2].max() / pixels
    across = (np.arange(pixels) + 0.5 - pixels / 2) * step
    y, x = np.meshgrid(-across, across, indexing="ij")
    center = (low + high) / 2
    origins = np.stack([center[0] + x, center[1] + y, np.full_like(x, high[2] + step)], axis=-1)
    directions = np.broadcast_to(-view[2], (pixels * pixels, 3))
    hits, rays, faces = mesh.ray.intersects_location(
        origins.reshape(-1, 3) @ view, directions, multiple_hits=False
    )
    corners = trimesh.triangles.points_to_barycentric(mesh.triangles[faces], hits)
    normals = np.einsum("nk,nkd->nd", corners, mesh.vertex_normals[mesh.faces[faces]]) @ view.T
    normals *= np.where(normals[:, 2:] < 0, -1, 1)  # open surfaces are seen from either side
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    canvas[rays] = _rgb(color) * _brightness(normals)[:, None]
    return _to_image(canvas.reshape(pixels, pixels, 3))


# Whole pictures --------------------------------------------------------------------------------


class Panel(NamedTuple):
    """One picture of a row, with a title above it and a note below it."""

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


def mesh_panel(title: str, mesh: trimesh.Trimesh, color: str, note: str = "") -> Panel:
    """Picture a mesh in an entry of `COLORS`."""
    return Panel(title, render_mesh(mesh, color=COLORS[color], size=_CELL), note)


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
        image[np.isinf(depth)] = _rgb(_PALE)
        image[~(depth > 0)] = _rgb(COLORS["occluded"])
        panels.append(Panel(f"depth {number}", np.rint(image * 255).astype(np.uint8)))
    return panels


_WIDTH, _GAP, _TEXT, _CELL = 1600, 16, 34, 400  # pixels


def overview(
    path: str | Path,
    *,
    depth_frames: Sequence[Float[np.ndarray, "_ _"]],
    columns: Sequence[Panel],
    caption: str = "",
) -> None:
    """Write the picture of one reconstruction, 1600 pixels wide.

    The depth images are above, the columns (grids, meshes) below them, then the caption.
    """
    from matplotlib.figure import Figure  # slow to import, and only pictures need it

    rows = [row for row in (depth_panels(depth_frames), columns) if row]
    heights = [_row_height(row) for row in rows]
    noted = [_TEXT * any(panel.note for panel in row) for row in rows]
    lines = _TEXT * (caption.count("\n") + 1) if caption else 0
    total = sum(heights) + sum(noted) + len(rows) * (_TEXT + _GAP) + lines + _GAP
    figure = Figure(figsize=(_WIDTH / 100, total / 100), dpi=100)
    top = _GAP
    for row, height, note in zip(rows, heights, noted, strict=True):
        _draw_row(figure, row, top / total, height / total)
        top += _TEXT + height + note + _GAP
    if caption:
        figure.text(0.5, 1 - top / total, caption, ha="center", va="top", fontsize=15, color=INK)
    with atomic_path(path) as temporary:
        figure.savefig(temporary)


def _row_height(row: Sequence[Panel]) -> int:
    """Height in pixels at which the panels of a row, none above 300 tall, share the width."""
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
