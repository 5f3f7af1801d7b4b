"""The two 5x5x5, stride-2 convolutions of the auto-encoder, as matrix products on CPU.

`downsample` halves a grid and `upsample` doubles it; each is the adjoint of the other, which
suffices to differentiate both. XLA's CPU backend runs the same operations up to 300 times slower
than the hardware allows, so there they are written as matrix products, a few examples at a time so
that temporaries stay in cache:

- Grids of 8 or more coarse voxels a side go through fast convolution (`tiles`). That is
  linear in the grid and in the kernel, so its transposes are the other direction and the gradient.
- Smaller grids, where transforming the kernel costs more than it saves, gather neighbours.
- The last layer, with a single fine channel, multiplies first and then shifts the products.

Every other backend uses XLA's own convolutions.

Grids are channels-last, `[b, x, y, z, channels]`; kernels are `[5, 5, 5, fine, coarse]` for both
directions, where `fine` counts the channels of the larger grid. Coarse voxel `i` touches the fine
voxels `2 i + k - 2`, for taps `k` in 0..4 along each axis.
"""

import itertools
from collections.abc import Callable
from functools import reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxshape.model.chunks import in_chunks, sum_chunks
from jaxshape.model.tiles import (
    TILE,
    adjoint,
    downsample_tiles,
    gradient_of_tiles,
    transform_kernel,
    upsample_tiles,
)
from jaxshape.process import processor

KERNEL_SIZE = 5
CACHE_BYTES = 2 * 2**20
"""Limit of the temporaries on CPU: the fastest for a training step among 0.5 to 8 MiB."""

# Fine voxel 2 i + phase takes, from the coarse voxel i + shift, this tap of the kernel:
TAPS = {-1: {0: 4}, 0: {0: 2, 1: 3}, 1: {0: 0, 1: 1}}
PHASES = (0, 1)


@jax.custom_vjp
def downsample(
    fine: Float[Array, "b x y z fine"], kernel: Float[Array, "5 5 5 fine coarse"]
) -> Float[Array, "b x//2 y//2 z//2 coarse"]:
    """Convolve with stride 2 and padding 2."""
    return lax.platform_dependent(fine, kernel, cpu=_downsample_cpu, default=_downsample_xla)


@jax.custom_vjp
def upsample(
    coarse: Float[Array, "b x y z coarse"], kernel: Float[Array, "5 5 5 fine coarse"]
) -> Float[Array, "b 2*x 2*y 2*z fine"]:
    """Convolve transposed with stride 2, padding 2 and output padding 1."""
    return lax.platform_dependent(coarse, kernel, cpu=_upsample_cpu, default=_upsample_xla)


class PreparedKernel(NamedTuple):
    """A kernel for many calls of `upsample_prepared`, which share the work done here.

    Attributes:
        kernel: The kernel itself.
        tiles: The transformed kernel; None where fast convolution does not pay.
    """

    kernel: Float[Array, "5 5 5 fine coarse"]
    tiles: Float[Array, "36 taps phases"] | None


def prepare_kernel(kernel: Float[Array, "5 5 5 fine coarse"], side: int) -> PreparedKernel:
    """Make a kernel ready for coarse grids of `side` voxels along each axis."""
    tiled = tiles_pay(kernel.dtype) and kernel.shape[-2] > 1 and side >= TILE
    return PreparedKernel(kernel, transform_kernel(kernel) if tiled else None)


def tiles_pay(dtype: Any) -> bool:
    """Whether fast convolution of tiles, which computes in float32, is faster for this type.

    On hardware with bfloat16 matrix units, products of gathered neighbours in bfloat16 are faster;
    elsewhere they take twice as long.
    """
    return dtype == jnp.float32 or not multiplies_bfloat16()


def multiplies_bfloat16() -> bool:
    """Whether the processor has matrix units for bfloat16 (AMX)."""
    return "amx_bf16" in processor().features


def upsample_prepared(
    coarse: Float[Array, "b x y z coarse"], prepared: PreparedKernel
) -> Float[Array, "b 2*x 2*y 2*z fine"]:
    """`upsample` with a prepared kernel; differentiable in the grid."""
    kernel, tiles = prepared
    in_its_precision = lambda coarse: upsample(coarse.astype(kernel.dtype), kernel)  # noqa: E731
    if tiles is None:
        return in_its_precision(coarse)
    return lax.platform_dependent(
        coarse,
        tiles,
        cpu=upsample_tiles,
        default=lambda coarse, tiles: in_its_precision(coarse).astype(jnp.float32),
    )


def _kernel_gradient(fine, coarse, kernel_like):
    """Gradient, in the kernel, of the inner product of `downsample(fine, kernel)` with `coarse`."""
    gradient = lax.platform_dependent(
        fine, coarse, cpu=_kernel_gradient_cpu, default=_kernel_gradient_xla
    )
    return gradient.astype(kernel_like.dtype)


downsample.defvjp(
    lambda fine, kernel: (downsample(fine, kernel), (fine, kernel)),
    lambda saved, ct: (upsample(ct, saved[1]), _kernel_gradient(saved[0], ct, saved[1])),
)
upsample.defvjp(
    lambda coarse, kernel: (upsample(coarse, kernel), (coarse, kernel)),
    lambda saved, ct: (downsample(ct, saved[1]), _kernel_gradient(ct, saved[0], saved[1])),
)


# ------------------------------------------------------------------ XLA's own convolutions

_LAYOUT = ("NXYZC", "XYZIO", "NXYZC")


def _downsample_xla(fine, kernel):
    return lax.conv_general_dilated(
        fine, kernel, (2, 2, 2), [(2, 2)] * 3, dimension_numbers=_LAYOUT
    )


def _upsample_xla(coarse, kernel):
    flipped = jnp.flip(kernel, (0, 1, 2)).swapaxes(-1, -2)
    return lax.conv_general_dilated(
        coarse, flipped, (1, 1, 1), [(2, 3)] * 3, lhs_dilation=(2, 2, 2), dimension_numbers=_LAYOUT
    )


def _kernel_gradient_xla(fine, coarse):
    kernel = jnp.zeros((*[KERNEL_SIZE] * 3, fine.shape[-1], coarse.shape[-1]), fine.dtype)
    (gradient,) = jax.linear_transpose(lambda kernel: _downsample_xla(fine, kernel), kernel)(coarse)
    return gradient.astype(jnp.float32)


# ------------------------------------------------------------------ products, for CPU


def _upsample_cpu(coarse, kernel):
    if kernel.shape[-2] == 1:
        form = lambda coarse: _multiply_then_shift(coarse, kernel)  # noqa: E731
        return in_chunks(form, _in_cache(KERNEL_SIZE**3 * coarse[0, ..., 0].size), coarse)
    if _tiled(coarse.shape, kernel.shape):
        matrices = transform_kernel(kernel)
        form = lambda x: upsample_tiles(x, matrices).astype(x.dtype)  # noqa: E731
    else:
        form = _gather_then_multiply(kernel)
    return in_chunks(form, _in_cache(9 * coarse[0].size), coarse)


def _downsample_cpu(fine, kernel):
    if _tiled([n // 2 for n in fine.shape], kernel.shape):
        matrices = transform_kernel(kernel)
        form = lambda x: downsample_tiles(x, matrices).astype(x.dtype)  # noqa: E731
    else:
        form = lambda x: _gather_taps_then_multiply(x, kernel)  # noqa: E731
    return in_chunks(form, _in_cache(25 * fine[0].size // 4), fine)


def _kernel_gradient_cpu(fine, coarse):
    shape = (*[KERNEL_SIZE] * 3, fine.shape[-1], coarse.shape[-1])
    size = _in_cache(25 * fine[0].size // 4)
    if not _tiled(coarse.shape, shape):
        return sum_chunks(_gradient_of_taps, size, fine, coarse).reshape(shape)
    total = sum_chunks(gradient_of_tiles, size, fine, coarse)
    return adjoint(transform_kernel, shape, total)


def _tiled(coarse_shape, kernel_shape) -> bool:
    """Whether there are enough tiles for the transform of the kernel to pay off."""
    return kernel_shape[-2] > 1 and min(coarse_shape[1:3]) >= 2 * TILE


def _in_cache(values: int) -> int:
    """Number of examples whose gathered values fit into the cache together."""
    return max(1, CACHE_BYTES // (4 * values))


def matmul(a, b):
    """Products of bfloat16 accumulate in float32, which is also faster on CPU than in bfloat16."""
    return jnp.matmul(a, b, preferred_element_type=jnp.float32)


def _gather_taps_then_multiply(fine, kernel):
    """Gather the taps along y and z, then add up one product per tap along x."""
    matrices = kernel.reshape(KERNEL_SIZE, -1, kernel.shape[-1])
    return reduce(jnp.add, map(matmul, _gather_taps(fine), matrices)).astype(fine.dtype)


def _gradient_of_taps(fine, coarse):
    """Products of the gathered taps with the coarse side, summed over examples."""
    columns = coarse.reshape(-1, coarse.shape[-1])
    planes = _gather_taps(fine)
    return jnp.stack([matmul(plane.reshape(columns.shape[0], -1).T, columns) for plane in planes])


def _gather_taps(
    fine: Float[Array, "b x y z fine"],
) -> list[Float[Array, "b x//2 y//2 z//2 25*fine"]]:
    """For each tap along x, the fine neighbours of every coarse voxel along y and z."""
    taps = range(KERNEL_SIZE)
    _, nx, ny, nz, _ = fine.shape
    fine = jnp.pad(fine, [(0, 0), (2, 1), (2, 1), (2, 1), (0, 0)])
    fine = jnp.concatenate([fine[:, :, :, k : k + nz : 2] for k in taps], axis=-1)
    fine = jnp.concatenate([fine[:, :, k : k + ny : 2] for k in taps], axis=-1)
    return [fine[:, k : k + nx : 2] for k in taps]


def _gather_then_multiply(kernel) -> Callable[[Array], Array]:
    """Gather shifts along z; multiply once per shift along x and y, for the phases it feeds."""
    fine, coarse = kernel.shape[-2:]
    shifts = list(itertools.product(TAPS, repeat=2))
    matrices = [
        jnp.concatenate([_z_matrix(kernel[taps]) for taps in _taps(shift).values()], axis=-1)
        for shift in shifts
    ]

    def convolve(x):
        b, nx, ny, nz, _ = x.shape
        x = jnp.pad(x, [(0, 0), (1, 1), (1, 1), (1, 1), (0, 0)])
        x = jnp.concatenate([x[:, :, :, 1 + d : 1 + d + nz] for d in TAPS], axis=-1)
        phases: dict[tuple, Any] = dict.fromkeys(itertools.product(PHASES, repeat=2), 0.0)
        for (dx, dy), matrix in zip(shifts, matrices, strict=True):
            product = matmul(x[:, 1 + dx : 1 + dx + nx, 1 + dy : 1 + dy + ny], matrix)
            for i, phase in enumerate(_taps((dx, dy))):
                phases[phase] += product[..., 2 * fine * i : 2 * fine * (i + 1)]
        return _interleave(jnp.stack(list(phases.values()), axis=4), fine).astype(kernel.dtype)

    return convolve


def _z_matrix(kernel: Float[Array, "5 fine coarse"]) -> Float[Array, "3*coarse 2*fine"]:
    """The matrix from the three gathered shifts along z to the two phases along z."""
    zero = jnp.zeros_like(kernel[0])
    blocks = [[kernel[TAPS[d][p]] if p in TAPS[d] else zero for p in PHASES] for d in TAPS]
    return jnp.concatenate([jnp.concatenate(row, axis=0).T for row in blocks], axis=0)


def _multiply_then_shift(
    coarse: Float[Array, "b x y z coarse"], kernel: Float[Array, "5 5 5 1 coarse"]
) -> Float[Array, "b 2*x 2*y 2*z 1"]:
    """Multiply once with all 125 taps, then shift one axis at a time, which moves few values.

    Voxels come last in the product, so that shifting them is cheap.
    """
    b, nx, ny, nz, _ = coarse.shape
    taps = kernel.reshape(KERNEL_SIZE**3, -1)
    product = jnp.einsum("kc,bxyzc->kbxyz", taps, coarse, preferred_element_type=jnp.float32)
    product = product.reshape(*[KERNEL_SIZE] * 3, b, nx, ny, nz)
    for axis in (4, 5, 6):  # the leading axis of taps becomes a third, fourth or fifth of phases
        product = jnp.moveaxis(_phases(product, axis), 0, 2)
    # [px, py, pz, b, x, y, z] to [b, (x, px), (y, py), (z, pz), 1].
    fine = product.transpose(3, 4, 0, 5, 1, 6, 2).reshape(b, 2 * nx, 2 * ny, 2 * nz, 1)
    return fine.astype(coarse.dtype)


def _phases(product: Float[Array, "5 ..."], axis: int) -> Float[Array, "2 ..."]:
    """Add the five taps of one axis to its two phases, each tap from its coarse neighbour."""
    n = product.shape[axis]
    pads = [(1, 1) if i == axis else (0, 0) for i in range(1, product.ndim)]

    def neighbour(tap, shift):
        return lax.slice_in_dim(
            jnp.pad(product[tap], pads), 1 + shift, 1 + shift + n, axis=axis - 1
        )

    sums = [[neighbour(TAPS[d][p], d) for d in TAPS if p in TAPS[d]] for p in PHASES]
    return jnp.stack([reduce(jnp.add, terms) for terms in sums])


def _taps(shift: tuple[int, ...]) -> dict[tuple[int, ...], tuple[int, ...]]:
    """For a coarse voxel at `shift`, the phases it feeds and the kernel tap of each."""
    phases = itertools.product(*[TAPS[d] for d in shift])
    return {p: tuple(TAPS[d][a] for d, a in zip(shift, p, strict=True)) for p in phases}


def _interleave(
    phases: Float[Array, "b x y z _ _"], fine: int
) -> Float[Array, "b 2*x 2*y 2*z {fine}"]:
    """Arrange the eight phases of each coarse voxel, ordered by axis, in the fine grid."""
    b, nx, ny, nz = phases.shape[:4]
    phases = phases.reshape(b, nx, ny, nz, 2, 2, 2, fine)
    return phases.transpose(0, 1, 4, 2, 5, 3, 6, 7).reshape(b, 2 * nx, 2 * ny, 2 * nz, fine)
