"""Pictures of grids and meshes, on white.

Objects are drawn orthographically with +y up. `azimuth` is 0 in front of the object (+z) and grows
towards its +x side, as for the cameras; `elevation` grows upwards; both are in degrees.
"""

from collections.abc import Sequence

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Integer, UInt8
from trimesh.ray import has_embree

from jaxshape.data.rays import rasterize
from jaxshape.report.palette import COLORS

AZIMUTH, ELEVATION = 35.0, 25.0

_SUPERSAMPLING = 2  # pixels averaged along each axis, to smooth edges
_ROWS = 64  # rows of rays that are cast together
_MARGIN = 1.02  # room around the object, as a factor of its extent
_LIGHT = np.array([-0.35, 0.8, 0.5]) / np.linalg.norm([-0.35, 0.8, 0.5])  # right, up, towards us
_AMBIENT = 0.68


def rgb(color: str) -> Float[np.ndarray, " 3"]:
    """The parts of a colour `#rrggbb`, between 0 and 1."""
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
    palette = np.stack([rgb(color) for color in colors])
    canvas = np.ones((pixels, pixels, 3))
    nearest = np.full((pixels, pixels), -np.inf)
    for axis in (axis for axis in range(3) if abs(view[2, axis]) > 1e-6):  # no faces edge-on
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
    """Occupied cells whose face along `axis` is visible to the viewer, farthest first."""
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

    Faces come in the order of `cells`; coordinates are relative to the centre of the picture.
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
    """Number of filled voxels, of three, in front of a face around each of its corners.

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


# Meshes ----------------------------------------------------------------------------------------


def render_mesh(
    mesh: trimesh.Trimesh,
    *,
    color: str | UInt8[np.ndarray, "n 3"] = COLORS["predicted"],
    size: int = 256,
    azimuth: float = AZIMUTH,
    elevation: float = ELEVATION,
) -> UInt8[np.ndarray, "size size 3"]:
    """Draw a mesh, smoothly shaded and scaled to fill the picture.

    `color` is one colour as `#rrggbb`, or one for each vertex. A mesh without faces gives a white
    picture.
    """
    pixels = size * _SUPERSAMPLING
    canvas = np.ones((pixels, pixels, 3))
    if len(mesh.faces) == 0:
        return _to_image(canvas)
    view = _view(azimuth, elevation)
    vertices = mesh.vertices @ view.T  # right, up, towards the viewer
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    step = _MARGIN * (high - low)[:2].max() / pixels
    across = (np.arange(pixels) + 0.5 - pixels / 2) * step
    x, y = (low + high)[0] / 2 + across, (low + high)[1] / 2 - across
    far = high[2] + step  # the plane of the viewer
    faces = _first_faces(mesh, vertices, view, x, y, far)
    for rows in _bands(pixels):
        row, column = np.nonzero(faces[rows] >= 0)
        points = np.stack([x[column], y[rows][row]], axis=1)
        seen = faces[rows][row, column]
        canvas[rows][row, column] = _shades(mesh, vertices, seen, points, view, color)
    return _to_image(canvas)


def _bands(pixels: int) -> list[slice]:
    """Rows that are drawn together: a whole picture at once takes hundreds of megabytes."""
    return [slice(first, first + _ROWS) for first in range(0, pixels, _ROWS)]


def _first_faces(
    mesh: trimesh.Trimesh,
    vertices: Float[np.ndarray, "n 3"],
    view: Float[np.ndarray, "3 3"],
    x: Float[np.ndarray, " w"],
    y: Float[np.ndarray, " h"],
    far: float,
) -> Integer[np.ndarray, "h w"]:
    """The face that each pixel shows, of those that face it from the plane `far`; -1 for none."""
    if not has_embree:
        corners = vertices[mesh.faces]
        flat = corners * [1, 1, 0] + [0, 0, 1]
        return rasterize(flat, far - corners[..., 2], x, y[::-1])[::-1]
    faces = []
    for rows in _bands(len(y)):
        across, down = np.meshgrid(x, y[rows])
        origins = np.stack([across, down, np.full_like(across, far)], axis=-1).reshape(-1, 3) @ view
        directions = np.broadcast_to(-view[2], origins.shape)
        faces.append(mesh.ray.intersects_first(origins, directions).reshape(across.shape))
    return np.concatenate(faces)


def _shades(
    mesh: trimesh.Trimesh,
    vertices: Float[np.ndarray, "n 3"],
    faces: Integer[np.ndarray, " m"],
    points: Float[np.ndarray, "m 2"],
    view: Float[np.ndarray, "3 3"],
    color: str | UInt8[np.ndarray, "v 3"],
) -> Float[np.ndarray, "m 3"]:
    """The shaded colours of faces at points of the picture, given as right and up."""
    flat = vertices[mesh.faces[faces]] * [1, 1, 0]
    flat_points = np.concatenate([points, np.zeros((len(points), 1))], axis=1)
    corners = trimesh.triangles.points_to_barycentric(flat, flat_points)
    normals = np.einsum("nk,nkd->nd", corners, mesh.vertex_normals[mesh.faces[faces]]) @ view.T
    normals *= np.where(normals[:, 2:] < 0, -1, 1)  # open surfaces are seen from either side
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    paint = rgb(color) if isinstance(color, str) else np.einsum(
        "nk,nkd->nd", corners, color[mesh.faces[faces]] / 255
    )  # fmt: skip
    return paint * _brightness(normals)[:, None]
