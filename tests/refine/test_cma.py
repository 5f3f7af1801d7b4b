"""CMA-ES: invariances, pycma and cmaes as oracles, hostile losses, batches."""

import dataclasses
import functools

import cma as pycma
import cmaes
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from problems import ellipsoid, rastrigin, rosenbrock, run, run_batch, sphere

from jaxshape.refine.cma import ask, cma, derive_settings, start, tell
from jaxshape.refine.refiner import Candidate

KEY = jax.random.key(0)


@pytest.fixture(scope="module", autouse=True)
def quick_compilation():
    """Most of the time here is the compiler's; its optimisations are not what is tested."""
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", before)


def start_at(search, code, sigma0=0.5):
    return start(search, Candidate(code, jnp.asarray(jnp.inf)), sigma0)


def assert_sound(state):
    """Every number finite, sigma positive, the covariance symmetric positive definite."""
    numbers = state._replace(best=None, generation=None)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(numbers))
    assert np.all(np.isfinite(state.best.code))
    assert state.sigma > 0 and np.all(np.asarray(state.scales) > 0)
    covariance = np.asarray(state.covariance, np.float64)
    np.testing.assert_allclose(covariance, covariance.T, rtol=1e-3, atol=1e-5)
    assert np.linalg.eigvalsh((covariance + covariance.T) / 2)[0] > 0


# --- the algorithm, against two other implementations ---------------------------------------


@pytest.mark.parametrize(
    "dim, population, generations",
    [
        (10, 17, 40),
        (10, 64, 40),
        (100, 17, 10),
        pytest.param(100, 17, 60, marks=pytest.mark.slow),
        pytest.param(100, 256, 50, marks=pytest.mark.slow),
    ],
)
def test_follows_pycma_step_for_step(dim, population, generations):
    scale = np.logspace(0, 3, dim)
    oracle = pycma.CMAEvolutionStrategy(
        np.ones(dim), 0.5, {"popsize": population, "verbose": -9, "seed": 3}
    )
    # pycma starts from diag(exp(1e-4 i / d)), to keep its eigenvalues apart; start it from I.
    oracle.sm.C, oracle.sm.D, oracle.sm.B = np.eye(dim), np.ones(dim), np.eye(dim)

    with jax.enable_x64(True):
        search = derive_settings(dim=dim, population=population)
        state = start_at(search, jnp.ones(dim))
        next_state = jax.jit(functools.partial(tell, search))
        for _ in range(generations):
            codes = oracle.ask()
            losses = [float(np.sum(scale * x**2)) for x in codes]
            oracle.tell(codes, losses)
            state = next_state(state, jnp.asarray(np.array(codes)), jnp.asarray(losses))
            for ours, theirs in (
                (state.mean, oracle.mean),
                (state.sigma, oracle.sigma),
                (state.covariance, oracle.sm.C),
                (state.path_sigma, oracle.adapt_sigma.ps),
                (state.path_c, oracle.pc),
                (state.best.code, oracle.best.x),
            ):
                theirs = np.asarray(theirs)
                np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-10 * abs(theirs).max())
        oracle.ask()  # pycma decomposes when it samples
        np.testing.assert_allclose(state.scales, oracle.sm.D, rtol=1e-10)


@pytest.mark.parametrize("dim, population", [(1, None), (2, 64), (10, None), (100, None), (250, 6)])
def test_constants_are_those_of_pycma(dim, population):
    options = {"verbose": -9} | ({} if population is None else {"popsize": population})
    if dim == 1:  # below six candidates pycma samples mirrored pairs, which we do not
        options["CMA_mirrors"] = 0
    oracle = pycma.CMAEvolutionStrategy(np.ones(dim), 1, options)
    search = derive_settings(dim=dim, population=population)
    rates = oracle.sm.parameters()
    assert search.population == oracle.popsize
    np.testing.assert_allclose(search.weights, oracle.sp.weights.asarray, rtol=1e-12)
    np.testing.assert_allclose(
        [search.c_1, search.c_mu, search.c_c, search.c_sigma, search.damping],
        [rates["c1"], rates["cmu"], oracle.sp.cc, oracle.adapt_sigma.cs, oracle.adapt_sigma.damps],
        rtol=1e-12,
    )
    assert search.eigen_gap == max(1, np.ceil(oracle.sm.lazy_update_gap))


def test_follows_cmaes_given_its_constants():
    """cmaes implements the tutorial as printed; only its constants differ from pycma's."""
    dim, population = 8, 12
    oracle = cmaes.CMA(np.ones(dim), 0.5, population_size=population, seed=0)
    with jax.enable_x64(True):
        search = dataclasses.replace(
            derive_settings(dim=dim, population=population),
            weights=oracle._weights,
            mu_eff=oracle._mu_eff,
            c_sigma=oracle._c_sigma,
            damping=oracle._d_sigma,
            c_c=oracle._cc,
            c_1=oracle._c1,
            c_mu=oracle._cmu,
            expected_norm=oracle._chi_n,
        )
        # Where h_sigma corrects for the age of the path, cmaes counts one generation more.
        state = start_at(search, jnp.ones(dim))._replace(generation=jnp.asarray(1))
        next_state = jax.jit(functools.partial(tell, search))
        for _ in range(30):
            codes = [oracle.ask() for _ in range(population)]
            losses = [float(np.sum(np.logspace(0, 3, dim) * x**2)) for x in codes]
            oracle.tell(list(zip(codes, losses, strict=True)))
            state = next_state(state, jnp.asarray(np.array(codes)), jnp.asarray(losses))
        np.testing.assert_allclose(state.mean, oracle._mean, rtol=1e-6)
        np.testing.assert_allclose(state.sigma, oracle._sigma, rtol=1e-6)
        np.testing.assert_allclose(state.covariance, oracle._C, atol=1e-6)


# --- invariances ------------------------------------------------------------------------------


def test_covariance_searches_the_whitened_space():
    """f from N(m, C_0), with C_0 = L L^T, takes the path of f(L u) from N(L^-1 m, I)."""
    dim = 6
    with jax.enable_x64(True):
        spread = jax.random.normal(KEY, (dim, 2 * dim)) * jnp.logspace(-2, 1, dim)[:, None]
        covariance = np.asarray(spread @ spread.T)
        root = jnp.linalg.cholesky(covariance)
        code = jnp.linspace(-1, 1, dim)

        refiner, white = cma(dim=dim, sigma0=0.3, covariance=covariance), cma(dim=dim, sigma0=0.3)
        white_code = jnp.linalg.solve(root, code)
        state, trace = run(refiner, rosenbrock, KEY, code, 60)
        other, other_trace = run(white, lambda u: rosenbrock(root @ u), KEY, white_code, 60)
        np.testing.assert_allclose(trace.loss, other_trace.loss, rtol=1e-7)
        np.testing.assert_allclose(state.mean, root @ other.mean, rtol=1e-7)
        np.testing.assert_allclose(state.sigma, other.sigma, rtol=1e-7)


def test_samples_have_the_stated_mean_and_covariance():
    covariance = np.array([[4.0, 1.0], [1.0, 0.5]])
    search = derive_settings(dim=2, population=100_000, covariance=covariance)
    codes = ask(search, KEY, start_at(search, jnp.array([3.0, -1.0]), sigma0=0.1))
    np.testing.assert_allclose(codes.mean(axis=0), [3, -1], atol=3e-3)
    np.testing.assert_allclose(np.cov(codes.T), 0.01 * covariance, atol=1e-3)


def test_only_the_order_of_losses_matters_and_failures_rank_last():
    search = derive_settings(dim=3, population=6)
    state = start_at(search, jnp.zeros(3))
    codes = ask(search, KEY, state)

    next_state = jax.jit(functools.partial(tell, search))

    def mean_after(*losses):
        return np.asarray(next_state(state, codes, jnp.array(losses)).mean)

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


@functools.cache
def generations_of_given_losses():
    search = derive_settings(dim=4, population=8)

    def body(state, key_and_losses):
        key, losses = key_and_losses
        state = tell(search, state, ask(search, key, state), losses)
        return state, state.best.loss

    first = start_at(search, jnp.ones(4))
    return jax.jit(lambda keys, losses: jax.lax.scan(body, first, (keys, losses)))


@settings(max_examples=40, deadline=None)
@given(hostile_losses)
def test_any_losses_leave_a_sound_state(losses):
    losses = np.array(losses, np.float32).reshape(5, 8)
    state, best = generations_of_given_losses()(jax.random.split(KEY, 5), losses)
    assert_sound(state)
    seen = np.where(np.isfinite(losses), losses, np.inf)
    np.testing.assert_array_equal(best, np.minimum.accumulate(seen.min(axis=1)))


def test_a_flat_or_failing_objective_keeps_the_start_and_the_step_size():
    refiner, codes = cma(dim=10, sigma0=0.3), jnp.ones((32, 10))

    def objective_of(loss):
        return lambda code: 0 * code[0] + loss

    losses = jnp.where(jnp.arange(32) < 16, 0.0, jnp.nan)
    states, _ = jax.jit(lambda: run_batch(refiner, objective_of, KEY, codes, 200, losses))()
    assert np.all(states.best.code == codes)
    change = np.log(states.sigma / 0.3)
    assert np.all(np.isfinite(change)) and abs(change.mean()) < 1 and abs(change).max() < 5


@pytest.mark.parametrize("objective", [lambda code: code[0], lambda code: jnp.max(jnp.abs(code))])
def test_endless_descent_and_collapse_stay_finite(objective):
    """In few dimensions a large population moves C more than sigma: 1e38 is soon reached."""
    refiner = cma(dim=3, population=100, sigma0=1.0)
    state, _ = jax.jit(lambda: run(refiner, objective, KEY, jnp.zeros(3), 400))()
    assert_sound(state)


@pytest.mark.parametrize("scale, sigma0", [(1e12, 1e12), (1.0, 1e-12)])
def test_scales_far_from_one(scale, sigma0):
    """Also a sigma0 that vanishes beside the code, where float32 cannot tell candidates apart."""
    state, _ = jax.jit(
        lambda: run(cma(dim=5, sigma0=sigma0), sphere, KEY, jnp.full(5, scale), 300)
    )()
    assert_sound(state)
    assert state.best.loss <= sphere(jnp.full(5, scale))
    if sigma0 == scale:
        assert sphere(state.best.code / scale) < 1e-8


def test_covariance_stays_positive_definite_in_float32_over_500_generations():
    search = derive_settings(dim=10, population=10)

    def body(state, key):
        codes = ask(search, key, state)
        losses = jnp.sum(codes**2 * jnp.logspace(0, 10, 10), axis=1)
        state = tell(search, state, codes, losses)
        return state, (state.covariance, state.scales)

    keys = jax.random.split(KEY, 500)
    state, (covariances, scales) = jax.jit(
        lambda: jax.lax.scan(body, start_at(search, jnp.ones(10)), keys)
    )()
    assert_sound(state)
    assert np.all(np.linalg.eigvalsh(np.asarray(covariances, np.float64)) > 0)
    condition = (scales[:, -1] / scales[:, 0]) ** 2
    assert 1e5 < condition.max() < 2e6  # as far as float32 carries


# --- the refiner ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "objective, dim, population, iterations",
    [
        pytest.param(ellipsoid, 10, None, 400, marks=pytest.mark.slow),
        (rosenbrock, 6, None, 400),
        (rastrigin, 5, 200, 120),
    ],
)
def test_converges(objective, dim, population, iterations):
    refiner = cma(dim=dim, population=population, sigma0=1.0)
    state, trace = jax.jit(lambda: run(refiner, objective, KEY, jnp.full(dim, 2.0), iterations))()
    assert state.best.loss < 1e-8
    assert objective(state.best.code) == pytest.approx(float(state.best.loss), abs=1e-9)
    assert objective(state.mean) < 1e-6
    assert np.all(np.diff(trace.best_loss) <= 0) and np.all(trace.best_loss <= trace.loss)
    np.testing.assert_allclose(trace.spread[0], 1.0, rtol=0.3)  # sigma0
    assert trace.spread[-1] < 0.01


def test_the_start_counts():
    refiner = cma(dim=4, sigma0=10.0)  # every candidate will be worse than the start
    state, trace = run(refiner, sphere, KEY, jnp.full(4, 1e-3), 2)
    assert state.best.loss == sphere(jnp.full(4, 1e-3)) == trace.best_loss[0] < trace.loss[0]


def test_rows_of_a_batch_are_independent_and_keys_decide():
    refiner, codes = cma(dim=5, sigma0=0.5), jnp.ones((3, 5))

    @jax.jit
    def refine(key, factors):
        def objective_of(factor):
            return lambda code: factor * sphere(code)

        return run_batch(refiner, objective_of, key, codes, 30, factors)[0]

    states = refine(KEY, jnp.array([1.0, 1.0, 1.0]))
    disturbed = refine(KEY, jnp.array([1.0, jnp.nan, -1.0]))
    jax.tree.map(lambda x, y: np.testing.assert_array_equal(x[0], y[0]), states, disturbed)
    assert not np.allclose(states.mean[0], states.mean[1])
    jax.tree.map(np.testing.assert_array_equal, states, refine(KEY, jnp.ones(3)))
    assert not np.allclose(states.mean, refine(jax.random.key(1), jnp.ones(3)).mean)


def test_a_batch_gives_what_single_runs_give():
    refiner = cma(dim=8, sigma0=0.5)
    with jax.enable_x64(True):
        codes = jnp.linspace(-1, 1, 24).reshape(3, 8)
        states, _ = jax.jit(lambda: run_batch(refiner, lambda: ellipsoid, KEY, codes, 10))()
        single = jax.jit(lambda key, code: run(refiner, ellipsoid, key, code, 10)[0])
        for row, key in enumerate(jax.random.split(KEY, 3)):
            alone = single(key, codes[row])
            np.testing.assert_allclose(states.covariance[row], alone.covariance, atol=1e-9)
            np.testing.assert_allclose(states.mean[row], alone.mean, atol=1e-9)


def test_one_trace_per_shape():
    traced = []

    def objective_of(target):
        def objective(code):
            traced.append(code.shape)
            return sphere(code - target)

        return objective

    refiner = cma(dim=3, sigma0=0.5)
    refine = jax.jit(functools.partial(run_batch, refiner, objective_of), static_argnums=2)
    for seed in range(3):
        refine(jax.random.key(seed), jnp.ones((4, 3)) * seed, 5, jnp.ones((4, 3)))
    assert len(traced) == 2  # the start, and the population of a step


def test_a_batch_decomposes_only_when_due():
    """A select instead of a branch would decompose every covariance in every generation."""
    search = derive_settings(dim=100, population=17)
    assert search.eigen_gap == 2
    states = jax.vmap(functools.partial(start_at, search))(jnp.ones((4, 100)))
    jaxpr = jax.make_jaxpr(jax.vmap(functools.partial(tell, search)))(
        states, jnp.ones((4, 17, 100)), jnp.ones((4, 17))
    )
    outside = [str(eqn.primitive) for eqn in jaxpr.eqns if "eigh" in str(eqn)]
    assert outside == ["cond"]


# --- bad settings -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "changed, message",
    [
        ({"population": 2}, "give 3 or more"),
        ({"sigma0": 0.0}, "above 0"),
        ({"sigma0": float("nan")}, "above 0"),
        ({"covariance": np.eye(4)}, "symmetric 3 x 3"),
        ({"covariance": np.triu(np.ones((3, 3)))}, "symmetric 3 x 3"),
        ({"covariance": np.ones((3, 3))}, "not positive definite"),
    ],
)
def test_bad_settings_say_what_to_do(changed, message):
    with pytest.raises(ValueError, match=message):
        cma(**{"dim": 3, "sigma0": 0.3} | changed)


def test_a_code_of_another_dimension_is_refused():
    with pytest.raises(ValueError, match=r"shape \(4,\)"):
        cma(dim=3, sigma0=0.3).init(KEY, jnp.ones(4), jnp.asarray(0.0))
