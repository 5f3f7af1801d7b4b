"""IPOP and BIPOP: schedules against pycma, generations collected over iterations, batches."""

import cma as pycma
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import quick_compilation, rastrigin, sphere  # noqa: F401

from jaxshape.search.cma import cma_tell
from jaxshape.search.rates import constants
from jaxshape.search.refiner import StopReason
from jaxshape.search.restarts import with_restarts

KEY = jax.random.key(0)
DIM, SIZE, DOUBLINGS = 5, 8, 4


def watched(refiner, objective_of, iterations):
    """Compiled: a batch of searches; some of the state and the trace after every iteration."""

    def one(key, point, data):
        objective = objective_of(data)

        def body(state, key):
            running = state.stop == StopReason.RUNNING
            moved, trace = refiner.step(key, state, objective)
            state = jax.tree.map(lambda new, old: jnp.where(running, new, old), moved, state)
            unknown = jnp.all(jnp.isinf(state.losses))
            seen = state.run, state.restarts, state.stop, state.spent_small, state.spent_large
            return state, (*seen, state.best.loss, unknown, trace)

        state, _ = refiner.init(key, point, objective(point))
        return jax.lax.scan(body, state, jax.random.split(key, iterations))

    return jax.jit(jax.vmap(one))


def constant(loss):
    return lambda x: loss + 0 * x[0]


def rows_of(data):
    count = len(data)
    return jax.random.split(KEY, count), jnp.full((count, DIM), 2.0), data


# --- a population over several iterations -----------------------------------------------------


def test_collecting_iterations_is_one_generation_of_a_population_as_large():
    refiner, multiple = with_restarts("ipop", dim=DIM, sigma0=0.5, population=SIZE), 3
    with jax.enable_x64(True):
        point = jnp.linspace(1, 2, DIM)
        state, _ = refiner.init(KEY, point, sphere(point))
        state = state._replace(run=state.run._replace(multiple=jnp.int32(multiple)))
        first = state.search
        step = jax.jit(lambda key, state: refiner.step(key, state, sphere))
        for key in jax.random.split(KEY, multiple):
            jax.tree.map(np.testing.assert_array_equal, state.search, first)
            state, trace = step(key, state)
            assert state.best.loss == trace.best_loss <= trace.loss
        number = multiple * SIZE
        points, losses = state.points[:number], state.losses[:number]
        assert len(np.unique(points, axis=0)) == number
        np.testing.assert_allclose(losses, jax.vmap(sphere)(points))
        expected = jax.jit(cma_tell)(first, points, losses, constants(DIM, number))
        assert trace.evaluations == 1 + number and state.search.generation == 1
        for name in ("mean", "sigma", "covariance", "path_sigma", "path_c"):
            ours, theirs = getattr(state.search, name), getattr(expected, name)
            np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-15)


# --- schedules --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def flat():
    """Every run ends after one generation, so that only the schedule is left."""
    found = {}
    for kind in ("ipop", "bipop"):
        refiner = with_restarts(
            kind,
            dim=DIM,
            sigma0=0.5,
            population=SIZE,
            doublings=DOUBLINGS,
            restart_point=lambda key, first: first + 10 + jax.random.normal(key, first.shape),
        )
        found[kind] = watched(refiner, constant, 120)(*rows_of(jnp.zeros(16)))
    return found


def runs_of(seen, row):
    """Multiple, regime and iterations of every run of one search, in their order."""
    run, restarts, stop, *_ = (jax.tree.map(lambda x: np.asarray(x[row]), x) for x in seen)
    iterations = len(stop) if not stop.any() else np.flatnonzero(stop)[0] + 1
    begins = np.flatnonzero(np.diff(restarts[:iterations], prepend=0))
    ends = np.append(begins, iterations - 1)
    firsts = np.insert(run.multiple[begins], 0, 1), np.insert(run.is_small[begins], 0, True)
    return list(zip(*firsts, np.diff(ends, prepend=-1), strict=True))


def test_ipop_doubles_as_pycma_does_and_ends_after_the_last_doubling(flat):
    populations = []
    pycma.fmin2(
        lambda x: 0.0,
        np.full(DIM, 2.0),
        0.5,
        {"popsize": SIZE, "verbose": -9, "verb_log": 0},
        restarts=DOUBLINGS,
        callback=lambda es: populations.append(es.popsize),
    )
    states, seen = flat["ipop"]
    assert populations == [
        SIZE * multiple
        for multiple, _, iterations in runs_of(seen, 0)
        for _ in range(iterations // multiple)
    ]
    assert np.all(states.restarts == DOUBLINGS) and np.all(states.stop == StopReason.TOLFUN)
    assert np.all(states.reason == StopReason.TOLFUN)


def test_bipop_spends_half_of_its_evaluations_on_small_runs(flat):
    states, seen = flat["bipop"]
    sizes = set()
    for row in range(16):
        runs = runs_of(seen, row)
        small = large = 0
        largest = 1
        for multiple, is_small, iterations in runs:
            if is_small:
                assert multiple <= largest and small <= max(large, 1)
                assert large == 0 or iterations <= max(1, large // 2)
                small += iterations
                sizes.add(multiple)
            else:
                assert multiple == 2 * largest and small >= large
                largest = multiple
                large += iterations
        assert largest == 2**DOUBLINGS and not runs[-1][1]
        before = large - runs[-1][2]  # the last large run is not made up for
        assert before <= small <= 1.5 * before + 2
    assert len(sizes) > 3  # of all kinds between
    assert np.all(states.restarts >= 2 * DOUBLINGS - 1)


def test_a_restart_forgets_the_candidates_of_the_run_before(flat):
    """They would be among the best of a smaller population."""
    for _, seen in flat.values():
        restarts, unknown = np.asarray(seen[1]), np.asarray(seen[6])
        began = np.diff(restarts, prepend=0) > 0
        assert began.any() and np.all(unknown[began])


def test_the_capacity_is_never_exceeded(flat):
    for states, seen in flat.values():
        assert states.points.shape == (16, SIZE * 2**DOUBLINGS, DIM)
        assert np.asarray(seen[0].multiple).max() <= 2**DOUBLINGS


# --- searches ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def multimodal():
    refiner = with_restarts("ipop", dim=DIM, sigma0=2.0, population=SIZE, doublings=5)

    def objective_of(disturbed):
        return lambda x: jnp.where(disturbed, sphere(x), rastrigin(x))

    search = watched(refiner, objective_of, 4000)
    return [search(*rows_of(disturbed)) for disturbed in (jnp.zeros(8, bool), jnp.arange(8) >= 4)]


@pytest.mark.slow
def test_solves_rastrigin_where_one_run_does_not(multimodal):
    (states, seen), _ = multimodal
    restarts, best = np.asarray(seen[1]), np.asarray(seen[5])
    after_one_run = best[np.arange(8), (restarts == 0).sum(axis=1)]
    assert np.sum(after_one_run < 1e-5) <= 2
    assert np.sum(states.best.loss < 1e-5) >= 6


@pytest.mark.slow
def test_objects_restart_on_their_own(multimodal):
    (states, seen), (others, _) = multimodal
    restarts = np.asarray(seen[1])
    assert len({tuple(np.flatnonzero(np.diff(row))) for row in restarts}) == 8
    jax.tree.map(lambda x, y: np.testing.assert_array_equal(x[:4], y[:4]), states, others)


@pytest.mark.slow
def test_the_best_survives_restarts(multimodal):
    (states, seen), _ = multimodal
    best, trace = np.asarray(seen[5]), seen[-1]
    assert np.all(np.diff(best) <= 0)
    np.testing.assert_array_equal(best, trace.best_loss)
    lowest = np.minimum.accumulate(np.asarray(trace.loss), axis=1)
    np.testing.assert_array_equal(best, np.minimum(lowest, float(rastrigin(jnp.full(DIM, 2.0)))))
    found = jax.vmap(rastrigin)(states.best.point)
    np.testing.assert_allclose(found, states.best.loss, atol=1e-5)


def test_a_restart_may_draw_its_own_first_point(flat):
    for states, _ in flat.values():
        assert np.all(states.mean > 8) and len(np.unique(states.mean, axis=0)) == 16


def test_bad_settings_say_what_to_do(unchecked_types):
    with pytest.raises(ValueError, match="kind is 'ipop '; give 'ipop' or 'bipop'"):
        with_restarts("ipop ", dim=3, sigma0=0.3)
    with pytest.raises(ValueError, match="doublings is -1; give a whole number, 0 or more"):
        with_restarts("ipop", dim=3, sigma0=0.3, doublings=-1)
    with pytest.raises(ValueError, match="population is 2"):
        with_restarts("ipop", dim=3, sigma0=0.3, population=2)
