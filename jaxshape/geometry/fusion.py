"""Depth frames to the measurement grid F and the occlusion mask M (paper, Eq. 6, section 3.2).

One frame gives a `Measurement`; two measurements of the same object merge into one. Merging is
associative and commutative with `nothing_measured()` as its identity, so frames can be added one at
a time, all at once, or cumulatively, always with the same grids.
"""

from collections.abc import Iterable
from typing import NamedTuple

import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from jaxshape.geometry import camera
from jaxshape.geometry.camera import Intrinsics
from jaxshape.geometry.grid import RESOLUTION, GridFrame, flat_index


class Measurement(NamedTuple):
    """Evidence of a set of depth frames for each voxel; leading axes are batch axes.

    Attributes:
        hits: Measured surface points that fell into the voxel `[*batch x y z]`, 0 or more.
        seen_through: True if a frame measured a surface behind the voxel's centre, or if its ray
            through the centre hit nothing `[*batch x y z]`.
    """

    hits: Int[Array, "*batch x y z"]
    seen_through: Bool[Array, "*batch x y z"]


def nothing_measured(resolution: int = RESOLUTION) -> Measurement:
    """The measurement before any frame.

    Args:
        resolution: Voxels along each axis.
    """
    shape = (resolution,) * 3
    return Measurement(jnp.zeros(shape, jnp.int32), jnp.zeros(shape, bool))


def measure(
    depth: Float[Array, "h w"],
    segmented: Bool[Array, "h w"],
    intrinsics: Intrinsics,
    T_object_camera: jaxlie.SE3,
    frame: GridFrame,
    resolution: int = RESOLUTION,
) -> Measurement:
    """Discretise one depth frame: `D(T P)` of Eq. 6, and the free space that its rays crossed.

    Only segmented pixels put points into voxels. Every valid pixel, also of the background, marks
    the space in front of it as free; the space behind another object stays occluded.

    Args:
        depth: Depth image `[h w]`, in metres; 0 for missing depth, infinite where the ray hit
            nothing.
        segmented: True on pixels that show the object `[h w]`.
        intrinsics: The camera, without batch axes.
        T_object_camera: Pose of the camera in the object frame, without batch axes.
        frame: Voxel frame of the grid, without batch axes.
        resolution: Voxels along each axis of the grid.

    Returns:
        The measurement of this frame `[x y z]`.
    """
    # One affine map in each direction, with separate arrays for the coordinates: XLA then computes
    # everything before the count or look-up in one pass, which is many times as fast on CPU.
    R, t = T_object_camera.rotation().as_matrix(), T_object_camera.translation()
    voxel_from_camera = R / frame.voxel_size[:, None], (t - frame.origin) / frame.voxel_size
    camera_from_voxel = R.T * frame.voxel_size, R.T @ (frame.origin - t)

    measured = segmented & (depth > 0) & jnp.isfinite(depth)
    points = camera.unproject(intrinsics, jnp.where(measured, depth, jnp.nan))
    hits = _count(_affine(*voxel_from_camera, *jnp.moveaxis(points, -1, 0)), resolution)

    center = jnp.arange(resolution) + 0.5
    centers = _affine(*camera_from_voxel, center[:, None, None], center[:, None], center)
    pixels, center_depth = camera.project(intrinsics, jnp.stack(centers, axis=-1))
    seen_through = (center_depth > 0) & (center_depth < camera.look_up(depth, pixels))
    return Measurement(hits, seen_through)


def merge(first: Measurement, second: Measurement) -> Measurement:
    """The measurement of two sets of frames together.

    Args:
        first: Measurement of one set of frames.
        second: Measurement of another set, in the same voxel frame.
    """
    return Measurement(first.hits + second.hits, first.seen_through | second.seen_through)


def merge_all(frames: Measurement) -> Measurement:
    """The measurement of all frames together.

    Args:
        frames: Measurements `[frame *batch x y z]`, in the same voxel frame; the leading axis is
            merged.
    """
    return Measurement(frames.hits.sum(axis=0), frames.seen_through.any(axis=0))


def merge_cumulative(frames: Measurement) -> Measurement:
    """Merge the first 1, 2, ... frames.

    Args:
        frames: Measurements `[frame *batch x y z]`, in the same voxel frame.

    Returns:
        Measurements of the same shape; entry k holds frames 0 to k.
    """
    seen_through = jnp.cumsum(frames.seen_through, axis=0) > 0
    return Measurement(jnp.cumsum(frames.hits, axis=0), seen_through)


def occupied(measurement: Measurement, min_hits: int = 1) -> Bool[Array, "*batch x y z"]:
    """The measurement grid **F**: voxels into which enough measured points fell (paper, Eq. 6).

    Args:
        measurement: Measurement of all frames `[*batch x y z]`.
        min_hits: Points that make a voxel occupied, 1 or more (paper: 1). More suppress the stray
            points of a real sensor.

    Returns:
        True where the surface was measured `[*batch x y z]`.
    """
    return measurement.hits >= min_hits


def occluded(measurement: Measurement, min_hits: int = 1) -> Bool[Array, "*batch x y z"]:
    """The occlusion mask **M**: voxels neither on the measured surface nor seen through (paper,
    section 3.2).

    Args:
        measurement: Measurement of all frames `[*batch x y z]`.
        min_hits: Points that make a voxel occupied, 1 or more, as for `occupied`.

    Returns:
        True where nothing is known `[*batch x y z]`.
    """
    return ~(occupied(measurement, min_hits) | measurement.seen_through)


def count_points(voxels: Float[Array, "n 3"], resolution: int = RESOLUTION) -> Int[Array, "x y z"]:
    """Count the points that fall into each voxel: the paper's `D(.)`.

    Points outside the grid, and those that are not finite, are dropped.

    Args:
        voxels: Points in voxel coordinates `[n 3]`.
        resolution: Voxels along each axis.
    """
    return _count(voxels.T, resolution)


def _count(coordinates: Iterable[Float[Array, "..."]], resolution: int) -> Int[Array, "x y z"]:
    """Count the points that fall into each voxel, from their x, y and z."""
    index = flat_index(coordinates, resolution).ravel()
    hits = jnp.zeros(resolution**3, jnp.int32).at[index].add(1, mode="drop")
    return hits.reshape((resolution,) * 3)


def _affine(matrix: Float[Array, "3 3"], shift: Float[Array, " 3"], x, y, z) -> list[Array]:
    """`matrix @ (x, y, z) + shift`, for coordinates that broadcast."""
    return [a * x + b * y + c * z + d for (a, b, c), d in zip(matrix, shift, strict=True)]
