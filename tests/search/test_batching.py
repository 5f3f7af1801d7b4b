"""A branch that stays a branch under vmap."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxshape.search.batching import apply_if

calls = []


def turn(x, y):
    """Work that counts how often it is done: once for each element it is done to."""
    jax.debug.callback(lambda: calls.append(1))
    return 2 * x, y + x[0]


@jax.jit
def alone(due, x, y):
    return apply_if(due, turn, x, y)


batch = jax.jit(jax.vmap(lambda due, x, y: apply_if(due, turn, x, y)))
X, Y = jnp.arange(6.0).reshape(3, 2), jnp.arange(3.0)


def calls_of(function, *operands):
    calls.clear()
    result = jax.block_until_ready(function(*operands))
    jax.effects_barrier()
    return result, len(calls)


@pytest.mark.parametrize("due", [True, False])
def test_alone_it_is_a_branch(due):
    (x, y), count = calls_of(alone, due, X[1], Y[1])
    np.testing.assert_array_equal(x, 2 * X[1] if due else X[1])
    assert y == (Y[1] + X[1, 0] if due else Y[1])
    assert count == due


@pytest.mark.parametrize("due", [(0, 1, 0), (1, 1, 1), (0, 0, 0)])
def test_in_a_batch_each_element_decides_for_itself(due):
    due = np.array(due, bool)
    (x, y), count = calls_of(batch, due, X, Y)
    np.testing.assert_array_equal(x, np.where(due[:, None], 2 * X, X))
    np.testing.assert_array_equal(y, np.where(due, Y + X[:, 0], Y))
    assert (count > 0) == due.any()  # nothing is computed where no element is due


def test_operands_may_be_shared_by_the_batch():
    x, y = jax.vmap(lambda due, y: apply_if(due, turn, X[1], y))(jnp.array([True, False]), Y[:2])
    np.testing.assert_array_equal(x, [2 * X[1], X[1]])
    np.testing.assert_array_equal(y, [Y[0] + X[1, 0], Y[1]])


def test_a_branch_inside_a_branch_of_a_batch_of_batches():
    def outer(inner_due, x):
        x, _ = apply_if(inner_due, turn, x + 1, jnp.zeros(()))
        return inner_due, x

    def nested(outer_due, inner_due, x):
        return apply_if(outer_due, outer, inner_due, x)[1]

    both = jax.jit(jax.vmap(jax.vmap(nested)))
    outer_due, inner_due = np.meshgrid([False, True], [False, True], indexing="ij")
    x = jnp.ones((2, 2, 1))
    found, count = calls_of(both, outer_due, inner_due, x)
    np.testing.assert_array_equal(found[..., 0], [[1, 1], [2, 4]])
    assert count
    assert calls_of(both, outer_due, np.zeros((2, 2), bool), x)[1] == 0
    assert calls_of(both, np.zeros((2, 2), bool), inner_due, x)[1] == 0
