"""A population first, the gradient after it."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from problems import ellipsoid, run_batch, sphere

from jaxshape.search.methods.cma import cma
from jaxshape.search.methods.gradient import gradient
from jaxshape.search.methods.hybrid import polished
from jaxshape.search.refiner import StopReason
from jaxshape.search.stopping import Tolerances

KEY = jax.random.key(0)
POINTS = jnp.stack([jnp.full(5, 2.0), jnp.linspace(-1, 1, 5)])
POPULATION, HANDOVER, ITERATIONS = 8, 30, 40
SEARCH = cma(dim=5, sigma0=0.5, population=POPULATION)

pytestmark = pytest.mark.usefixtures("compile_quickly")


@pytest.fixture(scope="module")
def evaluated():
    """Points at which the objective was evaluated, that is, was more than NaN."""
    return []


@pytest.fixture(scope="module")
def found(evaluated):
    def objective(point):
        jax.debug.callback(lambda x: evaluated.append(x) if np.all(np.isfinite(x)) else None, point)
        return ellipsoid(point)

    refiner = polished(SEARCH, gradient(optax.adam(0.1)), HANDOVER)
    search = jax.jit(lambda: run_batch(refiner, lambda: objective, KEY, POINTS, ITERATIONS))
    result = jax.block_until_ready(search())
    jax.effects_barrier()
    return result


def test_the_search_that_rests_evaluates_nothing(found, evaluated):
    """One population per iteration, then one point; the start was evaluated once."""
    expected = 1 + POPULATION * HANDOVER + ITERATIONS - HANDOVER
    np.testing.assert_array_equal(found[1].evaluations[:, -1], expected)
    assert len(evaluated) == len(POINTS) * expected
    spent = np.diff(found[1].evaluations, axis=1)
    np.testing.assert_array_equal(spent[:, : HANDOVER - 1], POPULATION)
    np.testing.assert_array_equal(spent[:, HANDOVER - 1 :], 1)


def test_the_gradient_begins_at_the_best_point_and_ends_at_least_as_low(found):
    state, trace = found
    assert np.all(np.diff(trace.best_loss, axis=1) <= 0)
    handed_over = trace.best_loss[:, HANDOVER - 1]
    np.testing.assert_array_equal(handed_over, state.searched[0].best.loss)
    np.testing.assert_allclose(trace.loss[:, HANDOVER], handed_over, rtol=1e-5)
    np.testing.assert_allclose(jax.vmap(ellipsoid)(state.best.point), state.best.loss, rtol=1e-4)
    assert np.all(trace.spread[:, :HANDOVER] > 0) and np.all(trace.spread[:, HANDOVER:] == 0)
    sigma = trace.distribution.sigma  # rests
    assert np.all(sigma[:, HANDOVER:] == sigma[:, HANDOVER - 1 : HANDOVER])


@pytest.mark.slow
def test_it_reaches_the_floor_where_the_population_has_not():
    hybrid = polished(SEARCH, gradient(optax.lbfgs()), HANDOVER)
    _, trace = jax.jit(lambda: run_batch(hybrid, lambda: sphere, KEY, POINTS, ITERATIONS))()
    assert np.all(trace.best_loss[:, HANDOVER - 1] > 1e-4)
    assert np.all(trace.best_loss[:, -1] < 1e-9)


def test_each_object_is_polished_when_its_own_search_stops():
    """The second one begins at the minimum of a flat objective, and is done at once."""

    def objective_of(factor):
        return lambda point: factor * sphere(point)

    search = cma(dim=5, sigma0=0.5, population=POPULATION, tolerances=Tolerances(tolfun=1e-3))
    refiner = polished(search, gradient(0.01, tolerance=1e-9, patience=3), 25)
    states, traces = jax.jit(
        lambda: run_batch(refiner, objective_of, KEY, POINTS, 30, jnp.array([1.0, 0.0]))
    )()
    generations = np.asarray(states.searched[0].generation)
    assert generations[0] == 25 > 5 > generations[1]
    np.testing.assert_array_equal(states.stop, [StopReason.RUNNING, StopReason.TOLFUNHIST])
    np.testing.assert_array_equal(
        traces.evaluations[:, -1], 1 + 7 * generations + states.iterations
    )


def test_bad_settings_say_what_to_do():
    with pytest.raises(ValueError, match="iterations is 0; give a whole number, 1 or more"):
        polished(SEARCH, gradient(0.1), 0)
