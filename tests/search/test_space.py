"""The coordinates of the search: whitening, and folding into a box."""

import cma as pycma
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxshape.model.pca import PCA
from jaxshape.model.shapes import ShapePrior
from jaxshape.search.space import fold, raw, whitened

BOUND = 2.0
SQUARE = jnp.array([[2.0, 0.0, 0.0], [1.0, 0.5, 0.0], [-1.0, 0.3, 0.1]])
PRIOR = ShapePrior(PCA, {}, jnp.array([1.0, -2.0, 3.0]), SQUARE @ SQUARE.T)
numbers = st.floats(-50, 50, width=32)


def test_the_white_space_has_the_mean_and_the_covariance_of_the_codes():
    points = jax.random.normal(jax.random.key(0), (200_000, 3))
    codes = jax.vmap(whitened(PRIOR).to_code)(points)
    np.testing.assert_allclose(codes.mean(axis=0), PRIOR.code_mean, atol=0.02)
    np.testing.assert_allclose(np.cov(codes.T), PRIOR.code_covariance, atol=0.05)
    np.testing.assert_allclose(whitened(PRIOR).root, SQUARE, rtol=1e-4)


@pytest.mark.parametrize(
    "space", [whitened(PRIOR), raw(PRIOR), whitened(PRIOR, 9.0), raw(PRIOR, 9.0)]
)
def test_a_code_comes_back_from_its_point(space):
    code = PRIOR.code_mean + jnp.array([0.3, 0.2, -0.1])
    np.testing.assert_allclose(space.to_code(space.from_code(code)), code, atol=1e-5)


def test_raw_points_are_codes():
    code = jnp.array([3.0, -1e4, 1e-4])
    np.testing.assert_array_equal(raw(PRIOR).to_code(code), code)


@settings(max_examples=20, deadline=None)
@given(st.lists(numbers, min_size=3, max_size=3))
def test_bounded_codes_lie_in_the_box_and_a_code_outside_starts_on_its_surface(point):
    space = whitened(PRIOR, BOUND)
    code = space.to_code(jnp.array(point, jnp.float32))
    inside = jnp.linalg.solve(space.root, code - space.mean)
    assert np.all(np.abs(inside) <= BOUND + 1e-3)
    first = space.from_code(whitened(PRIOR).to_code(jnp.array(point, jnp.float32)))
    np.testing.assert_allclose(first, np.clip(point, -BOUND, BOUND), atol=1e-2)


# --- folding ----------------------------------------------------------------------------------


def test_without_a_bound_folding_is_the_identity():
    point = jnp.array([-1e30, 0.0, 7.0])
    assert fold(point, None) is point


def test_folding_does_what_pycma_does_in_bounds():
    oracle = pycma.transformations.BoxConstraintsLinQuadTransformation([[-BOUND, BOUND]])
    with jax.enable_x64(True):
        points = np.linspace(-25, 25, 1001)
        # pycma scales its margin by the range and the place of the bounds, so compare with its
        # own: what both share is the box, the smoothness and the mirrored repetition.
        folded = np.asarray(fold(jnp.asarray(points), BOUND))
        theirs = np.array([oracle.transform([x])[0] for x in points])
    inside = np.abs(points) < 0.5 * BOUND
    np.testing.assert_allclose(folded[inside], theirs[inside], atol=1e-12)
    assert np.all(np.abs(folded) <= BOUND) and np.all(np.abs(theirs) <= BOUND + 1e-12)


def test_well_inside_nothing_is_moved_and_outside_it_repeats_mirrored():
    with jax.enable_x64(True):
        points = jnp.linspace(-0.9 * BOUND, 0.9 * BOUND, 101)
        np.testing.assert_allclose(fold(points, BOUND), points, atol=1e-14)
        turn = 1.1 * BOUND  # the preimage of the bound; the map is mirrored about it
        away = jnp.linspace(0, 30, 301)
        np.testing.assert_allclose(fold(turn + away, BOUND), fold(turn - away, BOUND), atol=1e-12)
        np.testing.assert_allclose(fold(away + 4 * turn, BOUND), fold(away, BOUND), atol=1e-12)
        np.testing.assert_allclose(fold(-away, BOUND), -fold(away, BOUND), atol=1e-12)
        assert fold(jnp.asarray(turn), BOUND) == BOUND


def test_folding_is_smooth():
    with jax.enable_x64(True):
        points = jnp.linspace(-10.0, 10.0, 20_001)
        folded, slope = jax.vmap(jax.value_and_grad(lambda x: fold(x, BOUND)))(points)
        assert np.all(np.isfinite(slope)) and np.all(np.abs(slope) <= 1 + 1e-9)
        # Neither jumps: the slope of the parabola changes by 1 / margin per unit at most.
        assert np.abs(np.diff(folded)).max() <= 1.01e-3
        assert np.abs(np.diff(slope)).max() <= 1.01e-3 / (0.2 * BOUND) * 2
        np.testing.assert_allclose(np.diff(folded) / 1e-3, (slope[1:] + slope[:-1]) / 2, atol=1e-2)
