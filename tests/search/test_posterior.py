"""Samples of the posterior, what they agree on, and probabilities that come true."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxshape.geometry.grids import Grids
from jaxshape.model import shapes
from jaxshape.model.calibration import UNCALIBRATED, Calibration
from jaxshape.search.calibrating import fit, fit_calibration
from jaxshape.search.config import RefineConfig
from jaxshape.search.curvature import expand
from jaxshape.search.posterior import hypotheses, narrowed, sample_codes
from jaxshape.search.reconstruction import reconstruct_jit
from jaxshape.search.residuals import BALANCED

pytestmark = pytest.mark.usefixtures("compile_quickly")
KEYS = jax.random.split(jax.random.key(0), 2)
decode = jax.jit(shapes.decode)


def test_narrowed_points_have_the_posterior_of_a_normal_prior_and_a_quadratic_loss():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 5))
    loss = lambda u: 0.5 * jnp.sum((jnp.float32(root) @ u) ** 2)  # noqa: E731
    about = jax.jit(lambda u: expand(loss, u, 5))(jnp.float32(rng.normal(size=5)))
    points = jax.jit(lambda about: narrowed(about, 4.0, jnp.eye(5)))(about)
    # Rows of the result are the square root of the covariance, which is symmetric.
    covariance = np.linalg.inv(np.eye(5) + 4 * root.T @ root)
    np.testing.assert_allclose(points @ points.T, covariance, atol=2e-5)


def left_half_measured(prior, code):
    """Grids of the shape of a code, whose left half was measured."""
    shape = decode(prior, code) > 0
    unknown = jnp.broadcast_to((jnp.arange(32) >= 16)[:, None, None], shape.shape)
    return Grids(shape & ~unknown, unknown)


def test_samples_about_a_found_code_agree_on_what_was_measured(linear_prior):
    code = jax.random.normal(jax.random.key(1), (2, 10))
    grids = left_half_measured(linear_prior, code)
    targets = jax.vmap(BALANCED.target)(grids, jnp.zeros(grids.occupied.shape))
    found = jax.jit(lambda *one: sample_codes(KEYS, *one, 64, residual=BALANCED, target=targets))(
        linear_prior, grids, code
    )
    assert found.shape == (2, 64, 10)
    deviation = jnp.std(found, axis=1)
    assert jnp.all(deviation < 0.5) and jnp.all(deviation > 0.001)  # the prior's is 1
    np.testing.assert_allclose(found.mean(axis=1), code, atol=0.2)
    assert not np.allclose(found[0], found[1])  # each object has a key of its own


def test_reconstructions_say_how_sure_they_are(linear_prior):
    code = jax.random.normal(jax.random.key(1), (2, 10))
    grids = left_half_measured(linear_prior, code)
    config = RefineConfig(samples=8)
    plain = reconstruct_jit(None, replace(config, samples=0))(KEYS, linear_prior, *grids[:2])
    assert plain.samples is None and plain.probability is None
    prior = linear_prior._replace(calibration=Calibration(0.5, 0.1, -0.2))
    found = reconstruct_jit(None, config)(KEYS, prior, *grids[:2])
    np.testing.assert_allclose(found.fill_logits, plain.fill_logits, atol=1e-5)
    assert found.samples.shape == (2, 8, 32, 32, 32)
    known = ~grids.occluded
    np.testing.assert_array_equal(found.probability[known], grids.occupied[known])
    spread = np.std(found.samples, axis=1)
    assert spread[np.asarray(grids.occluded)].max() > 0.01
    slope = np.maximum(0.5 - 0.1 * spread, 0)
    expected = 1 / (1 + np.exp(0.2 - slope * np.asarray(found.fill_logits)))
    hidden = np.asarray(grids.occluded)
    np.testing.assert_allclose(found.probability[hidden], expected[hidden], rtol=1e-3, atol=1e-5)


def test_weights_without_a_calibration_are_taken_at_their_word():
    logits, spread = jnp.array([-2.0, 0.0, 3.0]), jnp.array([5.0, 1.0, 0.0])
    np.testing.assert_allclose(
        UNCALIBRATED.probability(logits, spread), jax.nn.sigmoid(logits), rtol=1e-6
    )


def test_a_logit_is_never_turned_around_by_doubt():
    sure = Calibration(1.0, 0.5, 0.0).probability(jnp.array([4.0, -4.0]), jnp.array([9.0, 9.0]))
    np.testing.assert_allclose(sure, 0.5)


def test_the_fitted_calibration_is_the_one_that_made_the_outcomes():
    rng = np.random.default_rng(0)
    logits, spread = rng.normal(0, 3, 200_000), rng.uniform(0, 2, 200_000)
    true = Calibration(0.9, 0.2, -0.4)
    occupied = rng.random(200_000) < np.asarray(
        true.probability(jnp.asarray(logits), jnp.asarray(spread))
    )
    np.testing.assert_allclose(fit(logits, spread, occupied), true, atol=0.03)


@pytest.mark.slow
def test_a_few_objects_give_no_calibration_and_more_make_surfaces_more_probable(linear_prior):
    codes = jax.random.normal(jax.random.key(2), (16, 10))
    grids = left_half_measured(linear_prior, codes)
    surface = np.asarray(decode(linear_prior, codes) > 0)
    few = jax.tree.map(lambda x: x[:15], grids)
    assert fit_calibration(linear_prior, few, surface[:15]) is None
    found = fit_calibration(linear_prior, grids, surface, samples=4)
    run = reconstruct_jit(None, RefineConfig(samples=4))
    keys = jax.random.split(jax.random.key(3), 16)

    def nats(prior):
        shape = run(keys, prior, *grids[:2])
        p = np.clip(np.asarray(shape.probability), 1e-6, 1 - 1e-6)
        return -np.log(np.where(surface, p, 1 - p))[np.asarray(grids.occluded)].mean()

    assert nats(linear_prior._replace(calibration=found)) < nats(linear_prior)


def test_hypotheses_are_one_of_each_kind_with_the_share_of_its_samples():
    """Six samples have a block on the left, two on the right, and all of them noise."""
    rng = np.random.default_rng(0)
    samples = rng.normal(-3, 0.1, (8, 8, 8, 8))
    left = np.array([1, 1, 0, 1, 1, 0, 1, 1], bool)
    samples[left, :3] = 3
    samples[~left, 5:] = 3
    unknown = np.ones((8, 8, 8), bool)
    chosen, share = hypotheses(jnp.asarray(samples), jnp.asarray(unknown), 2)
    assert left[chosen[0]] and not left[chosen[1]]
    np.testing.assert_allclose(share, [0.75, 0.25])
    unknown[5:] = False  # what was measured is no matter of opinion
    unknown[:3] = False
    _, share = hypotheses(jnp.asarray(samples), jnp.asarray(unknown), 2)
    np.testing.assert_allclose(share, [1, 0])
