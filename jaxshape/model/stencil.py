"""A 3x3x3 convolution that keeps the grid's size, as matrix products on CPU.

XLA's CPU backend runs three-dimensional convolutions far below what the hardware allows. Here they
are matrix products, a few examples at a time so that temporaries stay in cache:

- Grids of 4 or more voxels a side go through fast convolution (`tiles`), two to four times as fast.
- Smaller grids, and bfloat16 on hardware with matrix units for it, gather the neighbours along z;
  the nine shifts along x and y are nine products that add up.

Every other backend uses XLA's own convolutions.

Grids are channels-last, `[b, x, y, z, channels]`; kernels are `[3, 3, 3, in, out]`.
"""

from functools import reduce

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxshape.model.chunks import in_chunks, sum_chunks
from jaxshape.model.convolution import matmul, tiles_pay
from jaxshape.model.tiles import (
    POINTS,
    TILE,
    adjoint,
    convolve_tiles,
    gradient_of_stencil,
    transform_stencil,
)

SIZE = 3
CACHE_BYTES = 2**19
"""Approximate size of the gathered neighbours on CPU: the fastest for most layers among 1/2 to 4
MiB."""
TILE_BYTES, GRADIENT_BYTES = 2**21, 2**23
"""The same for the evaluated tiles, of the convolution and of the gradient of its kernel: the
fastest among 1 to 8 examples of the shipped network."""


@jax.custom_vjp
def convolve(
    grid: Float[Array, "b x y z in"], kernel: Float[Array, "3 3 3 in out"]
) -> Float[Array, "b x y z out"]:
    """Convolve with stride 1 and padding 1, in the type of the grid."""
    return lax.platform_dependent(grid, kernel, cpu=_products, default=_xla)


def _kernel_gradient(grid, kernel, cotangent):
    by_products = lambda grid, cotangent: _gradient_products(grid, cotangent, kernel.shape)  # noqa: E731
    by_xla = lambda grid, cotangent: _gradient_xla(grid, cotangent, kernel)  # noqa: E731
    gradient = lax.platform_dependent(grid, cotangent, cpu=by_products, default=by_xla)
    return gradient.astype(kernel.dtype)


def _backward(saved, cotangent):
    grid, kernel = saved
    cotangent = cotangent.astype(grid.dtype)
    transposed = jnp.flip(kernel, (0, 1, 2)).swapaxes(-1, -2)
    return convolve(cotangent, transposed), _kernel_gradient(grid, kernel, cotangent)


convolve.defvjp(lambda grid, kernel: (convolve(grid, kernel), (grid, kernel)), _backward)


def _xla(grid, kernel):
    layout = ("NXYZC", "XYZIO", "NXYZC")
    return lax.conv_general_dilated(grid, kernel, (1, 1, 1), "SAME", dimension_numbers=layout)


def _gradient_xla(grid, cotangent, kernel):
    (gradient,) = jax.linear_transpose(lambda kernel: _xla(grid, kernel), kernel)(cotangent)
    return gradient.astype(jnp.float32)


def _products(grid, kernel):
    if _tiled(grid):
        matrices = transform_stencil(kernel)
        by_tiles = lambda x: convolve_tiles(x, matrices).astype(x.dtype)  # noqa: E731
        # Without the barrier XLA computes what leads to the grid again for each of the 36 points.
        grid = lax.optimization_barrier(grid)
        return in_chunks(by_tiles, _tiles_in_cache(grid, TILE_BYTES), grid)
    matrices = kernel.reshape(SIZE**2, -1, kernel.shape[-1])

    def of_some(grid):
        products = map(matmul, _shifts(grid), matrices)
        return reduce(jnp.add, products).astype(grid.dtype)

    return in_chunks(of_some, _in_cache(grid), grid)


def _gradient_products(grid, cotangent, shape):
    if _tiled(grid):
        size = _tiles_in_cache(grid, GRADIENT_BYTES)
        total = sum_chunks(gradient_of_stencil, size, grid, cotangent)
        return adjoint(transform_stencil, shape, total)

    def of_some(grid, cotangent):
        rows = _transposed(cotangent)
        columns = (shift.reshape(rows.shape[1], -1) for shift in _shifts(grid))
        return jnp.stack([matmul(rows, x) for x in columns])

    total = sum_chunks(of_some, _in_cache(grid), grid, cotangent)
    return total.swapaxes(-1, -2).reshape(shape)


def _tiled(grid) -> bool:
    """Whether fast convolution pays off."""
    return tiles_pay(grid.dtype) and min(grid.shape[1:3]) >= TILE


def _tiles_in_cache(grid, size: int) -> int:
    """Number of examples whose evaluated tiles take `size` bytes together."""
    _, nx, ny, nz, channels = grid.shape
    tiles = -(-nx // TILE) * -(-ny // TILE)
    return max(1, size // (4 * POINTS**2 * tiles * nz * SIZE * channels))


def _shifts(grid: Float[Array, "b x y z c"]) -> list[Float[Array, "b x y z 3*c"]]:
    """For each shift along x and y, the three neighbours along z of every voxel."""
    _, nx, ny, nz, _ = grid.shape
    padded = jnp.pad(grid, [(0, 0), (1, 1), (1, 1), (1, 1), (0, 0)])
    along_z = jnp.concatenate([padded[:, :, :, k : k + nz] for k in range(SIZE)], axis=-1)
    return [along_z[:, i : i + nx, j : j + ny] for i in range(SIZE) for j in range(SIZE)]


def _in_cache(grid) -> int:
    """Number of examples whose shifts fit into the cache together."""
    return max(1, CACHE_BYTES // (SIZE**2 * grid[0].size * grid.dtype.itemsize))


def _transposed(x: Float[Array, "*batch c"]) -> Float[Array, "c n"]:
    """The transpose as a copy: XLA's products of a transposed view are 3 times slower."""
    return jnp.moveaxis(x, -1, 0).reshape(x.shape[-1], -1)


@jax.custom_vjp
def multiply(
    x: Float[Array, "*batch in"], matrix: Float[Array, "in out"]
) -> Float[Array, "*batch out"]:
    """The same product for every voxel, in the type of the grid."""
    return matmul(x, matrix).astype(x.dtype)


def _multiply_backward(saved, cotangent):
    x, matrix = saved
    by_matrix = matmul(_transposed(x), cotangent.reshape(-1, cotangent.shape[-1]))
    return multiply(cotangent, _transposed(matrix)), by_matrix.astype(matrix.dtype)


multiply.defvjp(lambda x, matrix: (multiply(x, matrix), (x, matrix)), _multiply_backward)
