"""Gradient refiners: closed forms, optax optimisers, hostile objectives, batches."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import optax.contrib
import pytest
from problems import ellipsoid, rosenbrock, run, run_batch, sphere

from jaxshape.search.config import RefineConfig
from jaxshape.search.methods.gradient import STEP_SIZES, UNUSABLE, build, gradient
from jaxshape.search.refiner import StopReason

KEY = jax.random.key(0)

pytestmark = pytest.mark.usefixtures("compile_quickly")


def test_a_fixed_step_on_the_sphere_shrinks_the_point_geometrically():
    """x <- x - 0.14 * 2 x, whose loss after n steps is known; the last arrival is unevaluated."""
    point = jnp.array([3.0, -4.0])
    state, trace = run(gradient(0.14), sphere, KEY, point, 10)
    np.testing.assert_allclose(trace.loss, 25 * 0.72 ** (2 * np.arange(10)), rtol=1e-5)
    np.testing.assert_allclose(state.mean, point * 0.72**10, rtol=1e-5)
    np.testing.assert_allclose(state.best.point, point * 0.72**9, rtol=1e-5)
    np.testing.assert_allclose(state.best.loss, sphere(state.best.point), rtol=1e-6)
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
    points = jnp.stack([jnp.full(5, 2.0), jnp.linspace(-1, 1, 5)])
    states, traces = jax.jit(
        lambda: run_batch(gradient(optimizer), lambda: objective, KEY, points, iterations)
    )()
    assert np.all(states.best.loss < 1e-6)
    assert np.all(np.diff(traces.best_loss, axis=1) <= 0)


def test_overshooting_never_loses_the_start():
    state, trace = run(gradient(1.5), sphere, KEY, jnp.ones(3), 10)
    assert state.best.loss == 3 and trace.loss[-1] > 1e3
    np.testing.assert_array_equal(state.best.point, jnp.ones(3))


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
def test_values_that_are_not_finite_send_it_back_to_the_best_point(optimizer, objective):
    point = jnp.array([1.0, 0.7])
    first = objective(point)
    state, trace = jax.jit(lambda: run(gradient(optimizer), objective, KEY, point, 40))()
    assert np.all(np.isfinite(state.best.point))
    if jnp.isfinite(first):
        assert state.best.loss <= first
        np.testing.assert_allclose(objective(state.best.point), state.best.loss, rtol=1e-5)
    else:
        np.testing.assert_array_equal(state.best.point, point)
    assert not np.any(np.isnan(trace.best_loss))


def test_a_step_that_fails_every_time_stays_at_the_best_point():
    def objective(x):
        return jnp.where((x[0] < -0.05) & (x[0] > -0.15), jnp.nan, x[0] ** 2)

    state, trace = run(gradient(optax.adam(2.0)), objective, KEY, jnp.array([1.9]), 6)
    np.testing.assert_allclose(trace.loss, [1.9**2, jnp.inf] * 3, rtol=1e-6)
    np.testing.assert_allclose(state.best.point, 1.9)
    np.testing.assert_allclose(state.mean, 1.9)


def test_rows_of_a_batch_are_independent():
    @jax.jit
    def refine(factors):
        def objective_of(factor):
            return lambda point: factor * ellipsoid(point)

        return run_batch(
            gradient(optax.adam(0.1)), objective_of, KEY, jnp.ones((2, 4)), 20, factors
        )

    (states, _), (disturbed, _) = refine(jnp.ones(2)), refine(jnp.array([1.0, jnp.nan]))
    jax.tree.map(lambda x, y: np.testing.assert_array_equal(x[0], y[0]), states, disturbed)


def test_one_trace_per_shape():
    traced = []

    def objective(point):
        traced.append(point.shape)
        return sphere(point)

    refine = jax.jit(lambda points: run_batch(gradient(0.1), lambda: objective, KEY, points, 5)[0])
    for seed in range(3):
        refine(jnp.full((4, 3), float(seed)))
    assert len(traced) == 2  # the start, and a step


def test_it_stops_when_the_loss_hardly_changes_many_times_in_a_row():
    point, patience = jnp.array([3.0, -4.0]), 4
    refiner = gradient(0.14, tolerance=1e-3, patience=patience)
    steps = jax.jit(lambda state: refiner.step(KEY, state, sphere))
    state, _ = refiner.init(KEY, point, sphere(point))
    losses, stops = [], []
    for _ in range(30):
        state, trace = steps(state)
        losses.append(float(trace.loss))
        stops.append(int(state.stop))
    still = np.abs(np.diff(losses, prepend=np.inf)) < 1e-3
    expected = [still[max(0, i - patience + 1) : i + 1].sum() == patience for i in range(30)]
    assert np.any(expected) and not np.all(expected)
    np.testing.assert_array_equal(stops, np.where(expected, StopReason.TOLFUNHIST, 0))


def test_without_a_tolerance_it_never_stops():
    state, _ = run(gradient(0.14), lambda x: 0 * sphere(x), KEY, jnp.ones(3), 30)
    assert state.stop == StopReason.RUNNING


def test_line_searches_count_their_evaluations():
    calls = []

    def objective(point):
        jax.debug.callback(lambda: calls.append(1))
        return rosenbrock(point)

    refiner, point = gradient(optax.lbfgs()), jnp.array([-1.0, 0.5, 2.0])
    state, _ = refiner.init(KEY, point, rosenbrock(point))
    step = jax.jit(lambda state: refiner.step(KEY, state, objective))
    for _ in range(12):
        state, trace = step(state)
    jax.effects_barrier()
    assert trace.evaluations == 1 + len(calls) > 1 + 2 * 12  # the start was known


def test_settings_choose_the_optimiser_and_its_step():
    def first_step(variant, **settings):
        refiner = build(variant, 2, RefineConfig(**settings))
        point = jnp.array([1.0, -1.0])
        state, _ = refiner.init(KEY, point, sphere(point))
        return (refiner.step(KEY, state, sphere)[0].mean - point) / jnp.array([-2.0, 2.0])

    np.testing.assert_allclose(first_step(None), STEP_SIZES["whitened"], rtol=1e-6)
    np.testing.assert_allclose(first_step(None, space="raw"), 0.14, rtol=1e-6)
    np.testing.assert_allclose(first_step("sgd", step_size=0.25), 0.25, rtol=1e-6)
    np.testing.assert_allclose(first_step("adam", step_size=0.5), 0.25, rtol=1e-4)  # 0.5 long

    np.testing.assert_allclose(first_step("polyak_sgd", step_size=0.2), 0.2, rtol=1e-6)
    np.testing.assert_allclose(first_step("sgd"), STEP_SIZES["whitened"], rtol=1e-6)


@pytest.mark.parametrize("name", ["adamm", "clip", "scale_by_madgrad", "Params", "sgd ", "_src"])
def test_names_of_no_optimiser_say_so(name):
    with pytest.raises(ValueError, match=f"no optimiser '{name}' .*adam, lbfgs"):
        build(name, 3, RefineConfig())


@pytest.mark.parametrize("name", UNUSABLE)
def test_optimisers_that_no_name_stands_for_are_refused_with_the_reason(name):
    assert name in vars(optax) | vars(optax.contrib)
    with pytest.raises(
        ValueError, match=f"gradient:{name} cannot be used: it (clips|changes|estimates) .*"
    ):
        build(name, 3, RefineConfig())


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"optimizer": -0.1}, "step_size is -0.1; give a number above 0"),
        ({"optimizer": 0.1, "tolerance": -1.0}, "tolerance is -1.0; give a number, 0 or more"),
        ({"optimizer": 0.1, "patience": 0}, "patience is 0; give a whole number, 1 or more"),
    ],
)
def test_bad_settings_say_what_to_do(settings, message):
    with pytest.raises(ValueError, match=message):
        gradient(**settings)
