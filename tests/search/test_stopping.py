"""Stop criteria: against pycma, generation by generation, and what stopping costs."""

import functools

import cma as pycma
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import (  # noqa: F401
    NEVER,
    ellipsoid,
    quick_compilation,
    rosenbrock,
    run_batch,
    sphere,
)

from jaxshape.search import stopping
from jaxshape.search.cma import cma_start, cma_tell
from jaxshape.search.methods.cma import cma
from jaxshape.search.rates import constants
from jaxshape.search.refiner import StopReason, advance
from jaxshape.search.stopping import Tolerances

KEY = jax.random.key(0)
# --- against pycma ----------------------------------------------------------------------------

DIM, POPULATION, GENERATIONS = 3, 7, 900
LOOSE = {"tolupsigma": 20.0, "tolfacupx": np.inf, "tolconditioncov": 1e4}


def as_ranked(losses, rng):
    """Losses of which only the best one means something: it is 0."""
    return np.where(losses == losses.min(), 0, 1 + rng.random(len(losses)))


# What pycma is to see: name, losses of points, first number of each coordinate, sigma0.
CASES = {
    "tolfun": (lambda x, rng: (x**2).sum(1), 1.0, 0.5),
    "tolfunhist": (lambda x, rng: as_ranked((x**2).sum(1), rng), 1.0, 0.5),
    "tolx": (lambda x, rng: 1e15 * (x**2).sum(1), 1.0, 0.5),
    "tolflatfitness": (lambda x, rng: np.where(np.arange(len(x)) == 4, 2.0, 1.0), 1.0, 0.5),
    "tolfacupx": (lambda x, rng: x[:, 0], 1.0, 1e-3),
    "tolxstagnation": (lambda x, rng: rng.random(len(x)), 0.0, 1e-10),
    "tolstagnation": (lambda x, rng: rng.random(len(x)), 1.0, 0.5),
    "noeffect": (lambda x, rng: rng.random(len(x)), 1e9, 1e-8),
    "tolconditioncov": (lambda x, rng: (x**2 * [1, 1e3, 1e6]).sum(1), 1.0, 0.5),
    "tolupsigma": (lambda x, rng: x.sum(1), 1.0, 0.5),
}


def pycma_until_it_stops(losses_of, first, sigma0, options):
    """The generations of a run of pycma, and the criteria that ended it."""
    rng = np.random.default_rng(4)
    oracle = pycma.CMAEvolutionStrategy(
        np.full(DIM, first),
        sigma0,
        {"popsize": POPULATION, "verbose": -9, "seed": 5} | options,
    )
    oracle.sm.C, oracle.sm.D, oracle.sm.B = np.eye(DIM), np.ones(DIM), np.eye(DIM)
    generations = []
    while not oracle.stop() and len(generations) < GENERATIONS:
        points = np.array(oracle.ask())
        losses = losses_of(points, rng)
        oracle.tell(list(points), list(losses))
        oracle.sm.update_now()  # pycma's own time for this is the next sample
        oracle._updateBDfromSM()
        generations.append((points, losses))
    return generations, set(oracle.stop())


@functools.cache
def stops(tolerances):
    """Compiled: the stop reason of every generation that is given, as if none had stopped."""

    def reasons(first, sigma0, points, losses):
        rates = constants(DIM, POPULATION)

        def body(state, generation):
            state = cma_tell(state, *generation, rates)
            state = stopping.check(state, generation[1], sigma0, POPULATION, tolerances)
            return state, state.stop

        state = cma_start(first, sigma0, population=POPULATION)
        return jax.lax.scan(body, state, (points, losses))[1]

    return jax.jit(reasons)


@pytest.mark.parametrize("name", CASES)
def test_stops_where_pycma_stops_and_for_the_same_reason(name):
    losses_of, first, sigma0 = CASES[name]
    options = LOOSE if name in ("tolupsigma", "tolconditioncov") else {}
    generations, expected = pycma_until_it_stops(losses_of, first, sigma0, options)
    assert any(reason.startswith(name) for reason in expected), expected

    padding = [generations[-1]] * (GENERATIONS - len(generations))  # one length compiles once
    points, losses = (np.array(x) for x in zip(*generations, *padding, strict=True))
    with jax.enable_x64(True):
        reasons = stops(Tolerances(**options))(
            jnp.full(DIM, first), jnp.asarray(sigma0), points, losses
        )
    reasons = np.asarray(reasons)[: len(generations)]
    np.testing.assert_array_equal(np.flatnonzero(reasons), [len(generations) - 1])
    reason = StopReason(reasons[-1]).name.lower()
    assert any(theirs.startswith(reason) for theirs in expected), (reason, expected)


# --- what is ours -----------------------------------------------------------------------------


def test_losses_within_their_rounding_are_equal():
    """In float32 an absolute tolfun would never be met by losses near 1."""
    refiner = cma(dim=3, sigma0=0.5, tolerances=Tolerances(tolx=0.0, tolflatfitness=np.inf))
    states, _ = jax.jit(
        lambda: run_batch(refiner, lambda: lambda x: 1e3 + sphere(x), KEY, jnp.ones((4, 3)), 150)
    )()
    assert set(np.asarray(states.stop)) <= {StopReason.TOLFUN, StopReason.TOLFUNHIST}


def test_a_tolerance_of_zero_or_infinity_turns_its_criterion_off():
    refiner, losses = cma(dim=3, sigma0=1e-12, tolerances=NEVER), jnp.array([0, jnp.nan, jnp.inf])

    def objective_of(loss):
        return lambda x: loss + 0 * x[0]

    states, _ = jax.jit(
        lambda: run_batch(refiner, objective_of, KEY, jnp.ones((3, 3)), 60, losses)
    )()
    assert np.all(states.stop == StopReason.RUNNING) and np.all(states.generation == 60)


FUNCTIONS = [sphere, ellipsoid, rosenbrock]


@functools.cache
def searches(tolerances):
    """State and trace of every iteration of six searches: three functions, from far and near."""
    refiner = cma(dim=4, sigma0=0.5, tolerances=tolerances)

    def one(key, code, which):
        def objective(x):
            return 1 + jax.lax.switch(which, FUNCTIONS, x)

        def body(now, key):
            now = advance(refiner, key, *now, objective)
            return now, now

        started = refiner.init(key, code, objective(code))
        return jax.lax.scan(body, started, jax.random.split(key, 350))[1]

    which = jnp.arange(6) % 3
    codes = jnp.where(jnp.arange(6)[:, None] < 3, 3.0, 1.1) * jnp.ones((6, 4))
    return jax.jit(jax.vmap(one))(jax.random.split(KEY, 6), codes, which)


def test_a_finished_search_is_frozen_while_others_go_on():
    states, traces = searches(Tolerances())
    ends = np.array([np.flatnonzero(stop)[0] for stop in np.asarray(states.stop)])
    assert len(set(ends)) > 3  # they end at times of their own
    for row, end in enumerate(ends):
        assert states.generation[row, -1] == end + 1
        for x in jax.tree.leaves((states, traces)):
            x = np.asarray(x[row, end:])
            np.testing.assert_array_equal(x, np.broadcast_to(x[:1], x.shape))


def test_stopping_costs_no_quality():
    (stopped, _), (endless, _) = searches(Tolerances()), searches(NEVER)
    assert np.all(endless.generation[:, -1] == 350)
    assert stopped.generation[:, -1].sum() < 0.8 * 6 * 350
    np.testing.assert_allclose(
        stopped.best.loss[:, -1], endless.best.loss[:, -1], rtol=4 * np.finfo(np.float32).eps
    )


@pytest.mark.parametrize(
    "changed, message",
    [
        ({"tolfun": -1e-9}, "tolfun is -1e-09; give a number from 0 to inf"),
        ({"tolupsigma": float("nan")}, "tolupsigma is nan; give a number from 0"),
        ({"noeffect": "no"}, "noeffect is 'no'; give True or False"),
    ],
)
def test_thresholds_outside_their_range_are_refused(unchecked_types, changed, message):
    with pytest.raises(ValueError, match=message):
        Tolerances(**changed)
