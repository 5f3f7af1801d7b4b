"""Points on an object, and free points around it, from depth frames.

Their number is always the same, whatever the size and number of the images, so that functions of
them are compiled once. Free points are dense near the object: they tell where it ends.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key

from jaxshape.geometry import camera, fusion, grid
from jaxshape.geometry.camera import Intrinsics
from jaxshape.geometry.symmetry import greatest_nearby

SURFACE_POINTS, FREE_POINTS = 8192, 4096
"""Numbers of points: on the object, enough to fill a grid, and in free space."""

FREE_CANDIDATES = 4 * FREE_POINTS
"""Number of free points of each frame, from which those of all frames together are drawn."""

EXTENT = 0.7
"""Rough size of an object, in metres."""

REACH = 1.2
"""Radius of the ball around the object in which rays count, in typical extents."""

FREE_GAP = 0.06
"""Length of the last stretch of a ray before its hit that does not count as free space, in typical
extents. It covers noise and the thickness of a voxel."""

CELL, CELLS = 0.07, 40
"""Edge of the cells in which free points are counted, in typical extents, and their number along
each axis."""

FADING, FADED = 0.7, 10
"""Density of free points in a cell, relative to the next cell towards the object, and the number of
cells from which on it is constant."""


class RaySamples(NamedTuple):
    """Points on an object, and free points around it, from depth frames.

    Attributes:
        surface: Measured points of the object `[*batch n 3]`, in metres and in random order.
        free: Points in free space `[*batch m 3]`, in metres. Those of one frame are spread evenly
            over the free parts of the rays around the object; those of several frames evenly over
            space, but more densely near the object.
        away: Direction from the camera to the object `[*batch 3]`; for several frames the mean of
            the unit vectors, which is short where the object was seen from all sides.
    """

    surface: Float[Array, "*batch n 3"]
    free: Float[Array, "*batch m 3"]
    away: Float[Array, "*batch 3"]


def sample_rays(
    key: Key[Array, ""],
    depth: Float[Array, "h w"],
    segmented: Bool[Array, "h w"],
    intrinsics: Intrinsics,
    extent: float = EXTENT,
) -> RaySamples:
    """Samples of one frame, in the frame of its camera; the same number of points for every frame.

    All rays mark free space, on the stretch where they pass near the object.

    Args:
        key: Random key of the samples.
        depth: Depth image `[h w]`, in metres; 0 where nothing is known, infinite where the ray met
            nothing.
        segmented: True on pixels that show the object `[h w]`.
        intrinsics: The camera.
        extent: Rough size of the object, in metres.

    Returns:
        The samples; NaN where no segmented pixel has a depth.
    """
    surface_key, ray_key, depth_key = jax.random.split(key, 3)
    rays = camera.unproject(intrinsics, jnp.ones_like(depth)).reshape(-1, 3)
    end, is_object = depth.ravel(), segmented.ravel()
    is_object &= (end > 0) & jnp.isfinite(end)
    points = rays * jnp.where(is_object, end, jnp.nan)[:, None]
    center = jnp.nanmean(points, axis=0)

    # Rays are free from where they enter a ball around the object until shortly before their end.
    near, far = _through_ball(rays, center, REACH * extent)
    far = jnp.minimum(far, end - FREE_GAP * extent)
    length = jnp.where(jnp.isnan(center[0]), 0, jnp.maximum(far - near, 0))
    ray = _draw(ray_key, jnp.int32(length / (REACH * extent) * 500), FREE_CANDIDATES)
    z = near[ray] + length[ray] * jax.random.uniform(depth_key, ray.shape)
    return RaySamples(
        surface=points[_draw(surface_key, jnp.int32(is_object), SURFACE_POINTS)],
        free=rays[ray] * z[:, None],
        away=center / jnp.linalg.norm(center),
    )


def _through_ball(
    rays: Float[Array, "n 3"], center: Float[Array, " 3"], radius: float
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Factors at which rays from the origin enter a ball and leave it; equal where they miss."""
    squared = jnp.sum(rays**2, axis=-1)
    middle = rays @ center / squared
    half = jnp.sqrt(jnp.maximum(middle**2 - (center @ center - radius**2) / squared, 0))
    return jnp.maximum(middle - half, 0), middle + half


def _draw(key: Key[Array, ""], weight: Int[Array, " n"], count: int) -> Int[Array, " k"]:
    """Indices drawn with replacement, in proportion to their weights; never one of weight 0.

    Weights are whole numbers, because rounding in a running sum would let any index be drawn.
    """
    total = jnp.cumsum(weight)
    mark = jax.random.randint(key, (count,), 0, total[-1])
    return jnp.searchsorted(total, mark, side="right")


def pooled(samples: RaySamples, T_world_camera: jaxlie.SE3, extent: float = EXTENT) -> RaySamples:
    """Samples of several frames together, as many points whatever the number of frames.

    Frames in which nothing was segmented are left out.

    Args:
        samples: Samples of the frames, along a leading axis, each in the frame of its camera.
        T_world_camera: Poses of the frames.
        extent: Rough size of the object, in metres.

    Returns:
        The samples in the world.
    """
    is_empty = jnp.isnan(samples.away[:, 0])
    frames = jnp.argsort(is_empty)  # the others first
    count = jnp.maximum(jnp.sum(~is_empty), 1)
    place = jnp.arange(samples.surface.shape[1])
    surface = camera.transform(T_world_camera, samples.surface)
    surface = surface[frames[place % count], place]  # which are in random order
    free = camera.transform(T_world_camera, samples.free).reshape(-1, 3)
    away = jnp.nanmean(T_world_camera.rotation() @ samples.away, axis=0)
    return RaySamples(surface, free[_spread(free, surface, CELL * extent)], away)


def _spread(
    free: Float[Array, "n 3"], surface: Float[Array, "m 3"], cell: float
) -> Int[Array, " k"]:
    """Indices of free points that are spread evenly over space, but more densely near the object.

    Rays are dense near the camera and where many frames look. The density of the chosen points
    depends only on the distance from the measured surface.
    """
    center = jnp.median(surface, axis=0)
    surface, free = ((points - center) / cell + CELLS / 2 for points in (surface, free))
    near = jnp.float32(fusion.count_points(surface, CELLS) > 0)
    near = lax.fori_loop(0, FADED, lambda _, x: jnp.maximum(x, FADING * greatest_nearby(x)), near)
    density = jnp.maximum(near, FADING**FADED) / jnp.maximum(fusion.count_points(free, CELLS), 1)
    weight = density.ravel().at[grid.flat_index(free.T, CELLS)].get(mode="fill", fill_value=0)
    # Without the maximum, rounding in the running sum would let points of weight 0 be chosen.
    total = lax.cummax(jnp.where(weight > 0, jnp.cumsum(weight), 0))
    mark = (jnp.arange(FREE_POINTS) + 0.5) * (total[-1] / FREE_POINTS)
    return jnp.searchsorted(total, mark)
