"""The two 5x5x5, stride-2 convolutions of the auto-encoder, as matrix products on CPU.

`downsample` halves a grid and `upsample` doubles it; each is the adjoint of the other, which is
all that is needed to differentiate them. XLA's CPU backend runs the same operations up to 300
times slower than the hardware allows, so there they are written as products of gathered
neighbourhoods, a few examples at a time so that temporaries stay in cache. Every other backend
uses XLA's own convolutions.

Grids are channels-last, `[b, x, y, z, channels]`; kernels are `[5, 5, 5, fine, coarse]` for both
directions, where `fine` counts the channels of the larger grid. Coarse voxel `i` touches the fine
voxels `2 i + k - 2`, for taps `k` in 0..4 along each axis.
"""

import itertools
from collections.abc import Callable
from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

KERNEL_SIZE = 5
CACHE_BYTES = 2 * 2**20
"""Gathered temporaries on CPU are kept below this; measured best between 1 and 4 MiB."""

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


def _kernel_gradient(fine, coarse, kernel_like):
    """How the inner product of `downsample(fine, kernel)` with `coarse` moves with the kernel."""
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


def _downsample_cpu(fine, kernel):
    """Gather the taps along y and z, then add up one product per tap along x."""
    matrices = kernel.reshape(KERNEL_SIZE, -1, kernel.shape[-1])

    def convolve(fine):
        planes = _gather_taps(fine)
        return reduce(jnp.add, map(jnp.matmul, planes, matrices))

    return _in_chunks(convolve, _examples_in_cache(fine), fine)


def _kernel_gradient_cpu(fine, coarse):
    """The same gathered taps, against the coarse side, summed over examples."""

    def correlate(fine, coarse):
        columns = coarse.reshape(-1, coarse.shape[-1])
        planes = _gather_taps(fine)
        return jnp.stack([plane.reshape(columns.shape[0], -1).T @ columns for plane in planes])

    total = _sum_chunks(correlate, _examples_in_cache(fine), fine, coarse)
    return total.reshape(*[KERNEL_SIZE] * 3, fine.shape[-1], coarse.shape[-1])


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


def _upsample_cpu(coarse, kernel):
    """Sub-pixel form: each phase of the fine grid is a small convolution of the coarse grid.

    With few output channels the products come first and the shifts act on their few columns;
    otherwise the shifts along z are gathered first, which makes the products deeper.
    """
    convolve = _multiply_then_shift if kernel.shape[-2] < 8 else _gather_then_multiply
    return _in_chunks(convolve(kernel), _examples_in_cache(coarse), coarse)


def _gather_then_multiply(kernel) -> Callable[[Array], Array]:
    """Gather shifts along z; per shift along x and y one product, for just the phases it feeds."""
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
            product = x[:, 1 + dx : 1 + dx + nx, 1 + dy : 1 + dy + ny] @ matrix
            for i, phase in enumerate(_taps((dx, dy))):
                phases[phase] += product[..., 2 * fine * i : 2 * fine * (i + 1)]
        return _interleave(jnp.stack(list(phases.values()), axis=4), fine)

    return convolve


def _z_matrix(kernel: Float[Array, "5 fine coarse"]) -> Float[Array, "3*coarse 2*fine"]:
    """From the three gathered shifts along z to the two phases along z."""
    zero = jnp.zeros_like(kernel[0])
    blocks = [[kernel[TAPS[d][p]] if p in TAPS[d] else zero for p in PHASES] for d in TAPS]
    return jnp.concatenate([jnp.concatenate(row, axis=0).T for row in blocks], axis=0)


def _multiply_then_shift(kernel) -> Callable[[Array], Array]:
    """One product with all 125 taps, whose columns are then shifted and added per phase."""
    fine = kernel.shape[-2]
    shifts = list(itertools.product(TAPS, repeat=3))
    columns = [kernel[taps].T for shift in shifts for taps in _taps(shift).values()]
    matrix = jnp.concatenate(columns, axis=-1)

    def convolve(x):
        b, nx, ny, nz, _ = x.shape
        x = jnp.pad(x, [(0, 0), (1, 1), (1, 1), (1, 1), (0, 0)])
        product = (x @ matrix).reshape(*x.shape[:-1], len(columns), fine)
        phases: dict[tuple, Any] = dict.fromkeys(itertools.product(PHASES, repeat=3), 0.0)
        column = itertools.count()
        for dx, dy, dz in shifts:
            shifted = product[:, 1 + dx : 1 + dx + nx, 1 + dy : 1 + dy + ny, 1 + dz : 1 + dz + nz]
            for phase in _taps((dx, dy, dz)):
                phases[phase] += shifted[..., next(column), :]
        return _interleave(jnp.stack(list(phases.values()), axis=4), fine)

    return convolve


def _taps(shift: tuple[int, ...]) -> dict[tuple[int, ...], tuple[int, ...]]:
    """For a coarse voxel at `shift`, the phases it feeds and the kernel tap of each."""
    phases = itertools.product(*[TAPS[d] for d in shift])
    return {p: tuple(TAPS[d][a] for d, a in zip(shift, p, strict=True)) for p in phases}


def _interleave(
    phases: Float[Array, "b x y z _ _"], fine: int
) -> Float[Array, "b 2*x 2*y 2*z {fine}"]:
    """Eight phases per coarse voxel, in the order of their axes, to the fine grid."""
    b, nx, ny, nz = phases.shape[:4]
    phases = phases.reshape(b, nx, ny, nz, 2, 2, 2, fine)
    return phases.transpose(0, 1, 4, 2, 5, 3, 6, 7).reshape(b, 2 * nx, 2 * ny, 2 * nz, fine)


def _examples_in_cache(grids: Float[Array, "b x y z channels"]) -> int:
    """How many examples can be gathered at a time: 25 taps, of a grid that shrinks fourfold."""
    bytes_each = 25 / 4 * grids[0].size * grids.dtype.itemsize
    return max(1, int(CACHE_BYTES / bytes_each))


def _in_chunks(function, size, examples):
    """Apply a batched function to a few examples at a time."""
    if examples.shape[0] <= size:
        return function(examples)
    return lax.map(lambda x: function(x[None])[0], examples, batch_size=size)


def _sum_chunks(function, size, *examples):
    """Sum a batched function over a few examples at a time, in float32."""
    b = examples[0].shape[0]
    size = next(n for n in range(min(size, b), 0, -1) if b % n == 0)
    chunks = tuple(x.reshape(b // size, size, *x.shape[1:]) for x in examples)
    out = jax.eval_shape(function, *[x[0] for x in chunks])
    add = lambda total, chunk: (total + function(*chunk), None)  # noqa: E731
    total, _ = lax.scan(add, jnp.zeros(out.shape, jnp.float32), chunks)
    return total
