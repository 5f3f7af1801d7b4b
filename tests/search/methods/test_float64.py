"""All families in float64, and in float32 while JAX has 64 bits on."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from marks import slow
from problems import run_batch, sphere

from jaxshape.search.config import RefineConfig
from jaxshape.search.methods import build_refiner

KEY = jax.random.key(0)
ITERATIONS = 12
CONFIG = RefineConfig(iterations=ITERATIONS, population=6, sigma0=0.5, tolerance=1e-9)
METHODS = [
    "cma",
    slow("cma:ipop"),
    slow("cma:bipop"),
    "gradient:adam",
    "gradient:lbfgs",
    "gradient:noisy_sgd",
    "gradient:prodigy",
    "evosax:CMA_ES",
    slow("evosax:EvoTF_ES"),
    "evosax:Open_ES",
    slow("hybrid"),
    "gauss-newton",
]

pytestmark = pytest.mark.usefixtures("compile_quickly")


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("name", METHODS)
def test_numbers_have_the_type_of_the_point_and_counters_are_int32(name, dtype):
    """The loop itself refuses a state whose types change."""
    with jax.enable_x64(True):
        points = jnp.array([[2.0, 2.0, 2.0], [-1.0, 0.0, 1.0]], dtype)
        refiner = build_refiner(name, 3, CONFIG)
        state, trace = jax.jit(
            lambda: run_batch(refiner, lambda: sphere, KEY, points, ITERATIONS)
        )()
        for x in jax.tree.leaves((state.mean, state.best, trace)):
            assert x.dtype in (dtype, jnp.int32)
        assert state.stop.dtype == trace.evaluations.dtype == jnp.int32
        assert np.all(state.best.loss < jax.vmap(sphere)(points))
        again = np.sum(np.asarray(state.best.point) ** 2, axis=1)
        np.testing.assert_allclose(again, state.best.loss, rtol=4 * jnp.finfo(dtype).eps)
        if name.startswith("cma"):
            for x in jax.tree.leaves(state):
                assert x.dtype in (dtype, jnp.int32, bool)
