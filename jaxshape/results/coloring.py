"""Colours of a mesh from the frames that saw it. [host]

Each vertex takes its colour from the frames that show it best: frontally, from nearby, away from
the borders of images and of surfaces. A frame shows a vertex where its depth is that of the vertex,
up to the sensor's noise.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage
from scipy.spatial import KDTree

from jaxshape.geometry.pixels import Sensor

NEUTRAL = (201, 192, 177)
"""Grey-beige: the colour of vertices that no frame shows."""

BLENDED = 3
"""Largest number of frames that give a vertex its colour; each fades out before another takes its
place."""

FADE = 24.0
"""Distance from the border of an image, in pixels, over which the weight of a frame falls to 0."""

BLED, EDGE = 2.0, 8.0
"""Distances from a depth jump, in pixels. Within the first, colours may belong to the other
surface, because depth and colour are never registered exactly; from the second on, colours count in
full."""

DOUBTFUL = 1e-6
"""Weight of colours that may belong to the other surface: they count only where there is no other
colour, not even nearby."""

JUMP = 0.03
"""Neighbouring pixels lie on two surfaces if their depths differ by more than this share."""


class ColorView(NamedTuple):
    """A registered colour and depth image, and where they were taken.

    Attributes:
        color: Colour `[h w 3]`.
        depth: Depth `[h w]`, in metres; 0 where nothing is known, infinite where the ray met
            nothing.
        intrinsics: fx, fy, cx and cy, in pixels.
        T_object_camera: Camera to object `[4 4]`.
    """

    color: UInt8[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"]
    intrinsics: tuple[float, float, float, float]
    T_object_camera: Float[np.ndarray, "4 4"]


def color_vertices(
    mesh: trimesh.Trimesh,
    measured: Bool[np.ndarray, " n"],
    views: Iterable[ColorView],
    *,
    reach: float,
    sensor: Sensor = Sensor(),
) -> UInt8[np.ndarray, "n 3"] | None:
    """Colours of the vertices of a mesh.

    Args:
        mesh: Mesh in the object frame, in metres.
        measured: True for vertices on the measured surface; the others are neutral.
        views: Frames that may show it.
        reach: Distance in metres over which measured vertices that no frame shows take over a
            nearby colour. Depths may differ by a quarter of it beyond the sensor's noise.
        sensor: Noise of the camera's depth.

    Returns:
        One colour for each vertex; None where there are no frames.
    """
    points, normals = mesh.vertices[measured], mesh.vertex_normals[measured]
    quality = np.zeros((BLENDED + 1, len(points)), np.float32)
    colors = np.zeros((BLENDED + 1, len(points), 3), np.float32)
    view = None
    for view in views:
        worst = quality.argmin(axis=0), np.arange(len(points))
        new, color = _shown(points, normals, view, reach, sensor)
        better = new > quality[worst]
        quality[worst] = np.where(better, new, quality[worst])
        colors[worst] = np.where(better[:, None], color, colors[worst])
    if view is None:
        return None
    found = np.full((len(mesh.vertices), 3), NEUTRAL, np.uint8)
    found[measured] = _spread(points, _blended(quality, colors), quality.max(axis=0), reach)
    return found


def _shown(
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    view: ColorView,
    reach: float,
    sensor: Sensor,
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """The quality of a frame's view of each point, 0 where hidden, and the colours it shows."""
    R, t = view.T_object_camera[:3, :3], view.T_object_camera[:3, 3]
    fx, fy, cx, cy = view.intrinsics
    x, y, z = ((points - t) @ R).T
    ahead = np.where(z > 1e-6, z, 1.0)
    at = np.stack([fy * y / ahead + cy, fx * x / ahead + cx]) - 0.5  # row and column
    (h, w), (row, column) = view.depth.shape, at
    border = np.min([row, column, h - 1 - row, w - 1 - column], axis=0)
    pixel = tuple(np.rint(at).clip([[0], [0]], [[h - 1], [w - 1]]).astype(int))
    cosine = ((t - points) * normals).sum(axis=1) / np.linalg.norm(t - points, axis=1).clip(1e-9)
    tolerance = reach / 4 + 4 * sensor.axial * z**2 + sensor.floor
    is_shown = (z > 1e-6) & (border > 0) & (cosine > 0.1)
    is_shown &= np.abs(view.depth[pixel] - z) < tolerance
    edge = (_from_jumps(view.depth)[pixel] - BLED) / (EDGE - BLED)
    sure = np.clip(border / FADE, 0, 1) * np.clip(edge, DOUBTFUL, 1)
    color = np.stack(
        [ndimage.map_coordinates(view.color[..., i], at, np.float32, 1, "nearest")
         for i in range(3)], axis=1
    )  # fmt: skip
    return np.where(is_shown, sure * cosine**2 / ahead**2, 0), color


def _from_jumps(depth: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Distance of each pixel, in pixels, to the nearest depth jump or unknown pixel."""
    known = np.where(np.isfinite(depth), depth, 1e3)
    low, high = ndimage.minimum_filter(known, 3), ndimage.maximum_filter(known, 3)
    is_smooth = np.pad(high - low < JUMP * known, 1, constant_values=True)
    if is_smooth.all():
        return np.full(depth.shape, np.inf)
    return np.asarray(ndimage.distance_transform_edt(is_smooth))[1:-1, 1:-1]


def _blended(
    quality: Float[np.ndarray, "k n"], colors: Float[np.ndarray, "k n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Mean colour of the best frames. The worst of them has no weight, so that no frame appears
    abruptly from one vertex to the next."""
    weight = (quality - quality.min(axis=0) + 1e-4 * quality + 1e-12) ** 2
    return np.einsum("kn,knd->nd", weight / weight.sum(axis=0), colors)


def _spread(
    points: Float[np.ndarray, "n 3"],
    color: Float[np.ndarray, "n 3"],
    quality: Float[np.ndarray, " n"],
    reach: float,
) -> UInt8[np.ndarray, "n 3"]:
    """Colours of all points: doubtful ones take the colour of a sure point, if one is near."""
    found = np.where(quality[:, None] > 0, color, NEUTRAL)
    sure = quality > 20 * DOUBTFUL  # no frame is taken from less than 0.3 m
    if sure.any() and not sure.all():
        away, nearest = KDTree(points[sure]).query(points[~sure])
        near = np.asarray(away) < reach
        found[np.flatnonzero(~sure)[near]] = color[sure][np.asarray(nearest)[near]]
    return np.rint(found).astype(np.uint8)
