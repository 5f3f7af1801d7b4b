"""evosax strategies behind the refiner interface."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from problems import run_batch, sphere

from jaxshape.search.config import RefineConfig
from jaxshape.search.methods.evosax import build, evosax_strategy

KEY = jax.random.key(0)
pytestmark = pytest.mark.usefixtures("compile_quickly")
SETTINGS = {"Open_ES": {"optimizer": optax.adam(0.1)}}


@pytest.mark.parametrize("name", ["Sep_CMA_ES", "SNES", "Open_ES"])
def test_converges_and_starts_at_sigma0(name):
    refiner = evosax_strategy(name, dim=6, population=20, sigma0=0.3, **SETTINGS.get(name, {}))
    points = jnp.linspace(0.5, 1.5, 12).reshape(2, 6)
    states, traces = jax.jit(lambda: run_batch(refiner, lambda: sphere, KEY, points, 150))()
    starts = jax.vmap(sphere)(points)
    assert np.all(states.best.loss < 0.02 * starts)
    assert np.all(jax.vmap(sphere)(states.mean) < 0.1 * starts)
    np.testing.assert_allclose(jax.vmap(sphere)(states.best.point), states.best.loss, rtol=1e-5)
    assert np.all(np.diff(traces.best_loss, axis=1) <= 0)
    np.testing.assert_allclose(traces.spread[:, 0], 0.3, rtol=0.35)


def test_failures_never_reach_the_strategy_and_the_start_counts():
    refiner = evosax_strategy("SNES", dim=3, population=10, sigma0=0.3)

    def objective_of(failure):
        return lambda point: jnp.where(point[0] > 0, failure, sphere(point))

    points = jnp.array([[-1.0, 1.0, 1.0], [-1.0, 1.0, 1.0], [1.0, 1.0, 1.0], [-1e-9, 0.0, 0.0]])
    failures = jnp.array([jnp.nan, jnp.inf, jnp.nan, jnp.nan])
    states, traces = run_batch(refiner, objective_of, KEY, points, 60, failures)
    assert np.all(np.isfinite(states.mean))
    assert np.all(states.best.loss[:2] < 0.1)
    assert traces.best_loss[3, 0] == sphere(points[3])  # no candidate beats this start


def first_spend(refiner):
    """Candidates of one iteration."""
    state, _ = refiner.init(KEY, jnp.ones(3), jnp.float32(3.0))
    points = []
    _, trace = refiner.step(KEY, state, lambda point: points.append(point) or sphere(point))
    assert len(points) == 1  # traced once
    return int(trace.evaluations) - 1


@pytest.mark.parametrize(
    "variant, population",
    [("SNES", 17), ("SNES@18", 18), ("Open_ES", 18), ("Open_ES@6", 6), ("SV_Open_ES", 20)],
)
def test_a_name_may_set_the_population_and_mirrored_candidates_make_it_even(variant, population):
    assert first_spend(build(variant, 3, RefineConfig(population=17))) == population


@pytest.mark.parametrize(
    "variant, message",
    [
        ("CMAES", "choose one of .*CMA_ES.*xNES"),
        ("Open_ES@9", "population of Open_ES is 9; give a multiple of 2, as 10"),
        ("SV_Open_ES@18", "give a multiple of 4, as 20"),
        ("SNES@", "evosax:SNES@ has no population behind the @; give a whole number"),
        ("SNES@-3", "no population behind the @"),
        ("SNES@0", "population is 0; give a whole number, 1 or more"),
        ("ESMC@2", "evosax cannot build ESMC .* must be >= 4"),
    ],
)
def test_bad_names_say_what_to_do(variant, message):
    with pytest.raises(ValueError, match=message):
        build(variant, 3, RefineConfig())


@pytest.mark.parametrize(
    "changed, message",
    [
        ({"sigma0": -0.1}, "sigma0 is -0.1; give a number above 0"),
        ({"dim": 0}, "dim is 0"),
        ({"optimiser": None}, "evosax cannot build SNES .*unexpected keyword argument 'optimiser'"),
    ],
)
def test_bad_settings_say_what_to_do(changed, message):
    with pytest.raises(ValueError, match=message):
        evosax_strategy("SNES", **{"dim": 3, "population": 10, "sigma0": 0.3} | changed)
