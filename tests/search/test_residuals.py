"""The residuals: Eq. 7 against the paper in NumPy, and what its members promise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from jaxshape.geometry.grids import Grids
from jaxshape.search.residuals import (
    BALANCED,
    LESS_FREE,
    PAPER,
    SOFT,
    UNDER_NOISE,
    Target,
    Weights,
    cross_entropy,
    equation_7,
    soft,
    weigh,
)

SHAPE = (4, 3, 5)
rng = np.random.default_rng(0)


def random_grids(*batch):
    return jnp.asarray(rng.random((*batch, *SHAPE)) < 0.5)


def random_logits(*batch):
    return jnp.asarray(rng.normal(size=(*batch, *SHAPE)), jnp.float32)


def of_paper(occupied, occluded, first_logits):
    return PAPER.target(Grids(occupied, occluded), first_logits)


def balanced_target(occupied, occluded, first_logits):
    return BALANCED.target(Grids(occupied, occluded), first_logits)


def sigmoid(x):
    return 1 / (1 + np.exp(-np.float64(x)))


def printed_equation(F, M, G, G0):
    """Eq. 7 term by term, in float64, with the 1 / N^3 of the training loss."""
    alpha = M.sum() / (1 - M).sum()

    def f(t, g):
        return -(t * np.log(g) + (1 - t) * np.log(1 - g))

    total = 0.0
    for voxel in np.ndindex(F.shape):
        total += (1 - M[voxel]) * f(F[voxel], G[voxel]) + alpha * M[voxel] * f(G0[voxel], G[voxel])
    return total / F.size


booleans = arrays(bool, SHAPE)
logits_of_a_grid = arrays(np.float32, SHAPE, elements=st.floats(-9, 9, width=32))


@settings(max_examples=40, deadline=None)
@given(booleans, booleans, logits_of_a_grid, logits_of_a_grid)
def test_it_is_the_equation_as_printed(occupied, occluded, prior_logits, logits):
    occluded[0, 0, 0] = False  # else the printed alpha is infinite
    weights = of_paper(*map(jnp.asarray, (occupied, occluded, prior_logits)))
    ours = cross_entropy(jnp.asarray(logits), weights)
    expected = printed_equation(
        occupied.astype(int), occluded.astype(int), sigmoid(logits), sigmoid(prior_logits)
    )
    # The softplus of logits far from 0 is small, and rounded as 1 + small is.
    rounding = np.finfo(np.float32).eps * float(np.mean(weights.occupied + weights.empty))
    np.testing.assert_allclose(ours, expected, rtol=1e-5, atol=rounding)


def test_only_measured_free_voxels_are_weighed_down():
    occupied, occluded = random_grids(2)
    logits = random_logits()
    printed = of_paper(occupied, occluded, logits)
    balanced = balanced_target(occupied, occluded, logits)
    np.testing.assert_array_equal(printed.occupied, balanced.occupied)
    expected = np.where(~occupied & ~occluded, printed.empty / 3, printed.empty)
    np.testing.assert_allclose(balanced.empty, expected, rtol=1e-6)
    assert (balanced.empty < printed.empty).sum() == (~occupied & ~occluded).sum() > 0


def test_the_prior_is_scaled_and_nothing_else():
    occupied, occluded = random_grids(2)
    logits = random_logits()
    once = of_paper(occupied, occluded, logits)
    twice = equation_7(Weights(prior=2.0)).target(Grids(occupied, occluded), logits)
    factor = np.where(occluded, 2, 1)
    np.testing.assert_allclose(twice.occupied, factor * once.occupied, rtol=1e-6)
    np.testing.assert_allclose(twice.empty, factor * once.empty, rtol=1e-6)


def test_nothing_or_everything_occluded_is_defined():
    occupied, (prior_logits, logits) = random_grids(), random_logits(2)

    none = of_paper(occupied, jnp.zeros(SHAPE, bool), prior_logits)
    np.testing.assert_array_equal(none.occupied, occupied)
    np.testing.assert_array_equal(none.empty, ~occupied)
    assert np.isfinite(cross_entropy(logits, none))

    everything = of_paper(occupied, jnp.ones(SHAPE, bool), prior_logits)
    count = np.prod(SHAPE)
    np.testing.assert_allclose(everything.occupied, count * sigmoid(prior_logits), rtol=1e-5)
    assert np.isfinite(cross_entropy(logits, everything))


def test_saturated_logits_stay_exact():
    """Where float32 rounds G to 0 or 1, log G would be infinite."""
    logits = jnp.array([-200.0, -30.0, 30.0, 200.0]).reshape(4, 1, 1)
    ones, zeros = jnp.ones((4, 1, 1)), jnp.zeros((4, 1, 1))
    wants_occupied = jax.grad(lambda x: cross_entropy(x, Target(ones, zeros)))(logits)
    np.testing.assert_allclose(cross_entropy(logits, Target(ones, zeros)), 230 / 4, rtol=1e-6)
    np.testing.assert_allclose(cross_entropy(logits, Target(zeros, ones)), 230 / 4, rtol=1e-6)
    np.testing.assert_allclose(wants_occupied.ravel(), [-0.25, -0.25, 0, 0], atol=1e-7)


def test_voxels_without_weight_have_no_say():
    """Observed voxels ignore the prior; with none occluded, the prior counts for nothing."""
    occupied, occluded = random_grids(2)
    logits, prior_logits = random_logits(2)

    def loss(logits, prior_logits, occluded):
        return cross_entropy(logits, balanced_target(occupied, occluded, prior_logits))

    slope_of = jax.jit(jax.grad(loss, argnums=1))
    slope = slope_of(logits, prior_logits, occluded)
    assert np.all(slope[~occluded] == 0) and np.all(slope[occluded] != 0)
    assert np.all(slope_of(logits, prior_logits, occluded & False) == 0)

    weights = balanced_target(occupied, occluded, prior_logits)
    silent = jax.tree.map(lambda x: jnp.where(jnp.arange(5) < 2, 0, x), weights)
    slope = jax.grad(cross_entropy)(logits, silent)
    assert np.all(slope[..., :2] == 0) and np.any(slope[..., 2:] != 0)


@pytest.mark.parametrize("residual", [PAPER, BALANCED])
def test_its_minimum_is_the_measurement_where_observed_and_the_prior_elsewhere(residual):
    """The slope over logits is zero at the prior, and points to the measurement at any logit."""
    occupied, occluded = random_grids(2)
    prior_logits, logits = random_logits(2)
    weights = residual.target(Grids(occupied, occluded), prior_logits)
    slope_at = jax.grad(cross_entropy)

    np.testing.assert_allclose(slope_at(prior_logits, weights)[occluded], 0, atol=1e-7)
    towards_prior = np.sign(logits - prior_logits)
    np.testing.assert_array_equal(
        np.sign(slope_at(logits, weights))[occluded], towards_prior[occluded]
    )
    towards_measured = np.where(occupied, -1, 1)
    for start in (logits, prior_logits):
        np.testing.assert_array_equal(
            np.sign(slope_at(start, weights))[~occluded], towards_measured[~occluded]
        )


def test_leading_axes_are_a_batch():
    occupied, occluded = random_grids(2, 2, 3)
    prior_logits, logits = random_logits(2, 2, 3)
    score = jax.jit(
        lambda *grids: cross_entropy(grids[2], weigh(Grids(grids[0], grids[1]), grids[3]))
    )
    losses = score(occupied, occluded, logits, prior_logits)
    for i in np.ndindex(2, 3):
        one = score(occupied[i], occluded[i], logits[i], prior_logits[i])
        np.testing.assert_allclose(losses[i], one, rtol=1e-6)


# --- how sure a voxel is -----------------------------------------------------------------------


def test_where_all_is_sure_soft_is_balanced_but_for_the_least_alpha():
    occupied, occluded = random_grids(2)
    logits = random_logits()
    grids = Grids(occupied & ~occluded, occluded)
    certain = jax.tree.map(lambda x: x.astype(jnp.float32), grids)
    found = soft(LESS_FREE).target(certain, logits)
    jax.tree.map(np.testing.assert_array_equal, found, BALANCED.target(grids, logits))


def test_the_prior_keeps_its_weight_where_little_is_hidden():
    occluded = jnp.zeros(SHAPE).at[0, 0].set(1)
    target = SOFT.target(Grids(1 - occluded, occluded), random_logits())
    weight = (target.occupied + target.empty)[occluded > 0]
    np.testing.assert_allclose(weight, UNDER_NOISE.least_alpha, rtol=1e-5)
    printed = PAPER.target(Grids(occluded == 0, occluded > 0), random_logits())
    assert (printed.occupied + printed.empty)[occluded > 0].max() < 0.1


def test_a_voxel_counts_as_much_as_it_is_known():
    """At M = 1/4 a measured voxel pulls with 3/4, and the prior with 1/4 of alpha."""
    F, M = jnp.ones(SHAPE), jnp.full(SHAPE, 0.25)
    target = soft(LESS_FREE).target(Grids(F, M), jnp.zeros(SHAPE))
    alpha = 0.25 / 0.75
    np.testing.assert_allclose(target.occupied, 0.75 + alpha * 0.25 * 0.5, rtol=1e-6)
    np.testing.assert_allclose(target.empty, alpha * 0.25 * 0.5, rtol=1e-6)


def test_eq_7_rounds_soft_grids():
    F, M = jnp.asarray(rng.random((2, *SHAPE)), jnp.float32)
    logits = random_logits()
    rounded = PAPER.target(Grids((F > 0.5) & (M <= 0.5), M > 0.5), logits)
    jax.tree.map(np.testing.assert_array_equal, PAPER.target(Grids(F, M), logits), rounded)
