"""A decoder that compiles at once and counts what it decodes, for tests of the search around it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import SHAPE, D

from jaxshape.model.shapes import Prepared, ShapeModel, ShapePrior
from jaxshape.search import rows


class Counter:
    """Counts what a linear map decodes."""

    def __init__(self):
        self.traces, self._calls = 0, []
        self.model = ShapeModel("counted", self._encode, self._decode)

    @staticmethod
    def _encode(params, grids):
        return jnp.tensordot(grids.occupied.astype(params.dtype), params, ([1, 2, 3], [1, 2, 3]))

    def _decode(self, prepared: Prepared, codes):
        self.traces += 1
        jax.debug.callback(lambda: self._calls.append(len(codes)))
        return jnp.tensordot(codes, prepared.shared, 1)

    def codes(self) -> int:
        """Codes decoded since the last time this was asked."""
        jax.effects_barrier()
        count, self._calls = sum(self._calls), []
        return count


@pytest.fixture(scope="module")
def counter(compile_quickly):
    """Counts codes, which are decoded one at a time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(rows.ROWS_AT_A_TIME, "cpu", 1)
        yield Counter()


@pytest.fixture(scope="module")
def counted(counter) -> ShapePrior:
    """A shape prior whose decoder is counted."""
    params = jnp.asarray(np.random.default_rng(1).normal(size=(D, *SHAPE)), jnp.float32)
    return ShapePrior(counter.model, params, jnp.zeros(D), jnp.eye(D))
