"""Fast convolution of tiles, after Toom, Cook and Winograd.

Along x and y, tiles of 4 voxels and their neighbours are evaluated at 6 points, multiplied there
with the kernel, and interpolated: `A [(G kernel) * (B grid)]` (Lavin and Gray, "Fast algorithms for
convolutional neural networks", 2016, F(4, 3)). Along z, neighbours are gathered: transforming a
third axis costs more traffic than it saves. Two convolutions use it:

- One that keeps the size of the grid, with a 3x3x3 kernel: an axis takes 6 multiplications for 4
  voxels instead of 12.
- One that doubles the size, with a 5x5x5 kernel: both phases of the fine grid share the
  evaluations, so that an axis takes 3 multiplications per coarse voxel instead of 5.

Rounding errors grow tenfold, to 1e-5 of the largest value in float32. It always computes in
float32: bfloat16 would leave at most two correct digits.
"""

from collections.abc import Callable, Sequence
from functools import reduce

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

TILE, POINTS = 4, 6
"""Coarse voxels of a tile, and points of its evaluation: 0, 1, -1, 2, -2 and infinity."""

B = np.array(
    [
        [4, 0, -5, 0, 1, 0],
        [0, -4, -4, 1, 1, 0],
        [0, 4, -4, -1, 1, 0],
        [0, -2, -1, 2, 1, 0],
        [0, 2, -1, -2, 1, 0],
        [0, 4, 0, -5, 0, 1],
    ],
    np.float32,
)
A = np.array(
    [[1, 1, 1, 1, 1, 0], [0, 1, -1, 2, -2, 0], [0, 1, 1, 4, 4, 0], [0, 1, -1, 8, -8, 1]], np.float32
)
G = (
    np.array([[6, 0, 0], [-4, -4, -4], [-4, 4, -4], [1, 2, 4], [1, -2, 4], [0, 0, 24]], np.float32)
    / 24
)

# Fine voxel 2 i + phase takes this tap of the kernel from coarse voxels i - 1, i and i + 1.
NEIGHBOURS = np.zeros((2, 3, 5), np.float32)
NEIGHBOURS[0, [0, 1, 2], [4, 2, 0]] = 1
NEIGHBOURS[1, [1, 2], [3, 1]] = 1
G_PHASES = np.einsum("us,psk->upk", G, NEIGHBOURS)
"""Matrices from the five taps to the kernel's value at each point, by phase and neighbour."""


# ------------------------------------------------------------------ the size is kept


def transform_stencil(
    kernel: Float[Array, "3 3 3 coarse fine"],
) -> Float[Array, "36 3*coarse fine"]:
    """For each pair of points, the matrix from a voxel and its neighbours along z to the voxel."""
    kernel = kernel.astype(jnp.float32)
    along_x = _combine(G, list(kernel), axis=0)  # [u, y, z, c, f]
    matrices = _combine(G, [along_x[:, i] for i in range(3)], axis=1)  # [u, v, z, c, f]
    return matrices.reshape(POINTS**2, -1, kernel.shape[-1])


def convolve_tiles(
    grid: Float[Array, "b x y z c"], matrices: Float[Array, "36 3*c out"]
) -> Float[Array, "b x y z out"]:
    """Convolve with a kernel that `transform_stencil` transformed; float32."""
    b, nx, ny, nz, _ = grid.shape
    y = _products(grid, matrices).transpose(2, 3, 0, 4, 1, 5, 6)
    return y.reshape(b, TILE * y.shape[1], -1, nz, y.shape[-1])[:, :nx, :ny]


def gradient_of_stencil(
    grid: Float[Array, "b x y z c"], out: Float[Array, "b x y z out"]
) -> Float[Array, "36 3*c out"]:
    """Gradient in the transformed kernel: the adjoint of `convolve_tiles` in its matrices."""
    shape = (POINTS**2, 3 * grid.shape[-1], out.shape[-1])
    return adjoint(lambda matrices: convolve_tiles(grid, matrices), shape, out)


# ------------------------------------------------------------------ the size is doubled


def transform_kernel(
    kernel: Float[Array, "5 5 5 fine coarse"],
) -> Float[Array, "36 3*coarse 8*fine"]:
    """For each pair of points, the matrix from a voxel and its neighbours along z to its phases."""
    fine, coarse = kernel.shape[-2:]
    # Along z first, which takes 6/5 of the memory; x and y last, which take 12/5 each.
    along_z = _along(NEIGHBOURS, kernel.astype(jnp.float32), axis=2)  # [r, s, k, l, f, c]
    along_yz = _along(G_PHASES, along_z, axis=3)  # [v, q, r, s, k, f, c]
    matrices = _along(G_PHASES, along_yz, axis=4)  # [u, p, v, q, r, s, f, c]
    matrices = matrices.transpose(0, 2, 5, 7, 1, 3, 4, 6)
    return matrices.reshape(POINTS**2, 3 * coarse, 8 * fine)


def _along(matrix: Float[np.ndarray, "*new 5"], kernel: Array, axis: int) -> Array:
    """A small constant matrix times one axis of a kernel; the new axes come first.

    It is written out as sums, since constant arrays of a program cannot be batched with it.
    """
    taps = [jax.lax.index_in_dim(kernel, i, axis, keepdims=False) for i in range(5)]
    rows = _combine(matrix.reshape(-1, 5), taps, axis=0)
    return rows.reshape(*matrix.shape[:-1], *taps[0].shape)


def upsample_tiles(
    coarse: Float[Array, "b x y z coarse"], matrices: Float[Array, "36 rows columns"]
) -> Float[Array, "b 2*x 2*y 2*z {matrices.shape[-1]//8}"]:
    """Convolve transposed with a kernel that `transform_kernel` transformed; float32."""
    b, nx, ny, nz, _ = coarse.shape
    y = _products(coarse, matrices)
    tx, ty, fine = *y.shape[3:5], y.shape[-1] // 8
    y = y.reshape(*y.shape[:-1], 2, 2, 2 * fine)
    # [i, j, b, tx, ty, z, px, py, (pz, fine)] to [b, (tx, i, px), (ty, j, py), (z, pz), fine].
    y = y.transpose(2, 3, 0, 6, 4, 1, 7, 5, 8)
    return y.reshape(b, 2 * TILE * tx, 2 * TILE * ty, 2 * nz, fine)[:, : 2 * nx, : 2 * ny]


# ------------------------------------------------------------------ what both share


def adjoint(linear: Callable[[Array], Array], shape: tuple[int, ...], out: Array) -> Array:
    """The adjoint of a linear function of an array of this shape, applied to `out`; float32."""
    return jax.linear_transpose(linear, jnp.zeros(shape, jnp.float32))(out.astype(jnp.float32))[0]


def _products(
    grid: Float[Array, "b x y z c"], matrices: Float[Array, "36 3*c columns"]
) -> Float[Array, "4 4 b _ _ z columns"]:
    """Evaluate tiles and their neighbours, multiply at each point, and interpolate."""
    b, nx, ny, nz, channels = grid.shape
    tx, ty = -(-nx // TILE), -(-ny // TILE)
    pads = [(0, 0), (1, TILE * tx + 1 - nx), (1, TILE * ty + 1 - ny), (1, 1), (0, 0)]
    x = jnp.pad(grid.astype(jnp.float32), pads)
    x = _combine(B, [x[:, i : i + TILE * tx : TILE] for i in range(POINTS)], axis=0)
    x = _combine(B, [x[:, :, :, i : i + TILE * ty : TILE] for i in range(POINTS)], axis=1)
    x = jnp.concatenate([x[..., d : d + nz, :] for d in range(3)], axis=-1)
    y = x.reshape(POINTS**2, b * tx * ty * nz, 3 * channels) @ matrices
    y = y.reshape(POINTS, POINTS, b, tx, ty, nz, matrices.shape[-1])
    y = _combine(A, list(y), axis=0)
    return _combine(A, [y[:, v] for v in range(POINTS)], axis=1)


def _combine(matrix: np.ndarray, terms: Sequence[Array], axis: int) -> Array:
    """A small constant matrix times a list of arrays, written out so that it fuses."""
    rows = [[a if c == 1 else c * a for c, a in zip(row, terms, strict=True) if c]
            for row in matrix.tolist()]  # fmt: skip
    nothing = jnp.zeros_like(terms[0])
    return jnp.stack([reduce(jnp.add, row) if row else nothing for row in rows], axis)


def downsample_tiles(
    fine: Float[Array, "b x y z fine"], matrices: Float[Array, "36 rows columns"]
) -> Float[Array, "b x//2 y//2 z//2 {matrices.shape[-2]//3}"]:
    """Convolve with a transformed kernel: the adjoint of `upsample_tiles` in its grid."""
    b, *sizes, _ = fine.shape
    shape = (b, *[n // 2 for n in sizes], matrices.shape[1] // 3)
    return adjoint(lambda coarse: upsample_tiles(coarse, matrices), shape, fine)


def gradient_of_tiles(
    fine: Float[Array, "b x y z fine"], coarse: Float[Array, "b _ _ _ coarse"]
) -> Float[Array, "36 3*coarse 8*fine"]:
    """Gradient in the transformed kernel: the adjoint of `upsample_tiles` in its matrices."""
    shape = (POINTS**2, 3 * coarse.shape[-1], 8 * fine.shape[-1])
    return adjoint(lambda matrices: upsample_tiles(coarse, matrices), shape, fine)
