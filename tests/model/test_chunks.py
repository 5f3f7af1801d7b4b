"""Functions applied to a few examples at a time give what they give for all at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxshape.model.chunks import _count, in_chunks, sum_chunks


@pytest.mark.parametrize("b", [1, 2, 7, 12, 17, 32])
@pytest.mark.parametrize("size", [1, 2, 5, 6, 8, 40])
def test_chunks_cover_all_examples(b, size):
    x, y = np.random.default_rng(b).normal(size=(2, b, 3)).astype(np.float32)
    both = lambda x, y: (x * y, jnp.sum(x, axis=-1))  # noqa: E731
    for found, expected in zip(jax.jit(lambda x, y: in_chunks(both, size, x, y))(x, y),
                               both(x, y), strict=True):  # fmt: skip
        np.testing.assert_allclose(found, expected, rtol=1e-6)
    total = jax.jit(lambda x, y: sum_chunks(lambda x, y: jnp.sum(x * y, axis=0), size, x, y))(x, y)
    np.testing.assert_allclose(total, np.sum(x * y, axis=0), atol=1e-5)


def test_chunks_are_few_and_even_where_that_costs_little():
    for b in range(1, 80):
        for size in range(1, 80):
            count, fewest = _count(b, size), -(-b // size)
            assert fewest <= count <= 1.5 * fewest and -(-b // count) <= size
            assert b % count == 0 or all(b % n for n in range(fewest, int(1.5 * fewest) + 1))
    assert (_count(32, 6), _count(17, 8), _count(30, 8)) == (8, 3, 5)
