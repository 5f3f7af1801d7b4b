"""Probability that each voxel of a shape is surface, free or unknown, from fine signed distances.

The numbers below were fitted to procedural chairs with a Kinect's noise, after 1 to 18 frames: to
how often a voxel with a given number of crossings, or share of free space, holds a piece of the
true surface.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxshape.geometry.distance import DistanceField, mean_distance
from jaxshape.geometry.grid import RESOLUTION
from jaxshape.geometry.grids import Grids

OUTVOTED = 0.06
"""A surface counts if its weight is more than this share of the rays that passed through it."""

ALREADY, SCALE = 2.0, 4.3
"""A voxel in which the surface crosses n fine voxels is surface with probability
1 - exp(-(n + 2) / 4.3): for a single fine voxel this is above 1/2."""

SOME, ALL = 0.5, 0.95
"""Shares of free fine voxels above which a voxel may be free, and above which it certainly is."""


class Evidence(NamedTuple):
    """Probabilities of each voxel given the frames; the rest of the probability is unknown.

    Attributes:
        surface: Probability, 0 to 1, that the voxel holds a piece of the measured surface.
        free: Probability, 0 to 1, that the voxel was seen to be free; the sum of both is at most 1.
    """

    surface: Float[Array, "*batch x y z"]
    free: Float[Array, "*batch x y z"]


def evidence(field: DistanceField, resolution: int = RESOLUTION) -> Evidence:
    """Probabilities of the voxels of a shape from a fused field.

    Args:
        field: Signed distances of the fine grid, whose side is a multiple of the resolution.
        resolution: Voxels along each axis of the shape.

    Returns:
        Probabilities of surface and free space.
    """
    trusted, crossed = is_trusted(field), crossings(field)
    ahead = (field.free > 0.5) | (trusted & (field.weighted_distance > 0))
    count, free = _within_margin(_sum(crossed, resolution)), _share(ahead & ~crossed, resolution)
    surface = jnp.where(count > 0, 1 - jnp.exp(-(count + ALREADY) / SCALE), 0)
    return Evidence(surface, (1 - surface) * jnp.clip((free - SOME) / (ALL - SOME), 0, 1))


def is_trusted(field: DistanceField) -> Bool[Array, "*batch x y z"]:
    """Fine voxels whose distance counts: a surface was measured nearby and few rays contradict."""
    return (field.weight > 0) & (field.weight > OUTVOTED * field.free)


def crossings(field: DistanceField) -> Bool[Array, "*batch x y z"]:
    """Fine voxels that the surface crosses: in each pair of different signs, the nearer to it."""
    trusted, distance = is_trusted(field), mean_distance(field)
    crossed = jnp.zeros(distance.shape, bool)
    for axis in (-3, -2, -1):
        size = distance.shape[axis]
        (t0, d0), (t1, d1) = (
            [lax.slice_in_dim(x, i, size - 1 + i, axis=axis) for x in (trusted, distance)]
            for i in (0, 1)
        )
        cross = t0 & t1 & ((d0 > 0) != (d1 > 0))
        first = jnp.abs(d0) <= jnp.abs(d1)
        crossed |= _pad(cross & first, axis, (0, 1)) | _pad(cross & ~first, axis, (1, 0))
    return crossed


def _within_margin(count: Float[Array, "*batch x y z"]) -> Float[Array, "*batch x y z"]:
    """Move crossings in the outermost voxels, outside the box, to the voxels next to them.

    The faces of the box are a hundredth of a voxel inside the next voxels: noise alone can move a
    surface across the border.
    """
    n = count.shape[-1]
    for axis in (-3, -2, -1):
        first, second = (lax.slice_in_dim(count, i, i + 1, axis=axis) for i in (0, 1))
        last, before = (lax.slice_in_dim(count, n - i, n - i + 1, axis=axis) for i in (1, 2))
        inner = lax.slice_in_dim(count, 2, n - 2, axis=axis)
        empty = jnp.zeros_like(first)
        parts = [empty, first + second, inner, before + last, empty]
        count = jnp.concatenate(parts, axis=axis)
    return count


def as_grids(evidence: Evidence) -> Grids:
    """F, the probability of surface in a known voxel, and M, the probability of being unknown."""
    known = evidence.surface + evidence.free
    return Grids(evidence.surface / jnp.where(known > 0, known, 1), 1 - known)


def from_grids(grids: Grids) -> Evidence:
    """Probabilities of surface and free space from F and M, binary or soft: inverts `as_grids`."""
    F, M = (jnp.asarray(x).astype(jnp.float32) for x in (grids.occupied, grids.occluded))
    return Evidence(F * (1 - M), (1 - F) * (1 - M))


def soft_grids(field: DistanceField, resolution: int = RESOLUTION) -> Grids:
    """F and M as probabilities, from fused signed distances.

    Args:
        field: Signed distances `[*batch n n n]` of a fine grid whose side n is a multiple of the
            resolution.
        resolution: Voxels along each axis of the grids.

    Returns:
        Soft grids; after rounding (`binary`) they are the measurement grid and the occlusion mask.
    """
    return as_grids(evidence(field, resolution))


def _pad(x: Bool[Array, "*batch x y z"], axis: int, width: tuple[int, int]) -> Array:
    widths = [(0, 0)] * x.ndim
    widths[axis] = width
    return jnp.pad(x, widths)


def _sum(x: Array, resolution: int) -> Array:
    """Sums over the fine voxels of each voxel."""
    *batch, n, _, _ = x.shape
    k = n // resolution
    blocks = x.reshape(*batch, *[resolution, k] * 3)
    return jnp.sum(blocks, axis=(-5, -3, -1), dtype=jnp.float32)


def _share(x: Array, resolution: int) -> Array:
    return _sum(x, resolution) / (x.shape[-1] // resolution) ** 3
