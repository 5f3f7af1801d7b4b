"""Depth frames to the measurement grid F and the occlusion mask M (paper, Eq. 6, section 3.2).

One frame gives a `Measurement`; two measurements of the same object merge into one. Merging is
associative and commutative with `nothing_measured()` as its identity, so frames can be added one at
a time, all at once, or cumulatively, and every way gives the same grids.
"""

from typing import NamedTuple

import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from jaxshape.geometry import camera, grid
from jaxshape.geometry.camera import Intrinsics
from jaxshape.geometry.grid import RESOLUTION, GridFrame


class Measurement(NamedTuple):
    """What a set of frames says about each voxel."""

    hits: Int[Array, "*batch x y z"]
    """Measured surface points that fell into the voxel."""
    seen_through: Bool[Array, "*batch x y z"]
    """True where some frame measured a surface behind the voxel's centre, or nothing at all."""


def nothing_measured(resolution: int = RESOLUTION) -> Measurement:
    """The measurement of no frames."""
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
    """Discretise one depth frame: `D(T P)` of Eq. 6, and the space it looked through.

    `depth` is in metres, 0 where nothing is known and infinite where the ray met nothing;
    `segmented` is True on pixels that show the object. Only segmented pixels put points into
    voxels, but every valid pixel looks through the space in front of it, so background frees space
    and a foreign object in front keeps what is behind it occluded.
    """
    points = camera.transform(T_object_camera, camera.unproject(intrinsics, depth).reshape(-1, 3))
    measured = (segmented & (depth > 0) & jnp.isfinite(depth)).reshape(-1, 1)
    points = jnp.where(measured, points, jnp.nan)
    hits = count_points(grid.voxel_from_object(frame, points), resolution)

    centers = camera.transform(T_object_camera.inverse(), grid.voxel_centers(frame, resolution))
    pixels, center_depth = camera.project(intrinsics, centers)
    measured_depth = _look_up(depth, pixels)
    seen_through = (center_depth > 0) & (center_depth < measured_depth)
    return Measurement(hits, seen_through.reshape(hits.shape))


def merge(first: Measurement, second: Measurement) -> Measurement:
    """The measurement of both sets of frames."""
    return Measurement(first.hits + second.hits, first.seen_through | second.seen_through)


def merge_all(frames: Measurement) -> Measurement:
    """Merge the leading axis of frames."""
    return Measurement(frames.hits.sum(axis=0), frames.seen_through.any(axis=0))


def merge_cumulative(frames: Measurement) -> Measurement:
    """Merge the first 1, 2, ... frames of the leading axis; entry k holds frames 0 to k."""
    seen_through = jnp.cumsum(frames.seen_through, axis=0) > 0
    return Measurement(jnp.cumsum(frames.hits, axis=0), seen_through)


def occupied(measurement: Measurement, min_hits: int = 1) -> Bool[Array, "*batch x y z"]:
    """The measurement grid **F**: voxels hit by at least `min_hits` points.

    The paper has `min_hits = 1`; more suppresses the stray points of a real sensor.
    """
    return measurement.hits >= min_hits


def occluded(measurement: Measurement, min_hits: int = 1) -> Bool[Array, "*batch x y z"]:
    """The occlusion mask **M**: neither on the measured surface nor seen through by any frame."""
    return ~(occupied(measurement, min_hits) | measurement.seen_through)


def count_points(voxels: Float[Array, "n 3"], resolution: int = RESOLUTION) -> Int[Array, "x y z"]:
    """How many points, given in voxel coordinates, fall into each voxel: the paper's `D(.)`.

    Points outside the grid, and those that are not finite, are dropped.
    """
    index = jnp.floor(jnp.where(jnp.isfinite(voxels), voxels, -1.0)).astype(jnp.int32)
    inside = jnp.all((index >= 0) & (index < resolution), axis=-1)
    x, y, z = jnp.where(inside[:, None], index, resolution).T
    hits = jnp.zeros((resolution,) * 3, jnp.int32)
    return hits.at[x, y, z].add(1, mode="drop")


def _look_up(depth: Float[Array, "h w"], pixels: Float[Array, "n 2"]) -> Float[Array, " n"]:
    """Depth at the pixel that holds each image point; 0, nothing known, outside the image."""
    h, w = depth.shape
    column, row = jnp.floor(pixels).astype(jnp.int32).T
    inside = (column >= 0) & (column < w) & (row >= 0) & (row < h)
    row, column = jnp.where(inside, row, h), jnp.where(inside, column, w)
    return depth.at[row, column].get(mode="fill", fill_value=0.0)
