"""Settings that are numbers may be traced: a grid of them over many objects is one program."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from marks import slow
from problems import SHAPE, D

from jaxshape.checks import positive
from jaxshape.search.config import RefineConfig
from jaxshape.search.methods import build_refiner
from jaxshape.search.residuals import Residual, Target, cross_entropy
from jaxshape.search.run import refine
from jaxshape.search.space import LatentSpace

pytestmark = pytest.mark.usefixtures("unchecked_types")

OBJECTS = 16
rng = np.random.default_rng(0)
CODES = jnp.asarray(rng.normal(size=(OBJECTS, D)), jnp.float32)
TARGETS = Target(*jnp.asarray(rng.random((2, OBJECTS, *SHAPE)), jnp.float32))
GRIDS = {
    "cma": {"sigma0": jnp.geomspace(0.01, 1, 8), "prior_weight": jnp.linspace(0, 3, 8)},
    "gradient:adam": {"step_size": jnp.geomspace(0.01, 1, 8), "bound": jnp.linspace(1, 3, 8)},
    "gauss-newton": {"tolerance": jnp.geomspace(1e-3, 1, 8), "prior_weight": jnp.linspace(0, 3, 8)},
}


@pytest.mark.parametrize("method", ["gradient:adam", slow("cma"), slow("gauss-newton")])
def test_a_grid_of_settings_over_objects_is_one_program(method, counter, counted):
    """It finds what one setting at a time finds, and other settings are no other program."""
    names, values = zip(*GRIDS[method].items(), strict=True)

    def search(*settings):
        config = RefineConfig(iterations=4, population=5, **dict(zip(names, settings, strict=True)))
        found = refine(
            jax.random.key(0), counted, CODES, TARGETS, build_refiner(method, D, config), 4,
            space=LatentSpace(jnp.zeros(D), 2 * jnp.eye(D), config.bound),
            penalty=lambda code: jnp.sum(code**2), penalty_weight=config.prior_weight,
            target_loss=config.target,
        )  # fmt: skip
        return {"loss": found.loss, "code": found.code, "stop": found.stop}

    one, grid = jax.jit(search), jax.jit(jax.vmap(jax.vmap(search, (None, 0)), (0, None)))
    expected = {(i, j): one(values[0][i], values[1][j]) for i, j in ((0, 0), (7, 0), (2, 5))}
    found = grid(*values)
    before = counter.traces
    grid(values[0][::-1], values[1] / 2)
    assert counter.traces == before > 0
    assert found["loss"].shape == (8, 8, OBJECTS)
    for (i, j), single in expected.items():
        np.testing.assert_array_equal(found["stop"][i, j], single["stop"])
        for name in ("loss", "code"):
            np.testing.assert_allclose(found[name][i, j], single[name], rtol=2e-3, atol=1e-4)
    assert np.std(found["loss"], axis=0).max() > 1e-4  # both settings matter
    assert np.std(found["loss"], axis=1).max() > 1e-4


def test_what_a_residual_closes_over_is_not_taken_for_the_first_of_a_batch(counted):
    def search(weight):
        residual = Residual(lambda *_: None, lambda x, target: weight * cross_entropy(x, target))
        refiner = build_refiner("gradient", D, RefineConfig(step_size=0.1))
        key = jax.random.key(0)
        return refine(key, counted, CODES, TARGETS, refiner, 2, residual=residual).loss

    with pytest.raises(ValueError, match="a residual or a penalty that closes over 3 different"):
        jax.vmap(search)(jnp.arange(3.0))


def test_numbers_are_checked_where_their_value_is_known():
    positive("size", jnp.float32(2))
    with pytest.raises(ValueError, match=r"size is Array\(-1.*; give a number above 0"):
        positive("size", jnp.float32(-1))
    with pytest.raises(ValueError, match="give a number above 0"):
        positive("size", jnp.ones(2))
    jax.jit(lambda x: positive("size", x))(-1.0)
