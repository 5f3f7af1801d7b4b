"""Choices by a traced boolean: selection of pytrees, and branches that survive `jax.vmap`."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, PyTree


def apply_if(due: Bool[Array, ""], function: Callable[..., Any], *operands: PyTree) -> PyTree:
    """Apply `function` to the operands where `due`; return them unchanged elsewhere.

    Under `jax.vmap` a plain `lax.cond` turns into a select, which always calls the function for
    every element. Here a batch calls the function only when ANY element is due, and each element
    keeps the result only if it is due itself. `function` returns arrays of the same shapes as its
    operands, and closes over constants only.
    """

    @jax.custom_batching.custom_vmap
    def branch(due, *operands):
        return jax.lax.cond(due, function, lambda *same: same, *operands)

    @branch.def_vmap
    def branch_if_any(size, batched, due, *operands):
        due, *operands = jax.tree.map(
            lambda x, has_axis: x if has_axis else jnp.broadcast_to(x, (size, *jnp.shape(x))),
            [due, *operands],
            list(batched),
        )

        def each(due, *old):
            return due, *jax.vmap(lambda due, *old: select(due, function(*old), old))(due, *old)

        _, *done = apply_if(jnp.any(due), each, due, *operands)  # which may be batched again
        return tuple(done), jax.tree.map(lambda _: True, tuple(done))

    return branch(due, *operands)


def select(wanted: Bool[Array, ""], new: PyTree, old: PyTree) -> PyTree:
    """`new` where wanted, otherwise `old`; for trees of the same shapes."""
    return jax.tree.map(lambda x, y: jnp.where(wanted, x, y), new, old)


def cast_like(new: PyTree, old: PyTree) -> PyTree:
    """`new` with the types of `old`, as a compiled loop requires; for trees of the same shapes."""
    return jax.tree.map(lambda x, y: jnp.asarray(x, jnp.asarray(y).dtype), new, old)
