"""A decoder that compiles at once and counts what it decodes, for tests of the search around it."""

import jax
import jax.numpy as jnp
import pytest

from jaxshape.search import objective as objective_module
from jaxshape.search import run as run_module


class CountedDecoder:
    """A linear map in the network's place; counts what the objective asks for."""

    def __init__(self):
        self.traces, self._calls = 0, []

    def __call__(self, params, code):
        return jnp.tensordot(code, params, 1)

    def counting(self, params, code):
        self.traces += 1
        rows = code.size // code.shape[-1]
        jax.debug.callback(lambda: self._calls.append(rows))
        return self(params, code)

    def codes(self) -> int:
        """Codes decoded since the last time this was asked."""
        jax.effects_barrier()
        rows, self._calls = sum(self._calls), []
        return rows


@pytest.fixture(scope="module")
def compile_quickly():
    """Compiling takes most of the time of these tests, and their arithmetic is small."""
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.fixture(scope="module")
def decoder(compile_quickly):
    """Stands for the network, one code at a time."""
    counted = CountedDecoder()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(objective_module, "decode", counted.counting)
        patch.setattr(run_module, "decode", counted)
        patch.setattr(run_module, "prepare_decoder", lambda params: params)
        patch.setattr(objective_module, "CANDIDATES_AT_A_TIME", {"cpu": 1, "default": 1})
        yield counted
