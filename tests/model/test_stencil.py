"""The products on CPU are XLA's own convolution, and their derivatives are its derivatives.

Each is tested by tiles and with gathered neighbours, which bfloat16 takes on matrix units.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxshape.model import convolution, stencil
from jaxshape.model.stencil import convolve, multiply

SHAPES = [(1, 4, 3, 5), (3, 8, 2, 2), (2, 5, 4, 1), (2, 3, 2, 2)]
"""Examples, side, channels in and out: whole tiles, one that is filled up, and a grid below one."""


@pytest.fixture(params=["tiles", "gathered"])
def form(request, monkeypatch):
    """Both forms of the products."""
    if request.param == "gathered":
        monkeypatch.setattr(stencil, "_tiled", lambda grid: False)
    jax.clear_caches()
    return request.param


def draw(b, n, ci, co, dtype=jnp.float32):
    rng = np.random.default_rng(0)
    grid, kernel = rng.normal(size=(b, n, n, n, ci)), rng.normal(size=(3, 3, 3, ci, co))
    return jnp.asarray(grid, dtype), jnp.asarray(kernel, dtype)


@pytest.mark.parametrize("shape", SHAPES)
def test_products_are_the_convolution(form, shape):
    grid, kernel = draw(*shape)
    np.testing.assert_allclose(
        jax.jit(convolve)(grid, kernel), jax.jit(stencil._xla)(grid, kernel), atol=1e-4
    )


@pytest.mark.parametrize("shape", SHAPES)
def test_derivatives_are_those_of_the_convolution(form, shape):
    grid, kernel = draw(*shape)
    weights = jnp.cos(jnp.arange(shape[-1]))

    def of(function):
        loss = lambda grid, kernel: jnp.sum(jnp.sin(function(grid, kernel)) * weights)  # noqa: E731
        return jax.jit(jax.grad(loss, (0, 1)))(grid, kernel)

    for found, expected in zip(of(convolve), of(stencil._xla), strict=True):
        np.testing.assert_allclose(found, expected, atol=2e-3)


def test_chunks_change_nothing(form, monkeypatch):
    """Up to rounding: sums of large terms of both signs may be small."""
    grid, kernel = draw(5, 4, 3, 2)
    whole = jax.grad(lambda k: jnp.sum(convolve(grid, k) ** 2))(kernel)
    for size in ("CACHE_BYTES", "TILE_BYTES", "GRADIENT_BYTES"):
        monkeypatch.setattr(stencil, size, 1)
    one_by_one = jax.grad(lambda k: jnp.sum(convolve(grid, k) ** 2))(kernel)
    rounding = 1e-6 * float(jnp.max(jnp.abs(whole)))
    np.testing.assert_allclose(whole, one_by_one, rtol=0, atol=rounding)


def test_half_precision_is_close_and_keeps_its_type(form):
    grid, kernel = draw(2, 4, 8, 4, jnp.bfloat16)
    found = convolve(grid, kernel)
    exact = stencil._xla(grid.astype(jnp.float32), kernel.astype(jnp.float32))
    assert found.dtype == jnp.bfloat16
    assert float(jnp.max(jnp.abs(found - exact)) / jnp.max(jnp.abs(exact))) < 0.01


@pytest.mark.parametrize(
    "dtype, units, side, tiled",
    [(jnp.float32, True, 4, True), (jnp.bfloat16, False, 4, True),
     (jnp.bfloat16, True, 4, False), (jnp.float32, False, 3, False)],
)  # fmt: skip
def test_tiles_are_for_float32_and_for_processors_without_matrix_units(
    dtype, units, side, tiled, monkeypatch
):
    monkeypatch.setattr(convolution, "multiplies_bfloat16", lambda: units)
    assert stencil._tiled(jnp.zeros((1, side, side, side, 2), dtype)) is tiled


def test_the_product_of_every_voxel_has_the_derivatives_of_matmul():
    grid, kernel = draw(2, 3, 4, 6)
    matrix = kernel[0, 0, 0]

    def of(function):
        loss = lambda grid, matrix: jnp.sum(jnp.sin(function(grid, matrix)))  # noqa: E731
        return function(grid, matrix), *jax.grad(loss, (0, 1))(grid, matrix)

    for found, expected in zip(of(multiply), of(jnp.matmul), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-4)
