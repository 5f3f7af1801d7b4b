"""Visibility of voxels from cameras, for many plausible shapes at once.

Shapes are stored as bits: bit s of a voxel's number is set where shape s is occupied, so that one
look-up serves all shapes. A ray goes from each queried voxel to the camera, one voxel at a time
along its longest axis; an occupied voxel on the way hides the queried one.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, UInt32

from jaxshape.geometry.grid import flat_index

MOST_SHAPES = 32
"""Largest number of shapes, one for each bit of a number."""


def pack(occupied: Bool[Array, "sample x y z"]) -> UInt32[Array, " voxel"]:
    """The shapes that are occupied in each voxel, as bits.

    Args:
        occupied: Up to 32 shapes `[sample x y z]`.

    Returns:
        One number for each voxel of the raveled grid, and one that is 0 for all that lies outside.
    """
    rows = occupied.reshape(len(occupied), -1).astype(jnp.uint32)
    bits = jnp.left_shift(jnp.uint32(1), jnp.arange(len(rows), dtype=jnp.uint32))
    return jnp.append(jnp.sum(rows * bits[:, None], axis=0, dtype=jnp.uint32), jnp.uint32(0))


def hidden(
    packed: UInt32[Array, " voxel"],
    resolution: int,
    voxels: Int[Array, "k 3"],
    eyes: Float[Array, "view 3"],
) -> UInt32[Array, "view k"]:
    """The shapes in which each voxel is hidden from each camera, as bits.

    Args:
        packed: The shapes, from `pack`.
        resolution: Voxels along each axis of the grid.
        voxels: Indices of the queried voxels `[k 3]`.
        eyes: Positions of the cameras in voxel coordinates `[view 3]`, outside the grid.
    """
    center = voxels + 0.5
    way = [eyes[:, None, axis] - center[:, axis] for axis in range(3)]
    longest = jnp.maximum(jnp.maximum(*map(jnp.abs, way[:2])), jnp.abs(way[2]))
    step = [length / longest for length in way]

    def onwards(i, found):
        at = (center[:, axis] + i * step[axis] for axis in range(3))
        return found | packed.at[flat_index(at, resolution)].get(mode="promise_in_bounds")

    nothing = jnp.zeros((len(eyes), len(voxels)), jnp.uint32)
    return lax.fori_loop(1, resolution, onwards, nothing)


def share(bits: UInt32[Array, "*n"], count: int) -> Float[Array, "*n"]:
    """The share of the shapes whose bits are set.

    Args:
        bits: Bits of the shapes.
        count: Number of shapes.
    """
    return lax.population_count(bits).astype(jnp.float32) / count


def unpacked(bits: UInt32[Array, "*n"], count: int) -> Bool[Array, "sample ..."]:
    """The bits of each shape; undoes `pack`."""
    return jax.vmap(lambda s: (bits >> s) & 1 > 0)(jnp.arange(count, dtype=jnp.uint32))
