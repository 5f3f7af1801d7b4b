"""CMA-ES: pycma and cmaes as oracles, invariances, hostile losses, batches."""

import functools

import cma as pycma
import cmaes
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from problems import (  # noqa: F401
    NEVER,
    quick_compilation,
    rastrigin,
    rosenbrock,
    run_batch,
    sphere,
)

from jaxshape.search import stopping
from jaxshape.search.cma import cma_ask, cma_start, cma_tell
from jaxshape.search.methods.cma import cma
from jaxshape.search.rates import constants, default_population
from jaxshape.search.refiner import StopReason
from jaxshape.search.stopping import Tolerances

KEY = jax.random.key(0)


def start_at(point, sigma0=0.5, population=8):
    return cma_start(point, sigma0, population=population)


def assert_sound(state):
    """Every number finite, sigma positive, the covariance symmetric positive definite."""
    numbers = state._replace(best=None, history=None)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(numbers))
    assert np.all(np.isfinite(state.best.point))
    assert state.sigma > 0 and np.all(np.asarray(state.scales) > 0)
    covariance = np.asarray(state.covariance, np.float64)
    np.testing.assert_allclose(covariance, covariance.T, rtol=1e-3, atol=1e-5)
    assert np.linalg.eigvalsh((covariance + covariance.T) / 2)[0] > 0


# --- the algorithm, against two other implementations ---------------------------------------


GENERATIONS = 50


@functools.cache
def pycma_run(dim, population, seed=3):
    """The generations of a run of pycma on an ellipsoid, and its state after each."""
    scale = np.logspace(0, 3, dim)
    oracle = pycma.CMAEvolutionStrategy(
        np.ones(dim), 0.5, {"popsize": population, "verbose": -9, "seed": seed}
    )
    # pycma starts from diag(exp(1e-4 i / d)), to keep its eigenvalues apart; start it from I.
    oracle.sm.C, oracle.sm.D, oracle.sm.B = np.eye(dim), np.ones(dim), np.eye(dim)
    given, states = [], []
    for _ in range(GENERATIONS):
        points = np.array(oracle.ask())
        losses = (scale * points**2).sum(axis=1)
        oracle.tell(list(points), list(losses))
        given.append((points, losses))
        numbers = oracle.mean, oracle.sigma, oracle.sm.C, oracle.adapt_sigma.ps, oracle.pc
        states.append([np.array(x) for x in (*numbers, oracle.best.x)])
    oracle.ask()  # pycma decomposes when it samples
    return [np.array(x) for x in zip(*given, strict=True)], states, oracle.sm.D


def told(points, losses, rates=None):
    """What `tell` makes of those generations, after each."""

    def body(state, generation):
        state = cma_tell(state, *generation, rates)
        numbers = state.mean, state.sigma, state.covariance, state.path_sigma, state.path_c
        return state, (*numbers, state.best.point, state.scales)

    first = start_at(jnp.ones_like(points[0, 0]), population=points.shape[1])
    return jax.lax.scan(body, first, (points, losses))[1]


@pytest.mark.parametrize("dim", [10, 100])
@pytest.mark.parametrize("population", [17, 64, 256])
def test_follows_pycma_step_for_step(dim, population):
    given, expected, scales = pycma_run(dim, population)
    with jax.enable_x64(True):
        *found, found_scales = jax.jit(told)(*given)
    for generation in range(GENERATIONS):
        for ours, theirs in zip(found, expected[generation], strict=True):
            limit = 1e-10 * np.abs(theirs).max()
            np.testing.assert_allclose(ours[generation], theirs, rtol=0, atol=limit)
    np.testing.assert_allclose(found_scales[-1], scales, rtol=1e-10)


def test_follows_pycma_in_a_batch_of_float32():
    runs = [pycma_run(10, 17, seed) for seed in (3, 4)]
    points, losses = (np.stack([run[0][i] for run in runs]).astype(np.float32) for i in range(2))
    found = jax.jit(jax.vmap(told))(points, losses)
    for row, (_, expected, scales) in enumerate(runs):
        for ours, theirs in zip(found, [*expected[-1], scales], strict=True):
            assert ours.dtype == jnp.float32
            limit = 2e-3 * np.abs(theirs).max()
            np.testing.assert_allclose(ours[row, -1], theirs, rtol=0, atol=limit)


@pytest.mark.parametrize("dim, population", [(1, None), (2, 64), (10, None), (100, None), (250, 6)])
def test_constants_are_those_of_pycma(dim, population):
    options = {"verbose": -9} | ({} if population is None else {"popsize": population})
    if dim == 1:  # below six candidates pycma samples mirrored pairs, which we do not
        options["CMA_mirrors"] = 0
    oracle = pycma.CMAEvolutionStrategy(np.ones(dim), 1, options)
    rates = oracle.sm.parameters()
    assert (population or default_population(dim)) == oracle.popsize
    with jax.enable_x64(True):
        c = jax.jit(lambda: constants(dim, oracle.popsize))()
    np.testing.assert_allclose(c.weights, oracle.sp.weights.asarray, rtol=1e-12)
    np.testing.assert_allclose(
        [c.c_1, c.c_mu, c.c_c, c.c_sigma, c.damping],
        [rates["c1"], rates["cmu"], oracle.sp.cc, oracle.adapt_sigma.cs, oracle.adapt_sigma.damps],
        rtol=1e-12,
    )
    assert c.eigen_gap == max(1, np.ceil(oracle.sm.lazy_update_gap))


def test_constants_of_a_traced_population_are_those_of_a_static_one():
    capacity, populations = 64, [3, 17, 64]
    traced = jax.jit(jax.vmap(lambda population: constants(10, population, capacity)))
    for x in traced(jnp.array(populations)):
        assert np.all(np.isfinite(x))
    with jax.enable_x64(True):
        found = traced(jnp.array(populations, jnp.int32))
        for row, population in enumerate(populations):
            expected = jax.jit(functools.partial(constants, 10, population))()
            weights = np.pad(expected.weights, (0, capacity - population))
            expected = expected._replace(weights=weights)
            for ours, theirs in zip(found, expected, strict=True):
                np.testing.assert_allclose(ours[row], theirs, rtol=1e-13, atol=1e-16)


def test_rows_behind_the_population_do_not_count():
    """They rank last for their infinite loss, and their weight is 0."""
    (points, losses), expected, _ = pycma_run(10, 17)
    behind = np.full((GENERATIONS, 15, 10), 1e3)
    with jax.enable_x64(True):
        *found, _ = jax.jit(told)(
            np.concatenate([points, behind], axis=1),
            np.pad(losses, [(0, 0), (0, 15)], constant_values=np.inf),
            constants(10, jnp.int32(17), 32),
        )
    for ours, theirs in zip(found, expected[-1], strict=True):
        np.testing.assert_allclose(ours[-1], theirs, rtol=0, atol=1e-10 * np.abs(theirs).max())


def test_follows_cmaes_given_its_constants():
    """cmaes implements the tutorial as printed; only its constants differ from pycma's."""
    dim, population = 8, 12
    oracle = cmaes.CMA(np.ones(dim), 0.5, population_size=population, seed=0)
    with jax.enable_x64(True):
        rates = constants(dim, population)._replace(
            weights=jnp.asarray(oracle._weights),
            mu_eff=oracle._mu_eff,
            c_sigma=oracle._c_sigma,
            damping=oracle._d_sigma,
            c_c=oracle._cc,
            c_1=oracle._c1,
            c_mu=oracle._cmu,
        )
        # Where h_sigma corrects for the age of the path, cmaes counts one generation more.
        state = start_at(jnp.ones(dim))._replace(generation=jnp.int32(1))
        next_state = jax.jit(cma_tell)
        for _ in range(30):
            points = [oracle.ask() for _ in range(population)]
            losses = [float(np.sum(np.logspace(0, 3, dim) * x**2)) for x in points]
            oracle.tell(list(zip(points, losses, strict=True)))
            state = next_state(state, jnp.asarray(np.array(points)), jnp.asarray(losses), rates)
        # The length that is expected of a step is rounded in cmaes: 1 - 1 / 4d + 1 / 21 d^2.
        np.testing.assert_allclose(state.mean, oracle._mean, rtol=1e-3)
        np.testing.assert_allclose(state.sigma, oracle._sigma, rtol=1e-3)
        np.testing.assert_allclose(state.covariance, oracle._C, atol=1e-3)


# --- invariances ------------------------------------------------------------------------------


def test_samples_have_the_stated_mean_and_covariance():
    covariance = np.array([[4.0, 1.0], [1.0, 0.5]], np.float32)
    values, basis = np.linalg.eigh(covariance)
    state = start_at(jnp.array([3.0, -1.0]), sigma0=0.1)
    points = cma_ask(KEY, state._replace(basis=basis, scales=np.sqrt(values)), 100_000)
    np.testing.assert_allclose(points.mean(axis=0), [3, -1], atol=3e-3)
    np.testing.assert_allclose(np.cov(points.T), 0.01 * covariance, atol=1e-3)


def test_the_search_does_not_depend_on_shift_rotation_and_scale():
    """f(x) from N(m, s^2 I) takes the path of f(s Q u + m) from N(0, I)."""
    dim, scale = 6, 0.3
    with jax.enable_x64(True):
        shift = jnp.linspace(-1, 1, dim)
        rotation = jnp.linalg.qr(jax.random.normal(KEY, (dim, dim)))[0]
        states = jax.vmap(lambda m: start_at(m, population=9))(jnp.stack([shift, 0 * shift]))
        states = states._replace(sigma=jnp.array([scale, 1.0]))

        def body(states, key):
            units = cma_ask(key, jax.tree.map(lambda x: x[1], states), 9)
            points = scale * units @ rotation.T + shift
            losses = jax.vmap(rosenbrock)(points)
            both = jax.vmap(cma_tell, (0, 0, None, None))(
                states, jnp.stack([points, units]), losses, constants(dim, 9)
            )
            return both, None

        states, _ = jax.jit(lambda s: jax.lax.scan(body, s, jax.random.split(KEY, 60)))(states)
        mean = scale * rotation @ states.mean[1] + shift
        np.testing.assert_allclose(states.mean[0], mean, rtol=1e-7)
        np.testing.assert_allclose(states.sigma[0], scale * states.sigma[1], rtol=1e-7)
        turned = rotation @ states.covariance[1] @ rotation.T
        np.testing.assert_allclose(states.covariance[0], turned, rtol=1e-7, atol=1e-9)


def test_only_the_order_of_losses_matters_and_failures_rank_last():
    state = start_at(jnp.zeros(3))
    points = cma_ask(KEY, state, 6)
    next_state = jax.jit(cma_tell)

    def mean_after(*losses):
        return np.asarray(next_state(state, points, jnp.array(losses), constants(3, 6)).mean)

    expected = mean_after(2.0, 1.0, 3.0, 4.0, 5.0, 6.0)
    for same_order in (
        (2e30, -1e30, 3e30, 4e30, 5e30, 6e30),
        (2e-30, 1e-30, 3e-30, 4e-30, 5e-30, 6e-30),
        (2.0, 1.0, 3.0, jnp.nan, jnp.inf, -jnp.inf),
        (2.0, 1.0, 3.0, 3.0, 3.0, 3.0),  # ties keep the order of the candidates
    ):
        np.testing.assert_array_equal(mean_after(*same_order), expected)
    assert not np.allclose(mean_after(1.0, 2.0, 3.0, 4.0, 5.0, 6.0), expected)


# --- hostile objectives -----------------------------------------------------------------------

hostile_losses = st.lists(
    st.one_of(
        st.sampled_from([0.0, 1.0, float("nan"), float("inf"), float("-inf"), 3e38, -3e38]),
        st.floats(width=32, allow_subnormal=False),  # XLA flushes those to zero
    ),
    min_size=40,
    max_size=40,
)


ROWS = 3


@functools.cache
def generations_of_given_losses(population):
    """Compiled: a batch of searches over as many generations as losses are given."""

    def body(state, key_and_losses):
        key, losses = key_and_losses
        state = cma_tell(state, cma_ask(key, state, population), losses, constants(4, population))
        state = stopping.check(state, losses, 0.5, population, Tolerances())
        return state, state.best.loss

    first = start_at(jnp.ones(4), population=population)
    return jax.jit(jax.vmap(lambda keys, losses: jax.lax.scan(body, first, (keys, losses))))


@pytest.mark.parametrize("population", [3, 8])
@settings(max_examples=30, deadline=None)
@given(losses=hostile_losses)
def test_any_losses_leave_a_sound_state_and_the_other_rows_alone(population, losses):
    losses = np.array(losses[: 5 * population], np.float32).reshape(5, population)
    calm = np.arange(5 * population, dtype=np.float32).reshape(5, population)
    keys = jax.random.split(KEY, (ROWS, 5))
    states, best = generations_of_given_losses(population)(keys, np.stack([calm, losses, calm]))
    assert_sound(jax.tree.map(lambda x: x[1], states))
    assert not any(np.any(np.isnan(x)) for x in jax.tree.leaves(states.history))
    seen = np.where(np.isfinite(losses), losses, np.inf)
    np.testing.assert_array_equal(best[1], np.minimum.accumulate(seen.min(axis=1)))

    undisturbed, _ = generations_of_given_losses(population)(keys, np.stack([calm] * ROWS))
    jax.tree.map(lambda x, y: np.testing.assert_array_equal(x[::2], y[::2]), states, undisturbed)


def test_the_smallest_population_finds_a_minimum():
    refiner = cma(dim=2, sigma0=0.5, population=3)
    states, _ = jax.jit(
        lambda: run_batch(refiner, lambda: sphere, KEY, jnp.full((8, 2), 2.0), 400)
    )()
    assert np.median(states.best.loss) < 1e-8


def test_a_flat_or_failing_objective_keeps_the_start_and_the_step_size():
    refiner, points = cma(dim=10, sigma0=0.3, tolerances=NEVER), jnp.ones((32, 10))

    def objective_of(loss):
        return lambda code: 0 * code[0] + loss

    losses = jnp.where(jnp.arange(32) < 16, 0.0, jnp.nan)
    states, _ = jax.jit(lambda: run_batch(refiner, objective_of, KEY, points, 200, losses))()
    assert np.all(states.best.point == points)
    change = np.log(states.sigma / 0.3)
    assert np.all(np.isfinite(change)) and abs(change.mean()) < 1 and abs(change).max() < 5


def test_endless_descent_and_collapse_stay_finite():
    """In few dimensions a large population moves C more than sigma: 1e38 is soon reached."""
    refiner = cma(dim=3, population=100, sigma0=1.0, tolerances=NEVER)

    def objective_of(falls):
        return lambda x: jnp.where(falls, x[0], jnp.max(jnp.abs(x)))

    falls = jnp.array([True, False])
    states, _ = jax.jit(
        lambda: run_batch(refiner, objective_of, KEY, jnp.zeros((2, 3)), 400, falls)
    )()
    for row in range(2):
        assert_sound(jax.tree.map(lambda x, row=row: x[row], states))


def test_scales_far_from_one():
    """Also a sigma0 that vanishes beside the point: float32 cannot tell candidates apart."""
    refiner = cma(dim=5, sigma0=1.0, tolerances=NEVER)
    points = jnp.array([1e12, 1.0])[:, None] * jnp.ones((2, 5))

    def search(key, point, sigma0):
        state, _ = refiner.init(key, point, sphere(point))
        return jax.lax.scan(
            lambda state, key: (refiner.step(key, state, sphere)[0], None),
            state._replace(sigma=sigma0),
            jax.random.split(key, 300),
        )[0]

    keys = jax.random.split(KEY, 2)
    states = jax.jit(jax.vmap(search))(keys, points, jnp.array([1e12, 1e-12]))
    for row in range(2):
        assert_sound(jax.tree.map(lambda x, row=row: x[row], states))
        assert states.best.loss[row] <= sphere(points[row])
    assert sphere(states.best.point[0] / 1e12) < 1e-8


def test_covariance_stays_positive_definite_in_float32_over_500_generations():

    def body(state, key):
        points = cma_ask(key, state, 10)
        losses = jnp.sum(points**2 * jnp.logspace(0, 10, 10), axis=1)
        state = cma_tell(state, points, losses, constants(10, 10))
        return state, (state.covariance, state.scales)

    keys = jax.random.split(KEY, 500)
    state, (covariances, scales) = jax.jit(
        lambda: jax.lax.scan(body, start_at(jnp.ones(10)), keys)
    )()
    assert_sound(state)
    assert np.all(np.linalg.eigvalsh(np.asarray(covariances, np.float64)) > 0)
    condition = (scales[:, -1] / scales[:, 0]) ** 2
    assert 1e5 < condition.max() < 2e6  # as far as float32 carries


# --- the refiner ------------------------------------------------------------------------------


def test_converges():
    refiner = cma(dim=5, population=200, sigma0=1.0, tolerances=NEVER)
    objectives = [rosenbrock, rastrigin]

    def objective_of(which):
        return lambda x: jax.lax.switch(which, objectives, x)

    states, traces = jax.jit(
        lambda: run_batch(refiner, objective_of, KEY, jnp.full((2, 5), 2.0), 300, jnp.arange(2))
    )()
    for row, objective in enumerate(objectives):
        best = jax.tree.map(lambda x, row=row: x[row], states.best)
        assert best.loss < 1e-8
        assert objective(best.point) == pytest.approx(float(best.loss), abs=1e-9)
        assert objective(states.mean[row]) < 1e-6
    assert np.all(np.diff(traces.best_loss) <= 0) and np.all(traces.best_loss <= traces.loss)
    np.testing.assert_allclose(traces.spread[:, 0], 1.0, rtol=0.3)  # sigma0
    assert np.all(traces.spread[:, -1] < 0.01)


DIM, ROW_COUNT = 5, 3


@pytest.fixture(scope="module")
def traced():
    """Calls of the objective while a program was traced."""
    return []


@pytest.fixture(scope="module")
def refine(traced):
    refiner = cma(dim=DIM, sigma0=0.5)

    def objective_of(factor):
        def objective(x):
            traced.append(x.shape)
            return factor * sphere(x)

        return objective

    return jax.jit(
        lambda key, points, factors: run_batch(refiner, objective_of, key, points, 30, factors)
    )


POINTS, ONES = jnp.ones((ROW_COUNT, DIM)), jnp.ones(ROW_COUNT)


def test_the_start_counts(refine):
    states, traces = refine(KEY, 0 * POINTS, ONES)  # every candidate will be worse
    assert np.all(states.best.loss == 0) and np.all(states.best.point == 0)
    assert np.all(traces.best_loss == 0) and np.all(traces.loss > 0)
    population = default_population(DIM)
    np.testing.assert_array_equal(traces.evaluations[0, :3], 1 + population * np.arange(1, 4))


def test_rows_of_a_batch_are_independent_and_keys_decide(refine):
    states, _ = refine(KEY, POINTS, ONES)
    disturbed, _ = refine(KEY, POINTS, jnp.array([1.0, jnp.nan, -1.0]))
    jax.tree.map(lambda x, y: np.testing.assert_array_equal(x[0], y[0]), states, disturbed)
    assert not np.allclose(states.mean[0], states.mean[1])
    jax.tree.map(np.testing.assert_array_equal, states, refine(KEY, POINTS, ONES)[0])
    assert not np.allclose(states.mean, refine(jax.random.key(1), POINTS, ONES)[0].mean)


def test_one_trace_per_shape(refine, traced):
    for seed in range(3):
        refine(jax.random.key(seed), POINTS * seed, ONES)
    assert len(traced) == 2  # the start, and the population of a step


def test_a_search_goes_on_from_an_earlier_one_when_its_objective_changes(refine):
    refiner = cma(dim=DIM, sigma0=0.5)
    before = jax.tree.map(lambda x: x[0], refine(KEY, POINTS, ONES)[0])
    state, trace = refiner.resume(KEY, before, jnp.asarray(7.0))
    for name in ("mean", "sigma", "covariance", "basis", "scales"):
        np.testing.assert_array_equal(getattr(state, name), getattr(before, name))
    np.testing.assert_array_equal(state.best.point, before.best.point)
    assert state.best.loss == trace.best_loss == 7  # that of the new objective
    assert state.stop == StopReason.RUNNING and trace.evaluations == 1
    fresh, _ = refiner.init(KEY, before.best.point, jnp.asarray(7.0))
    jax.tree.map(np.testing.assert_array_equal, state.history, fresh.history)


def test_a_batch_decomposes_only_when_due():
    """A select instead of a branch would decompose every covariance in every generation."""
    rates = constants(100, 17)
    assert rates.eigen_gap == 2
    states = jax.vmap(start_at)(jnp.ones((4, 100)))
    jaxpr = jax.make_jaxpr(jax.vmap(lambda *given: cma_tell(*given, rates)))(
        states, jnp.ones((4, 17, 100)), jnp.ones((4, 17))
    )

    def where(jaxpr):
        return [eqn for eqn in jaxpr.eqns if "eigh" in str(eqn)]

    (branch,) = where(jaxpr)
    assert branch.primitive.name == "custom_vmap_call"
    assert [eqn.primitive.name for eqn in where(branch.params["call"])] == ["cond"]


# --- bad settings -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "changed, message",
    [
        ({"population": 1}, "population is 1; give a whole number, 3 or more"),
        ({"population": 2.5}, "population is 2.5; give a whole number, 3 or more"),
        ({"sigma0": 0.0}, "sigma0 is 0.0; give a number above 0"),
        ({"sigma0": float("nan")}, "above 0"),
        ({"dim": 0}, "dim is 0; give a whole number, 1 or more"),
    ],
)
def test_bad_settings_say_what_to_do(unchecked_types, changed, message):
    with pytest.raises(ValueError, match=message):
        cma(**{"dim": 3, "sigma0": 0.3} | changed)


def test_a_code_of_another_dimension_is_refused():
    with pytest.raises(ValueError, match=r"shape \(4,\)"):
        cma(dim=3, sigma0=0.3).init(KEY, jnp.ones(4), jnp.asarray(0.0))
