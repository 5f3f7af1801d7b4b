"""Gradient refiners: closed forms, optax optimisers, hostile objectives, batches."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from problems import ellipsoid, rosenbrock, run, run_batch, sphere

from jaxshape.refine.gradient import gradient

KEY = jax.random.key(0)


def test_a_fixed_step_on_the_sphere_shrinks_the_code_geometrically():
    """x <- x - 0.14 * 2 x, whose loss after n steps is known; the last arrival is unevaluated."""
    code = jnp.array([3.0, -4.0])
    state, trace = run(gradient(0.14), sphere, KEY, code, 10)
    np.testing.assert_allclose(trace.loss, 25 * 0.72 ** (2 * np.arange(10)), rtol=1e-5)
    np.testing.assert_allclose(state.mean, code * 0.72**10, rtol=1e-5)
    np.testing.assert_allclose(state.best.code, code * 0.72**9, rtol=1e-5)
    np.testing.assert_allclose(state.best.loss, sphere(state.best.code), rtol=1e-6)
    np.testing.assert_array_equal(trace.best_loss, trace.loss)
    np.testing.assert_array_equal(trace.spread, 0)


@pytest.mark.parametrize(
    "optimizer, objective, iterations",
    [
        (optax.adam(optax.cosine_decay_schedule(0.2, 400)), ellipsoid, 400),
        (optax.chain(optax.clip_by_global_norm(1.0), optax.sgd(1e-2)), sphere, 1000),
        (optax.lbfgs(), rosenbrock, 60),
    ],
    ids=["adam", "chain", "lbfgs"],
)
def test_converges_with_optax_optimisers(optimizer, objective, iterations):
    codes = jnp.stack([jnp.full(5, 2.0), jnp.linspace(-1, 1, 5)])
    states, traces = jax.jit(
        lambda: run_batch(gradient(optimizer), lambda: objective, KEY, codes, iterations)
    )()
    assert np.all(states.best.loss < 1e-6)
    assert np.all(np.diff(traces.best_loss, axis=1) <= 0)


def test_overshooting_never_loses_the_start():
    state, trace = run(gradient(1.5), sphere, KEY, jnp.ones(3), 10)
    assert state.best.loss == 3 and trace.loss[-1] > 1e3
    np.testing.assert_array_equal(state.best.code, jnp.ones(3))


@pytest.mark.parametrize("optimizer", [0.6, optax.lbfgs()])
@pytest.mark.parametrize(
    "objective",
    [
        lambda x: jnp.sum(jnp.sqrt(x) + x),  # NaN below 0, infinite slope at 0
        lambda x: jnp.where(x[0] > 0.5, sphere(x), jnp.nan),
        lambda x: jnp.nan * sphere(x),
        lambda x: -jnp.log(x[0]) * jnp.exp(90 * x[1]),  # overflows
    ],
)
def test_values_that_are_not_finite_send_it_back_to_the_best_code(optimizer, objective):
    code = jnp.array([1.0, 0.7])
    first = objective(code)
    state, trace = jax.jit(lambda: run(gradient(optimizer), objective, KEY, code, 40))()
    assert np.all(np.isfinite(state.best.code))
    if jnp.isfinite(first):
        assert state.best.loss <= first
        np.testing.assert_allclose(objective(state.best.code), state.best.loss, rtol=1e-5)
    else:
        np.testing.assert_array_equal(state.best.code, code)
    assert not np.any(np.isnan(trace.best_loss))


def test_a_step_that_fails_every_time_stays_at_the_best_code():
    def objective(x):
        return jnp.where((x[0] < -0.05) & (x[0] > -0.15), jnp.nan, x[0] ** 2)

    state, trace = run(gradient(optax.adam(2.0)), objective, KEY, jnp.array([1.9]), 6)
    np.testing.assert_allclose(trace.loss, [1.9**2, jnp.inf] * 3, rtol=1e-6)
    np.testing.assert_allclose(state.best.code, 1.9)
    np.testing.assert_allclose(state.mean, 1.9)


def test_rows_of_a_batch_are_independent():
    @jax.jit
    def refine(factors):
        def objective_of(factor):
            return lambda code: factor * ellipsoid(code)

        return run_batch(
            gradient(optax.adam(0.1)), objective_of, KEY, jnp.ones((2, 4)), 20, factors
        )

    (states, _), (disturbed, _) = refine(jnp.ones(2)), refine(jnp.array([1.0, jnp.nan]))
    jax.tree.map(lambda x, y: np.testing.assert_array_equal(x[0], y[0]), states, disturbed)


def test_one_trace_per_shape():
    traced = []

    def objective(code):
        traced.append(code.shape)
        return sphere(code)

    refine = jax.jit(lambda codes: run_batch(gradient(0.1), lambda: objective, KEY, codes, 5)[0])
    for seed in range(3):
        refine(jnp.full((4, 3), float(seed)))
    assert len(traced) == 2  # the start, and a step
