"""The faces of the object's box, and whether the keyframes have seen them. [host]

A face was seen if rays passed just outside of the measured points: the object ends there, and so
does its box. The prior gives the position of a face that was not seen.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxshape.data.boxes import Box, in_object
from jaxshape.geometry.camera import Intrinsics
from jaxshape.mapping.placement.placing import PlacementConfig
from jaxshape.mapping.tracking.keyframes import Keyframe

FACES = (("left side", "right side"), ("bottom", "top"), ("back", "front"))
"""Names of the faces at the lower and the upper end of each axis, for a person who sits there."""

SEEN = 0.5
"""Share of the space just outside of the object that rays must pass for a face to be seen."""

BEYOND = 0.05
"""Depth of that space, in metres."""

PADDING = 0.005
"""Distance between the outermost measured points and a face that was seen, in metres."""

FIT = 0.02
"""Distance in metres within which a face must lie from the seen end of the object."""

CLEAR = 0.02
"""Distance from a point to the hit of a ray behind it, in metres, at which the ray has surely
passed the point."""

STRAY = 1 / 1000
"""Share of the measured points that may lie beyond a face because of noise. It is less than that of
a castor."""

SPREADS = 2.0
"""Size of the prior's largest object, in standard deviations of the logarithms of the extents."""


class Cutout(NamedTuple):
    """A depth image, and the object in it.

    Attributes:
        depth: Depth image `[h w]`, in metres; 0 where nothing is known, infinite where the ray met
            nothing.
        segmented: True on pixels that show the object `[h w]`.
        intrinsics: The camera.
        T_world_camera: Pose of the camera `[4 4]`.
    """

    depth: Float[Array | np.ndarray, "h w"]
    segmented: Bool[Array | np.ndarray, "h w"]
    intrinsics: Intrinsics
    T_world_camera: Float[np.ndarray, "4 4"]


def cutouts(keyframes: tuple[Keyframe, ...]) -> list[Cutout]:
    """The object in each keyframe.

    Args:
        keyframes: The keyframes of a map.

    Returns:
        The cutout of each, in the same order.
    """
    return [
        Cutout(one.depth, one.segmented, one.intrinsics, np.asarray(one.T_world_camera.as_matrix()))
        for one in keyframes
    ]


class Faces(NamedTuple):
    """Ends of the object along the axes of its box, in the object frame of that box.

    Attributes:
        lower: Ends of the measured points on the lower side of each axis `[3]`, in metres.
        upper: Ends on the upper side `[3]`, in metres.
        seen: Whether the object was seen to end there, lower then upper `[2 3]`.
    """

    lower: Float[np.ndarray, " 3"]
    upper: Float[np.ndarray, " 3"]
    seen: Bool[np.ndarray, "2 3"]


def faces_of(box: Box, views: list[Cutout]) -> Faces | None:
    """The ends of the object's measured points along the axes of its box.

    Args:
        box: The object's box, which gives the axes and the size of the faces.
        views: Views of the object.

    Returns:
        The ends, and whether the object was seen to end there; None where nothing was measured.
    """
    points = in_object(object_points(views), box)
    stray = int(len(points) * STRAY)
    if len(points) < 3:
        return None
    ordered = np.sort(points, axis=0)
    lower, upper = ordered[stray], ordered[-1 - stray]
    passed = [
        [_passed_outside(box, lower, upper, axis, side, views) for axis in range(3)]
        for side in (0, 1)
    ]
    return Faces(lower, upper, np.array(passed) > SEEN)


def fitted(box: Box, faces: Faces | None) -> Box:
    """The box with all seen faces moved to the ends of the object, and no face that cuts it.

    Args:
        box: The object's box.
        faces: The ends of the object along its axes; None where nothing was measured.

    Returns:
        The box; its bottom does not move if it stands on a floor, which it then excludes.
    """
    if faces is None:
        return box
    half = box.size / 2
    lower = np.where(faces.seen[0], faces.lower - PADDING, np.minimum(faces.lower, -half))
    upper = np.where(faces.seen[1], faces.upper + PADDING, np.maximum(faces.upper, half))
    if len(box.exclude):  # its bottom stands on the floor
        lower[1] = -half[1]
    return between(box, lower, upper)


def fits(box: Box, faces: Faces | None) -> bool:
    """Whether the box ends within `FIT` of where the object was seen to end.

    Args:
        box: The object's box.
        faces: The ends of the object along its axes; None where nothing was measured.
    """
    fitting = fitted(box, faces)
    moved = in_object(fitting.T_world_object[:3, 3], box)
    return bool((np.abs(moved) + np.abs(fitting.size - box.size) / 2 < FIT).all())


def between(box: Box, lower: Float[np.ndarray, " 3"], upper: Float[np.ndarray, " 3"]) -> Box:
    """The box with other corners, given in its own object frame.

    Args:
        box: The box, whose axes stay.
        lower: Its new lowest corner `[3]`, in metres.
        upper: Its new highest corner `[3]`, in metres.

    Returns:
        The box, which excludes the same part of the world.
    """
    middle = (lower + upper) / 2
    T = box.T_world_object.copy()
    T[:3, 3] += T[:3, :3] @ middle
    return Box(T, upper - lower, box.exclude - middle)


def reach_of(box: Box) -> tuple[Box, Box]:
    """The largest box that an object may fill if it fills at least this one, and its column.

    Args:
        box: The object's box, as far as it is known.

    Returns:
        The box that reaches to all sides as far as the prior's largest objects do, but not into
        what is excluded; and the part of it above and below the given box.
    """
    more = np.maximum(_largest() - box.size, 0)
    lower, upper = -box.size / 2, box.size / 2
    vertical = np.array([0.0, 1.0, 0.0])
    around = more * vertical + 0.1 * box.size * (1 - vertical)
    return between(box, lower - more, upper + more), between(box, lower - around, upper + around)


def tallest() -> float:
    """Height of the prior's largest objects, in metres."""
    return float(_largest()[1])


def _largest() -> Float[np.ndarray, " 3"]:
    """Extents of the prior's largest objects, in metres, whichever way their front is turned."""
    config = PlacementConfig()
    largest = np.array(config.typical_size) * np.exp(SPREADS * np.array(config.size_spread))
    largest[[0, 2]] = largest[[0, 2]].max()
    return largest


# Points ------------------------------------------------------------------------------------------


def object_points(views: list[Cutout]) -> Float[np.ndarray, "n 3"]:
    """Points of the object in the world.

    Args:
        views: Views of the object.

    Returns:
        The points of all segmented pixels that have a depth `[n 3]`, in metres.
    """
    clouds = [world_points(one)[np.asarray(one.segmented)] for one in views]
    points = np.concatenate([np.zeros((0, 3)), *clouds])
    return points[np.isfinite(points).all(axis=1)]


def world_points(view: Cutout) -> Float[np.ndarray, "h w 3"]:
    """The point of each pixel in the world.

    Args:
        view: The view.

    Returns:
        The points `[h w 3]`, in metres; NaN where nothing was measured.
    """
    fx, fy, cx, cy = (float(x) for x in view.intrinsics)
    z = np.asarray(view.depth, np.float64)
    z = np.where((z > 0) & np.isfinite(z), z, np.nan)
    v, u = np.indices(z.shape) + 0.5
    points = np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z], axis=-1)
    T = view.T_world_camera
    return points @ T[:3, :3].T + T[:3, 3]


def _passed_outside(
    box: Box,
    lower: Float[np.ndarray, " 3"],
    upper: Float[np.ndarray, " 3"],
    axis: int,
    side: int,
    views: list[Cutout],
) -> float:
    """Share of the space just outside of one end of the object that rays of some view passed.

    The space lies in front of the middle of the face, down to the bottom of the box: if only the
    back of a chair was measured, free space in front of it says nothing about the seat. The result
    is the smaller share of the two halves of this space, the upper and the lower one.
    """
    low, high = np.minimum(lower, -box.size / 2), np.maximum(upper, box.size / 2)
    rims = 0.1 * (high - low)
    low, high = low + rims, high - rims
    low[axis] = upper[axis] + CLEAR if side else lower[axis] - BEYOND
    high[axis] = upper[axis] + BEYOND if side else lower[axis] - CLEAR
    steps = [np.linspace(low[i], high[i], 3 if i == axis else 12) for i in range(3)]
    points = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
    world = points @ box.T_world_object[:3, :3].T + box.T_world_object[:3, 3]
    passed = np.any([_passed(world, one) for one in views], axis=0)
    is_upper = points[:, 1] > np.median(points[:, 1])
    halves = [passed[is_upper], passed[~is_upper]]
    return min(float(half.mean()) for half in halves if len(half))


def _passed(points: Float[np.ndarray, "n 3"], view: Cutout) -> Bool[np.ndarray, " n"]:
    """Points in the world that a keyframe saw through."""
    inside, row, column, z = looked_at(points, view)
    return inside & (np.asarray(view.depth)[row, column] > z + CLEAR)


def looked_at(
    points: Float[np.ndarray, "n 3"], view: Cutout
) -> tuple[
    Bool[np.ndarray, " n"], Int[np.ndarray, " n"], Int[np.ndarray, " n"], Float[np.ndarray, " n"]
]:
    """Where points lie in the image of a view.

    Args:
        points: The points in the world `[n 3]`, in metres.
        view: The view.

    Returns:
        Whether each point lies in the image and in front of the camera, the row and the column of
        its pixel, 0 where it does not, and its depth in metres.
    """
    T = np.linalg.inv(view.T_world_camera)
    p = points @ T[:3, :3].T + T[:3, 3]
    fx, fy, cx, cy = (float(x) for x in view.intrinsics)
    z = np.maximum(p[:, 2], 1e-6)
    u, v = np.floor(fx * p[:, 0] / z + cx), np.floor(fy * p[:, 1] / z + cy)
    h, w = view.depth.shape
    inside = (p[:, 2] > 0) & (0 <= u) & (u < w) & (0 <= v) & (v < h)
    row, column = (np.where(inside, x, 0).astype(int) for x in (v, u))
    return inside, row, column, z
