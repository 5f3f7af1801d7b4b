"""Shape priors small enough for tests: a tiny network, and a linear one that compiles at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxshape.model.autoencoder import initialize
from jaxshape.model.config import Architecture
from jaxshape.model.weights import ShapePrior
from jaxshape.refine import objective, reconstruction, run


@pytest.fixture(scope="session")
def prior() -> ShapePrior:
    """Random, with weights large enough that codes differ between grids, and grids by codes."""

    architecture = Architecture((4, 4, 8, 8), (8, 8, 4), 10)
    shapes = jax.eval_shape(lambda: initialize(jax.random.key(0), architecture))
    rng = np.random.default_rng(0)

    def fill(path, x):
        name = path[-1].key
        if name.startswith("conv") or name == "kernel":
            return jnp.asarray(rng.normal(0, 0.1 if name != "kernel" else 1, x.shape), jnp.float32)
        return jnp.full(x.shape, float(name in ("scale", "var")))

    params = jax.tree_util.tree_map_with_path(fill, shapes)
    return ShapePrior(params, jnp.zeros(10), jnp.eye(10))


@pytest.fixture(scope="module")
def linear_prior():
    """The network is replaced by a linear one, for tests of what goes on around it."""

    def encode(params, grid):
        return jnp.einsum("...xyz,dxyz->...d", grid.astype(jnp.float32), params) / 32

    def decode(params, code):
        return jnp.einsum("...d,dxyz->...xyz", code, params) - 1

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reconstruction, "encode", encode)
        patch.setattr(reconstruction, "decode", decode)
        patch.setattr(objective, "decode", decode)
        patch.setattr(run, "decode", decode)
        patch.setattr(run, "prepare_decoder", lambda params: params)
        params = jax.random.normal(jax.random.key(5), (10, 32, 32, 32))
        yield ShapePrior(params, jnp.zeros(10), jnp.eye(10))
