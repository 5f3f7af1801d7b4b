"""From F and M to completed and composed grids."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis.extra.numpy import arrays

from jaxshape.geometry.grids import Grids
from jaxshape.geometry.overlap import iou
from jaxshape.model.pca import PCA
from jaxshape.model.shapes import decode, encode
from jaxshape.search.composition import complete, compose
from jaxshape.search.config import RefineConfig
from jaxshape.search.reconstruction import (
    code_penalty,
    fit_surface,
    reconstruct,
    reconstruct_jit,
    refiner_for,
    require_measured,
    search_space,
    usual_method,
)
from jaxshape.search.refiner import StopReason
from jaxshape.search.residuals import BALANCED, PAPER, RESIDUALS, Residual, cross_entropy

KEY = jax.random.key(0)
KEYS = jax.random.split(KEY, 2)
CONFIG = RefineConfig(iterations=4, population=8, sigma0=0.2)
OCCUPIED, OCCLUDED = jax.random.bernoulli(KEY, jnp.array([0.1, 0.5])[:, None, None, None, None],
                                          (2, 2, 32, 32, 32))  # fmt: skip
OCCLUDED = OCCLUDED & ~OCCUPIED
GRIDS = Grids(OCCUPIED, OCCLUDED)


@pytest.fixture(scope="module")
def encoded(linear_prior):
    return reconstruct_jit(None, CONFIG)(KEYS, linear_prior, OCCUPIED, OCCLUDED)


@pytest.fixture(scope="module")
def searched(linear_prior):
    return reconstruct_jit(refiner_for("cma", linear_prior, CONFIG), CONFIG)(
        KEYS, linear_prior, OCCUPIED, OCCLUDED
    )


pytestmark = pytest.mark.usefixtures("compile_quickly")


def test_only_decoders_that_do_not_see_the_measurement_are_searched(linear_prior):
    assert usual_method(linear_prior) == "gradient:adam"
    model = replace(linear_prior.model, conditional=True)
    assert usual_method(linear_prior._replace(model=model)) == "encoder"


grids = arrays(bool, (3, 4, 2))


@settings(max_examples=40, deadline=None)
@given(grids, grids, grids)
def test_composing_keeps_what_was_observed_and_fills_the_rest(occupied, occluded, completed):
    composed = compose(*map(jnp.asarray, (occupied, occluded, completed)))
    for voxel in np.ndindex(composed.shape):
        expected = completed[voxel] if occluded[voxel] else occupied[voxel]
        assert composed[voxel] == expected


def test_the_encoder_alone_answers_with_its_first_code(linear_prior, encoded):
    first_code = encode(linear_prior, GRIDS)
    np.testing.assert_allclose(encoded.first_code, first_code, rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(encoded.code, encoded.first_code)
    np.testing.assert_array_equal(encoded.completed, encoded.completed_first)
    np.testing.assert_array_equal(encoded.objective, encoded.first_objective)
    assert encoded.trace is None and encoded.iterations is None and encoded.stop is None
    assert 0.01 < encoded.completed.mean() < 0.99  # the prior says something


def test_a_search_starts_from_the_encoder_and_lowers_the_objective(encoded, searched):
    np.testing.assert_allclose(searched.first_objective, encoded.objective, rtol=1e-5)
    assert np.all(searched.objective < searched.first_objective)
    assert not np.allclose(searched.code, searched.first_code)
    assert searched.trace.best_loss.shape == (2, CONFIG.iterations)


def test_all_fields_belong_to_the_refined_code(linear_prior, searched):
    logits = decode(linear_prior, searched.code)
    np.testing.assert_allclose(searched.logits, logits, atol=1e-4)
    np.testing.assert_array_equal(searched.completed, searched.logits > 0)
    first_logits = decode(linear_prior, searched.first_code)
    loss = cross_entropy(searched.logits, BALANCED.target(GRIDS, first_logits))
    np.testing.assert_allclose(searched.objective, loss, rtol=1e-5)
    filled = complete(GRIDS, searched.logits, symmetry=True)
    np.testing.assert_array_equal(searched.composed, filled.composed)
    np.testing.assert_allclose(searched.fill_logits, filled.logits, atol=1e-5)
    np.testing.assert_array_equal(searched.symmetric, filled.symmetric)


def test_without_symmetry_the_composed_shape_is_that_of_the_paper(linear_prior, encoded):
    plain = reconstruct_jit(None, replace(CONFIG, symmetry=False))
    found = plain(KEYS, linear_prior, OCCUPIED, OCCLUDED)
    np.testing.assert_array_equal(found.composed, compose(OCCUPIED, OCCLUDED, found.completed))
    np.testing.assert_array_equal(found.completed, encoded.completed)
    assert found.symmetric is None and found.agreement is None


def test_soft_grids_are_searched_by_the_soft_residual_and_binary_ones_by_the_balanced(linear_prior):
    """Unless the settings name one."""
    soft = Grids(jnp.where(OCCUPIED, 0.8, 0.3), jnp.where(OCCLUDED, 0.7, 0.1))
    for grids, name in ((soft, "soft"), (GRIDS, "balanced")):
        for objective in (None, "paper"):
            run = reconstruct_jit(None, replace(CONFIG, objective=objective))
            found = run(KEYS, linear_prior, grids.occupied, grids.occluded)
            residual = RESIDUALS[objective or name]
            targets = jax.vmap(residual.target)(grids, found.logits)
            expected = jax.vmap(residual.score)(found.logits, targets)
            np.testing.assert_allclose(found.objective, expected, rtol=1e-5)


def test_the_paper_objective_weighs_free_space_in_full(linear_prior, encoded):
    paper = reconstruct_jit(None, replace(CONFIG, objective="paper"))
    printed = paper(KEYS, linear_prior, OCCUPIED, OCCLUDED)
    weights = PAPER.target(GRIDS, encoded.logits)
    np.testing.assert_allclose(printed.objective, cross_entropy(encoded.logits, weights), rtol=1e-5)
    assert np.all(printed.objective > encoded.objective)


def test_the_search_is_set_up_as_asked(linear_prior):
    assert refiner_for("encoder", linear_prior, CONFIG) is None
    refiner = refiner_for("cma", linear_prior, replace(CONFIG, sigma0=0.7))
    state, _ = refiner.init(KEY, jnp.zeros(10), jnp.asarray(1.0))
    assert state.sigma == pytest.approx(0.7)
    with pytest.raises(ValueError, match="no method 'anneal'"):
        refiner_for("anneal", linear_prior, CONFIG)


# --- the space of the search ----------------------------------------------------------------------

ROOT = jnp.tril(jax.random.normal(jax.random.key(3), (10, 10))) + 3 * jnp.eye(10)
MEAN = jnp.arange(10.0)


@pytest.fixture(scope="module")
def skewed(linear_prior):
    """A prior whose codes have a mean and a covariance of their own."""
    return linear_prior._replace(code_mean=MEAN, code_covariance=ROOT @ ROOT.T)


def searching(prior, method="cma", **settings):
    config = replace(CONFIG, **settings)
    run = reconstruct_jit(refiner_for(method, prior, config), config)
    return run(KEYS, prior, OCCUPIED, OCCLUDED)


def mahalanobis(code):
    """Squared, in float64."""
    covariance = np.asarray(ROOT, np.float64) @ np.asarray(ROOT, np.float64).T
    apart = np.asarray(code, np.float64) - np.asarray(MEAN)
    return np.einsum("...i,ij,...j->...", apart, np.linalg.inv(covariance), apart)


def test_in_the_whitened_space_sigma0_is_in_deviations_of_the_training_codes(skewed):
    config = replace(CONFIG, population=2000, sigma0=0.1)
    space = search_space(skewed, config)
    points = 0.1 * jax.random.normal(KEY, (4000, 10))
    codes = jax.vmap(space.to_code)(points)
    np.testing.assert_allclose(np.cov(codes.T) / 0.01, ROOT @ ROOT.T, rtol=0.2, atol=1)
    np.testing.assert_allclose(mahalanobis(codes), np.sum(points**2, axis=1), rtol=1e-2, atol=1e-4)
    np.testing.assert_allclose(codes.mean(axis=0), MEAN, atol=0.05)


def test_in_the_raw_space_points_are_codes(skewed):
    space = search_space(skewed, replace(CONFIG, space="raw"))
    np.testing.assert_array_equal(space.to_code(MEAN), MEAN)
    found = searching(skewed, "gradient", space="raw", step_size=0.1, iterations=1)
    assert np.all(found.objective < found.first_objective)
    slope = jax.grad(
        lambda code: jnp.sum(
            cross_entropy(
                decode(skewed, code),
                BALANCED.target(GRIDS, decode(skewed, found.first_code)),
            )
        )
    )(found.first_code)
    np.testing.assert_allclose(found.code, found.first_code - 0.1 * slope, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("space", ["whitened", "raw"])
def test_a_bound_holds_every_coordinate(skewed, space):
    """The first code lies outside and is moved in, where the trace begins."""
    settings = {"space": space, "step_size": 0.3, "iterations": 6}
    found = searching(skewed, "gradient", bound=0.3, **settings)
    free = search_space(skewed, replace(CONFIG, space=space))
    first, last = (jax.vmap(free.from_code)(x) for x in (found.first_code, found.code))
    assert np.all(np.abs(last) <= 0.3001)
    assert np.all(np.abs(first).max(axis=1) > 0.31) and np.any(np.abs(last) > 0.2)
    assert np.all(found.objective < found.trace.loss[:, 0])


def test_the_prior_pulls_codes_to_their_mean(skewed):
    """Its weight counts nats: half the squared Mahalanobis distance, once per grid."""
    code = MEAN + ROOT @ jnp.linspace(-1, 1, 10)
    penalty = code_penalty(skewed)
    np.testing.assert_allclose(penalty(code), 0.5 * mahalanobis(code) / 32**3, rtol=1e-4)
    assert penalty(MEAN) == 0

    distances = []
    for weight in (0.0, 1e7):
        found = searching(skewed, "gradient", iterations=8, prior_weight=weight, step_size=3e-3)
        distances.append(mahalanobis(found.code))
        if weight:  # the loss of the search is the sum of both
            total = found.objective + weight * jax.vmap(penalty)(found.code)
            assert np.all(total <= found.trace.best_loss[:, -1] * 1.0001)
    assert np.all(distances[0] > 1) and np.all(distances[1] < 1e-3)


def test_a_target_ends_the_search(linear_prior, encoded):
    goal = float(encoded.objective.mean())  # one object is there from the start
    found = searching(linear_prior, "gradient", target=goal, step_size=1e-9, tolerance=0.0)
    done = np.asarray(encoded.objective) <= goal
    np.testing.assert_array_equal(found.iterations, np.where(done, 0, CONFIG.iterations))
    np.testing.assert_array_equal(found.stop, np.where(done, StopReason.TARGET, StopReason.BUDGET))


def test_nothing_measured_is_said_in_a_sentence():
    require_measured(OCCUPIED)
    with pytest.raises(ValueError, match="Nothing was measured inside the object's box: .*Check"):
        require_measured(OCCUPIED.at[1].set(False))
    with pytest.raises(ValueError, match="Nothing was measured"):
        require_measured(jnp.zeros((4, 4, 4), bool))


def test_a_surface_that_the_space_holds_is_found_from_any_code(linear_prior):
    codes = 3 * jax.random.normal(jax.random.key(6), (2, 10))
    surface = decode(linear_prior, codes) > 0
    at_zero = replace(PCA, encode=lambda params, grids: jnp.zeros((2, 10)))
    fitted = jax.jit(fit_surface)(linear_prior._replace(model=at_zero), surface)
    assert (iou(fitted, surface) > 0.8).all()


# --- what is given --------------------------------------------------------------------------------


def test_one_key_serves_a_batch(linear_prior, searched):
    run = reconstruct_jit(refiner_for("cma", linear_prior, CONFIG), CONFIG)
    found = run(KEY, linear_prior, OCCUPIED, OCCLUDED)
    np.testing.assert_array_equal(found.code, searched.code)


@pytest.mark.parametrize(
    "occupied, occluded, said",
    [
        (OCCUPIED[0], OCCLUDED[0], r"occupied has shape \(32, 32, 32\).*occupied\[None\]"),
        (OCCUPIED, OCCLUDED[:1], r"occluded \(1, 32, 32, 32\); give both as"),
        (jnp.zeros((1, 64, 64, 64), bool), jnp.zeros((1, 64, 64, 64), bool),
         r"this prior knows shapes of 32 x 32 x 32 voxels"),
        (OCCUPIED[:0], OCCLUDED[:0], "There are no objects"),
        (jnp.nan * OCCUPIED, 1.0 * OCCLUDED, "occupied holds NaN or values outside 0 to 1"),
        (1.0 * OCCUPIED, 2 * OCCLUDED, "occluded holds NaN or values outside 0 to 1"),
    ],
)  # fmt: skip
def test_grids_that_do_not_fit_are_named(linear_prior, unchecked_types, occupied, occluded, said):
    with pytest.raises(ValueError, match=said):
        reconstruct(KEY, linear_prior, occupied, occluded, None, CONFIG)


def test_a_trace_may_close_over_grids_of_any_type(linear_prior):
    """In bfloat16, 0.501 would be rounded to 0.5, and no 1 would be a probability."""
    F, M = OCCUPIED.astype(jnp.bfloat16), OCCLUDED.astype(jnp.bfloat16)
    config = RefineConfig(iterations=1)
    twice = jax.jit(lambda x: x * reconstruct(KEY, linear_prior, F, M, None, config).objective)
    alone = reconstruct(KEY, linear_prior, OCCUPIED, OCCLUDED, None, config).objective
    np.testing.assert_allclose(twice(2.0), 2 * alone, rtol=1e-5)


def test_a_singular_covariance_still_leaves_a_space_to_search_in(linear_prior):
    """Codes of a training set may leave out directions; they used to end in NaN."""
    singular = linear_prior._replace(code_covariance=jnp.diag(jnp.arange(10.0)))
    found = searching(singular)
    assert np.all(np.isfinite(found.logits)) and np.all(found.objective < found.first_objective)
    with pytest.raises(ValueError, match="not positive semi-definite"):
        search_space(linear_prior._replace(code_covariance=-jnp.eye(10)), CONFIG)


def test_own_data_reaches_the_residual_of_its_object(linear_prior):
    residual = Residual(lambda grids, first: grids.data, lambda logits, data: data * logits.mean())
    config = replace(CONFIG, iterations=1)
    run = reconstruct_jit(refiner_for("gradient", linear_prior, config), config, residual)
    found = run(KEY, linear_prior, OCCUPIED, OCCLUDED, data=jnp.array([1.0, -1.0]))
    moved = found.logits.mean((1, 2, 3)) - decode(linear_prior, found.first_code).mean((1, 2, 3))
    assert moved[0] < 0 < moved[1]


def test_soft_grids_compose_by_probability(linear_prior):
    """Surface that is surely measured stays; half-known voxels follow the more likely."""
    soft = jnp.where(OCCUPIED, 0.8, 0.3), jnp.where(OCCLUDED, 0.7, 0.1)
    found = reconstruct_jit(None, replace(CONFIG, symmetry=False))(KEYS, linear_prior, *soft)
    F, M = (np.asarray(x, np.float64) for x in soft)
    p = 1 / (1 + np.exp(-np.float64(found.logits)))
    mixed = (1 - M) * F + M * p
    clear = np.abs(mixed - 0.5) > 1e-4
    np.testing.assert_array_equal(found.composed[clear], (mixed > 0.5)[clear])


@pytest.mark.parametrize(
    "change, said",
    [
        ({"prior": "chair"}, "prior is of type str; give a ShapePrior, as load_prior makes it"),
        ({"refiner": "cma"}, "refiner is of type str; give a Refiner, as build_refiner"),
        ({"config": {}}, "config is of type dict; give a RefineConfig"),
        ({"residual": "soft"}, "residual is of type str; give a Residual"),
        ({"keys": 0}, r"keys is 0; give random keys, as jax.random.key\(0\)"),
        ({"data": jnp.ones(3)}, r"data has an array of shape \(3,\), but there are 2 objects"),
        ({"earlier": jnp.ones((2, 3))}, r"shape \(2, 3\); the codes of this prior have 10"),
        ({"residual": BALANCED._replace(score=lambda logits, target: logits.sum(0))},
         r"score of the residual must return one .* float32 of shape \(32, 32\)"),
    ],
)  # fmt: skip
def test_arguments_of_another_kind_are_named(unchecked_types, linear_prior, change, said):
    given = {"keys": KEYS, "prior": linear_prior, "occupied": OCCUPIED, "occluded": OCCLUDED,
             "refiner": None, "config": CONFIG}  # fmt: skip
    with pytest.raises(ValueError, match=said):
        reconstruct(**given | change)
