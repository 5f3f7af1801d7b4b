"""From F and M to completed and composed grids."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis.extra.numpy import arrays

from jaxshape.refine import reconstruction
from jaxshape.refine.config import METHODS, RefineConfig
from jaxshape.refine.objective import cross_entropy, target
from jaxshape.refine.reconstruction import (
    compose,
    reconstruct_jit,
    refiner_for,
    require_measured,
)

KEY = jax.random.key(0)
KEYS = jax.random.split(KEY, 2)
CONFIG = RefineConfig(iterations=4, population=8, sigma0=0.2)
OCCUPIED, OCCLUDED = jax.random.bernoulli(KEY, jnp.array([0.1, 0.5])[:, None, None, None, None],
                                          (2, 2, 32, 32, 32))  # fmt: skip
OCCLUDED = OCCLUDED & ~OCCUPIED


@pytest.fixture(scope="module")
def encoded(linear_prior):
    return reconstruct_jit(None, CONFIG)(KEYS, linear_prior, OCCUPIED, OCCLUDED)


@pytest.fixture(scope="module")
def searched(linear_prior):
    return reconstruct_jit(refiner_for("cma", linear_prior, CONFIG), CONFIG)(
        KEYS, linear_prior, OCCUPIED, OCCLUDED
    )


grids = arrays(bool, (3, 4, 2))


@settings(max_examples=40, deadline=None)
@given(grids, grids, grids)
def test_composing_keeps_what_was_observed_and_fills_the_rest(occupied, occluded, completed):
    composed = compose(*map(jnp.asarray, (occupied, occluded, completed)))
    for voxel in np.ndindex(composed.shape):
        expected = completed[voxel] if occluded[voxel] else occupied[voxel]
        assert composed[voxel] == expected


def test_the_encoder_alone_answers_with_its_first_code(linear_prior, encoded):
    first_code = reconstruction.encode(linear_prior.params, OCCUPIED)
    np.testing.assert_allclose(encoded.first_code, first_code, rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(encoded.code, encoded.first_code)
    np.testing.assert_array_equal(encoded.completed, encoded.completed_first)
    np.testing.assert_array_equal(encoded.objective, encoded.first_objective)
    assert encoded.trace is None and refiner_for("encoder", linear_prior, CONFIG) is None
    assert 0.01 < encoded.completed.mean() < 0.99  # the prior says something


def test_a_search_starts_from_the_encoder_and_lowers_the_objective(encoded, searched):
    np.testing.assert_allclose(searched.first_objective, encoded.objective, rtol=1e-5)
    assert np.all(searched.objective < searched.first_objective)
    assert not np.allclose(searched.code, searched.first_code)
    assert searched.trace.best_loss.shape == (2, CONFIG.iterations)


def test_all_fields_belong_to_the_refined_code(linear_prior, searched):
    logits = reconstruction.decode(linear_prior.params, searched.code)
    np.testing.assert_allclose(searched.logits, logits, atol=1e-4)
    np.testing.assert_array_equal(searched.completed, searched.logits > 0)
    first_logits = reconstruction.decode(linear_prior.params, searched.first_code)
    loss = cross_entropy(searched.logits, target(OCCUPIED, OCCLUDED, first_logits))
    np.testing.assert_allclose(searched.objective, loss, rtol=1e-5)
    np.testing.assert_array_equal(
        searched.composed, compose(OCCUPIED, OCCLUDED, searched.completed)
    )


def test_the_paper_objective_weighs_measured_voxels_once(linear_prior, encoded):
    paper = reconstruct_jit(None, replace(CONFIG, objective="paper"))
    printed = paper(KEYS, linear_prior, OCCUPIED, OCCLUDED)
    weights = target(OCCUPIED, OCCLUDED, encoded.logits, occupied_weight=1.0)
    np.testing.assert_allclose(printed.objective, cross_entropy(encoded.logits, weights), rtol=1e-5)
    assert np.all(printed.objective < encoded.objective)


def test_each_method_has_its_search_with_the_settings_asked_for(linear_prior):
    config = RefineConfig(sigma0=0.7, step_size=0.01)
    wide = linear_prior._replace(code_covariance=4 * linear_prior.code_covariance)
    code, loss = jnp.zeros(10), jnp.asarray(1.0)
    state = refiner_for("cma", wide, config).init(KEY, code, loss)
    assert state.sigma == pytest.approx(0.7)
    many = refiner_for("cma", wide, replace(config, population=400))
    _, trace = jax.jit(lambda state: many.step(KEY, state, jnp.sum))(state)
    assert trace.spread == pytest.approx(1.4, rel=0.05)  # 0.7 deviations of the training codes

    descent = refiner_for("gradient", linear_prior, config)
    state, _ = descent.step(KEY, descent.init(KEY, code, loss), jnp.sum)
    np.testing.assert_allclose(state.mean, np.full(10, -0.01))
    assert METHODS == ("encoder", "gradient", "cma")


def test_nothing_measured_is_said_in_a_sentence():
    require_measured(OCCUPIED)
    with pytest.raises(ValueError, match="Nothing was measured inside the object's box: .*Check"):
        require_measured(OCCUPIED.at[1].set(False))
    with pytest.raises(ValueError, match="Nothing was measured"):
        require_measured(jnp.zeros((4, 4, 4), bool))
