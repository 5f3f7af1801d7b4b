"""Every optimiser of optax and every strategy of evosax lowers a loss."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import optax
import optax.contrib
import pytest
from evosax.algorithms.distribution_based import distribution_based_algorithms
from problems import run

from jaxshape.search.config import RefineConfig
from jaxshape.search.methods import build_refiner
from jaxshape.search.methods.gradient import UNUSABLE, optimizers

KEY = jax.random.key(0)
DIM, ITERATIONS = 10, 30
START = jnp.linspace(-2, 2, DIM)
MINIMUM = jnp.sin(jnp.arange(DIM))
CONFIG = RefineConfig(iterations=ITERATIONS)

pytestmark = pytest.mark.usefixtures("compile_quickly")


def valley(point):
    """Condition number 100, and as flat in whitened codes as the objective of a shape."""
    return jnp.sum(jnp.logspace(-4, -2, DIM) * (point - MINIMUM) ** 2)


def lowered(name, by):
    """Search, and check what every search promises; `by` is the share of the loss that is left."""
    refiner = build_refiner(name, DIM, CONFIG)
    state, trace = jax.jit(lambda: run(refiner, valley, KEY, START, ITERATIONS))()
    assert all(np.all(np.isfinite(x)) for x in (state.mean, *state.best, trace.best_loss))
    np.testing.assert_allclose(valley(state.best.point), state.best.loss, rtol=1e-5)
    left = float(state.best.loss / valley(START))
    assert left < by, left


@pytest.mark.slow
@pytest.mark.parametrize("name", optimizers())
def test_every_optimiser_of_optax_descends(name):
    """`dog` and `prodigy` begin with steps of 1e-6 and double them; the noise of `noisy_sgd` is
    made for gradients of length 1."""
    lowered(f"gradient:{name}", 1.0 if name in ("dog", "noisy_sgd", "prodigy") else 0.8)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(distribution_based_algorithms))
def test_every_strategy_of_evosax_descends(name):
    lowered(f"evosax:{name}", 0.95)


def test_no_optimiser_is_left_out():
    """What makes a transformation from a learning rate is an optimiser, refused or not."""
    found = set()
    for module in (optax, optax.contrib):
        for name, x in vars(module).items():
            if name.startswith(("_", "scale_by")) or inspect.isclass(x) or not callable(x):
                continue
            try:
                arguments = inspect.signature(x).parameters
            except ValueError:  # a type
                continue
            if {"learning_rate", "max_learning_rate"} & arguments.keys():
                found.add(name)
    refused = {"dpsgd", "schedule_free", "sophia"}
    assert refused <= UNUSABLE.keys()
    assert found == optimizers().keys() | refused
