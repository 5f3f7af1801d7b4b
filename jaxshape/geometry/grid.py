"""Voxel frames: where a grid of occupancy lies in the object frame.

Grids are indexed `[x, y, z]`. In voxel coordinates, voxel `i` covers `[i, i + 1)` along each
axis and its centre is at `i + 0.5`.
"""

from collections.abc import Iterable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

RESOLUTION = 32
"""Voxels along each axis of every grid (paper, section 2.2)."""

MARGIN = 1.01
"""Voxels left free on each side of the object: room for noise, and for a closed surface. It is not
a whole number, since rounding would then decide into which voxels the faces of the bounding box
fall."""


class GridFrame(NamedTuple):
    """The map from the object frame to voxel coordinates; each axis has its own scale.

    `voxel = (point - origin) / voxel_size`. Leading axes are batch axes.

    Attributes:
        origin: Object-frame position of voxel coordinate (0, 0, 0) `[*batch 3]`, in metres.
        voxel_size: Edge lengths of one voxel `[*batch 3]`, in metres, above 0.
    """

    origin: Float[Array, "*batch 3"]
    voxel_size: Float[Array, "*batch 3"]


def fit_box(
    lower: Float[Array, "*batch 3"],
    upper: Float[Array, "*batch 3"],
    *,
    resolution: int = RESOLUTION,
    margin: float = MARGIN,
) -> GridFrame:
    """Scale each axis separately so that the box fills the grid up to the margin.

    This is the anisotropic scaling and shift of the paper (section 2.3). It is computed once for
    each object, from its CAD model or its given box, and then applied unchanged to every partial
    view.

    Args:
        lower: Corner of the box with the smallest coordinates `[*batch 3]`, in the object frame, in
            metres.
        upper: Corner of the box with the largest coordinates `[*batch 3]`, in the object frame, in
            metres.
        resolution: Voxels along each axis of the grid, more than twice the margin.
        margin: Voxels left free on each side of the box, 0 or more.
    """
    voxel_size = (upper - lower) / (resolution - 2 * margin)
    return GridFrame(lower - margin * voxel_size, voxel_size)


def fit_box_isotropic(
    lower: Float[Array, "*batch 3"],
    upper: Float[Array, "*batch 3"],
    *,
    resolution: int = RESOLUTION,
    margin: float = MARGIN,
) -> GridFrame:
    """One scale for all axes: the longest side fills the grid, and the others are centred.

    The paper uses this scaling on real data (section 3.1), where only the measured points are
    known.

    Args:
        lower: Corner of the box with the smallest coordinates `[*batch 3]`, in the object frame, in
            metres.
        upper: Corner of the box with the largest coordinates `[*batch 3]`, in the object frame, in
            metres.
        resolution: Voxels along each axis of the grid, more than twice the margin.
        margin: Voxels left free on each side of the longest side, 0 or more.
    """
    half_side = jnp.max(upper - lower, axis=-1, keepdims=True) / 2
    centre = (lower + upper) / 2
    return fit_box(centre - half_side, centre + half_side, resolution=resolution, margin=margin)


def voxel_from_object(
    frame: GridFrame, points: Float[Array, "*batch n 3"]
) -> Float[Array, "*batch n 3"]:
    """Transform object-frame points to voxel coordinates.

    Args:
        frame: Voxel frame of the grid.
        points: Points in the object frame `[*batch n 3]`, in metres.
    """
    return (points - frame.origin[..., None, :]) / frame.voxel_size[..., None, :]


def object_from_voxel(
    frame: GridFrame, voxels: Float[Array, "*batch n 3"]
) -> Float[Array, "*batch n 3"]:
    """Transform voxel coordinates to object-frame points, in metres.

    Args:
        frame: Voxel frame of the grid.
        voxels: Points in voxel coordinates `[*batch n 3]`.
    """
    return frame.origin[..., None, :] + voxels * frame.voxel_size[..., None, :]


def flat_index(
    coordinates: Iterable[Float[Array, "..."]], resolution: int = RESOLUTION
) -> Int[Array, "..."]:
    """The voxel that holds each point, as an index into a raveled grid.

    Args:
        coordinates: x, y and z of the points, in voxels: three arrays of one shape, or of shapes
            that broadcast. Separate arrays need only one pass on CPU.
        resolution: Voxels along each axis.

    Returns:
        Indices from 0; `resolution**3` for points that lie outside or are not finite.
    """
    index, inside = jnp.int32(0), jnp.array(True)
    for coordinate in coordinates:
        inside &= (coordinate >= 0) & (coordinate < resolution)  # False for NaN
        index = index * resolution + coordinate.astype(jnp.int32)
    return jnp.where(inside, index, resolution**3)


def voxel_centers(resolution: int = RESOLUTION) -> Float[Array, "n 3"]:
    """The centres of all voxels, in the order of a raveled grid.

    Args:
        resolution: Voxels along each axis.

    Returns:
        Voxel coordinates of the `resolution**3` centres; `object_from_voxel` converts them to
        metres.
    """
    axis = jnp.arange(resolution) + 0.5
    return jnp.stack(jnp.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
