"""Test functions with their minimum 0, and the loop that every refiner test runs."""

import math

import jax
import jax.numpy as jnp
import pytest

from jaxshape.search.refiner import advance
from jaxshape.search.stopping import Tolerances

SHAPE, D = (3, 3, 3), 4
"""Grids and codes of the small decoder of conftest.py."""

NEVER = Tolerances(
    tolfun=0.0,
    tolfunhist=0.0,
    tolx=0.0,
    tolxstagnation=0.0,
    tolstagnation=False,
    tolfacupx=math.inf,
    tolupsigma=math.inf,
    tolconditioncov=math.inf,
    tolflatfitness=math.inf,
    noeffect=False,
)
"""No criterion ends a search."""


@pytest.fixture(scope="module", autouse=True)
def quick_compilation():
    """Most of the time here is the compiler's; its optimisations are not what is tested."""
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", before)


def sphere(x):
    return jnp.sum(x**2)


def ellipsoid(x):
    """Condition number 1e4."""
    return jnp.sum(jnp.logspace(0, 4, len(x)) * x**2)


def rosenbrock(x):
    return jnp.sum(100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2)


def rastrigin(x):
    return jnp.sum(x**2 + 10 * (1 - jnp.cos(2 * jnp.pi * x)))


def run(refiner, objective, key, code, iterations):
    """One search over one code: the final state, and the trace over the iterations."""

    def body(now, key):
        state, trace = advance(refiner, key, *now, objective)
        return (state, trace), trace

    init_key, loop_key = jax.random.split(key)
    started = refiner.init(init_key, code, objective(code))
    (state, _), traces = jax.lax.scan(body, started, jax.random.split(loop_key, iterations))
    return state, traces


def run_batch(refiner, objective_of, key, codes, iterations, *data):
    """Searches over a batch of codes, the objective of each closing over its row of `data`."""

    def one(key, code, *row):
        return run(refiner, objective_of(*row), key, code, iterations)

    return jax.vmap(one)(jax.random.split(key, len(codes)), codes, *data)
