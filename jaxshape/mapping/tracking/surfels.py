"""The surface of the map as small oriented patches, one for each cell of a grid.

Patches from two sources have the same form. Measured patches are averages of the points that
keyframes measured in each cell, exact to a fraction of a millimetre; predicted patches lie in the
middle of the decoded shell, exact to a fraction of a voxel. Their standard deviations express this,
and give the weights of points that are aligned with the surface.
"""

from itertools import product
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxshape.geometry.grid import flat_index, voxel_centers
from jaxshape.mapping.tracking.icp import AGREEING, Match, Matches

CELLS = 64
"""Cells along each axis: some 1.5 cm on a chair."""

FLAT = 0.8
"""Least length of a cell's mean normal: if it is shorter, several faces share the cell."""

PREDICTED_DEVIATION = 0.35
"""Standard deviation of the predicted surface, in voxels of the decoded grid."""

_MEASURED_DEVIATION = 0.05  # in cells: deviation of the surface in a cell from a plane
_REACH = 3  # cells within which points find a patch
_PATCHES_BY_FACE = 4  # most patches of a predicted surface, per voxel of one face of the grid


class Lattice(NamedTuple):
    """Where the cells lie: `cell = world @ linear.T + offset`.

    Attributes:
        linear: Linear part `[3 3]`, in cells per metre.
        offset: Cell coordinates of the world origin `[3]`.
    """

    linear: Float[Array, "3 3"]
    offset: Float[Array, " 3"]


class Surface(NamedTuple):
    """Oriented patches in the world frame, at most one for each cell.

    Attributes:
        lattice: Where the cells lie.
        points: A point of each patch, in metres.
        normals: Unit normal of each patch.
        deviation: Standard deviation along the normal, in metres; infinite where the cell has no
            patch.
        two_sided: True where nothing tells which side is outside, as in predicted patches.
        nearest: For each cell, the cell of a patch near to it; `c` where there is none in reach.
    """

    lattice: Lattice
    points: Float[Array, "c 3"]
    normals: Float[Array, "c 3"]
    deviation: Float[Array, " c"]
    two_sided: Bool[Array, " c"]
    nearest: Int[Array, " c"]


def cell_of(lattice: Lattice, points: Float[Array, "*n 3"]) -> Int[Array, "*n"]:
    """Index of the cell that holds each world point; `CELLS**3` outside the grid."""
    cell = points @ lattice.linear.T + lattice.offset
    return flat_index(jnp.moveaxis(cell, -1, 0), CELLS)


def cell_size(lattice: Lattice) -> Float[Array, ""]:
    """Mean edge length of a cell, in metres."""
    return jnp.abs(jnp.linalg.det(lattice.linear)) ** (-1 / 3)


class Sums(NamedTuple):
    """Sums of measured points in each cell; two of them can be added.

    Attributes:
        weight: Sum of inverse variances, per square metre.
        point: Weighted sum of positions, from the centre of the cell.
        normal: Weighted sum of normals.
    """

    weight: Float[Array, " c"]
    point: Float[Array, "c 3"]
    normal: Float[Array, "c 3"]


def no_sums() -> Sums:
    """The sums of no points."""
    return Sums(jnp.zeros(CELLS**3), jnp.zeros((CELLS**3, 3)), jnp.zeros((CELLS**3, 3)))


def add_up(
    lattice: Lattice,
    points: Float[Array, "n 3"],
    normals: Float[Array, "n 3"],
    deviation: Float[Array, " n"],
) -> Sums:
    """Sum world points over cells; missing points have infinite standard deviation."""
    index = jnp.where(jnp.isfinite(deviation), cell_of(lattice, points), CELLS**3)
    weight = 1 / deviation**2
    # Relative to the centres: sums of world coordinates would lose the millimetres.
    offset = points - cell_centers(lattice, index)
    values = weight[:, None] * jnp.concatenate([jnp.ones_like(points[:, :1]), offset, normals], 1)
    values = jnp.where(jnp.isfinite(deviation)[:, None], values, 0)
    sums = jnp.zeros((CELLS**3, 7)).at[index].add(values, mode="drop")
    return Sums(sums[:, 0], sums[:, 1:4], sums[:, 4:])


def cell_centers(lattice: Lattice, index: Int[Array, "*n"]) -> Float[Array, "*n 3"]:
    """World positions of the centres of cells."""
    cell = jnp.stack([index // CELLS**2, index // CELLS % CELLS, index % CELLS], axis=-1)
    return (cell + 0.5 - lattice.offset) @ jnp.linalg.inv(lattice.linear).T


def measured_surface(lattice: Lattice, sums: Sums) -> Surface:
    """The patches that measured points average to."""
    has_points = sums.weight > 0
    weight = jnp.where(has_points, sums.weight, 1)[:, None]
    mean_normal = sums.normal / weight
    length = jnp.linalg.norm(mean_normal, axis=-1)
    is_patch = has_points & (length > FLAT)
    floor = _MEASURED_DEVIATION * cell_size(lattice)
    deviation = jnp.sqrt(1 / weight[:, 0] + floor**2)
    return Surface(
        lattice=lattice,
        points=cell_centers(lattice, jnp.arange(CELLS**3)) + sums.point / weight,
        normals=mean_normal / jnp.maximum(length, 1e-6)[:, None],
        deviation=jnp.where(is_patch, deviation, jnp.inf),
        two_sided=jnp.zeros(CELLS**3, bool),
        nearest=_nearest(is_patch),
    )


def predicted_surface(lattice: Lattice, completed: Float[Array, "x y z"]) -> Surface:
    """The middle of a shell of probabilities on the voxel grid.

    A patch lies at the mean of the probable voxels around a probable voxel; its normal is the axis
    along which they spread least. Where they spread alike in all directions, as at the end of a
    leg, there is no patch.
    """
    solid = jnp.where(completed > 0.5, completed, 0)
    mean, spread = _neighbourhoods(solid)
    n, none = completed.shape[-1], completed.size
    index = jnp.nonzero((solid > 0).ravel(), size=_PATCHES_BY_FACE * n**2, fill_value=none)[0]
    found = index < none
    mean, spread = mean[index % none], spread[index % none]
    to_world = jnp.linalg.inv(lattice.linear) * CELLS / n  # of voxel vectors
    eigenvalues, axes = jnp.linalg.eigh(to_world @ spread @ to_world.T)
    is_flat = eigenvalues[:, 0] < 0.5 * eigenvalues[:, 1]
    points = (mean - lattice.offset * n / CELLS) @ to_world.T
    cell = jnp.where(found & is_flat, cell_of(lattice, points), CELLS**3)
    voxel_size = cell_size(lattice) * CELLS / n

    def scatter(values, empty):
        full = jnp.full((CELLS**3, *values.shape[1:]), empty, values.dtype)
        return full.at[cell].set(values, mode="drop")

    deviation = scatter(jnp.full(len(cell), PREDICTED_DEVIATION * voxel_size), jnp.inf)
    return Surface(
        lattice=lattice,
        points=scatter(points, 0.0),
        normals=scatter(axes[..., 0], 0.0),
        deviation=deviation,
        two_sided=jnp.ones(CELLS**3, bool),
        nearest=_nearest(jnp.isfinite(deviation)),
    )


def composed_surface(measured: Surface, predicted: Surface) -> Surface:
    """Measured patches where there are any, predicted ones elsewhere."""
    is_measured = jnp.isfinite(measured.deviation)

    def choose(x, y):
        return jnp.where(is_measured.reshape(-1, *[1] * (x.ndim - 1)), x, y)

    chosen = [choose(x, y) for x, y in zip(measured[1:5], predicted[1:5], strict=True)]
    patches = is_measured | jnp.isfinite(predicted.deviation)
    return Surface(measured.lattice, *chosen, nearest=_nearest(patches))


def match_surface(surface: Surface) -> Match:
    """Match world points with the patch near to their cell."""
    two_sided = surface.two_sided[:, None].astype(jnp.float32)
    patches = jnp.concatenate(
        [surface.points, surface.normals, surface.deviation[:, None], two_sided], axis=1
    )

    def match(points, normals, distance):
        cell = cell_of(surface.lattice, points)
        index = surface.nearest.at[cell].get(mode="fill", fill_value=CELLS**3)
        found = patches.at[index].get(mode="fill", fill_value=0.0)
        q, n, deviation = found[:, :3], found[:, 3:6], found[:, 6]
        cosine = jnp.sum(n * normals, axis=-1)
        agreement = jnp.where(found[:, 7] > 0, jnp.abs(cosine), cosine)
        near = jnp.sum((points - q) ** 2, axis=-1) < distance**2
        fits = (index < CELLS**3) & near & (agreement > AGREEING)
        # Points without a patch may be new surface, so no point is expected to have a match.
        return Matches(q, n, jnp.where(fits, deviation, jnp.inf), jnp.zeros_like(fits))

    return match


def _neighbourhoods(
    solid: Float[Array, "x y z"],
) -> tuple[Float[Array, "c 3"], Float[Array, "c 3 3"]]:
    """Mean position and spread, in voxels, of the solid among the 3^3 voxels around each voxel."""
    n, steps = len(solid), list(product((-1, 0, 1), repeat=3))
    padded, offsets = jnp.pad(solid, 1), jnp.array(steps, jnp.float32)
    around = jnp.stack(
        [padded[1 + i : 1 + i + n, 1 + j : 1 + j + n, 1 + k : 1 + k + n] for i, j, k in steps],
        axis=-1,
    ).reshape(-1, 27)
    weight = around / jnp.maximum(around.sum(axis=1, keepdims=True), 1e-6)
    shift = weight @ offsets
    spread = jnp.einsum("cn,ni,nj->cij", weight, offsets, offsets)
    spread = spread - shift[:, :, None] * shift[:, None, :]
    return voxel_centers(n) + shift, spread


def _nearest(is_patch: Bool[Array, " c"]) -> Int[Array, " c"]:
    """For each cell the index of a patch at most `_REACH` cells away, nearest first."""
    none = CELLS**3
    index = jnp.where(is_patch, jnp.arange(none), none).reshape((CELLS,) * 3)

    def grow(_, index):
        for axis in range(3):
            for shift in (1, -1):
                neighbour = jnp.roll(index, shift, axis)
                edge = 0 if shift == 1 else CELLS - 1
                neighbour = lax.dynamic_update_index_in_dim(
                    neighbour, jnp.full_like(neighbour.take(0, axis), none), edge, axis
                )
                index = jnp.where(index == none, neighbour, index)
        return index

    return lax.fori_loop(0, _REACH, grow, index).ravel()
