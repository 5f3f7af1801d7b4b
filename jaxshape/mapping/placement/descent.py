"""Steps of Adam from many starting points at the same time, each on its own."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax import lax
from jaxtyping import Array, Float, PyTree

from jaxshape.search.batching import select
from jaxshape.search.refiner import finite_or_inf


def descend(
    start: PyTree,
    misfits: Callable[[Any], Float[Array, " h"]],
    unit: PyTree,
    steps: Array | int,
    rise: int,
) -> tuple[Any, Float[Array, " h"]]:
    """Move points down the gradients of their misfits; return the best point on each path.

    The steps grow to their full length at first and shrink along a half cosine afterwards.

    Args:
        start: The starting points, h of them along the first axis of every array.
        misfits: Misfit of each point.
        unit: Length of one step in each number of a point.
        steps: Number of steps, 0 or more.
        rise: Number of steps until the step length is full, 1 or more.

    Returns:
        The points with the lowest misfits, the start among them, and these misfits, infinite where
        none was finite.
    """
    adam = optax.scale_by_adam(b2=0.98)
    after = lambda moves: jax.tree.map(lambda x, u, m: x + u * m, start, unit, moves)  # noqa: E731

    def total(moves):
        each = finite_or_inf(misfits(after(moves)))
        return jnp.sum(each), each

    def step(i, carry):
        moves, state, best, lowest = carry
        slope, found = jax.grad(total, has_aux=True)(moves)
        best = jax.vmap(select)(found < lowest, moves, best)
        direction, state = adam.update(slope, state)
        shrink = 0.05 + 0.95 * (1 + jnp.cos(jnp.pi * i / steps)) / 2
        length = jnp.minimum((i + 1) / rise, shrink)
        moves = jax.tree.map(lambda m, d: m - length * d, moves, direction)
        return moves, state, best, jnp.minimum(lowest, found)

    still = jax.tree.map(jnp.zeros_like, start)
    infinite = jnp.full(len(jax.tree.leaves(start)[0]), jnp.inf, jnp.float32)
    carry = (still, adam.init(still), still, infinite)
    # One more step evaluates the points that the last step led to.
    _, _, best, lowest = lax.fori_loop(0, steps + 1, step, carry)
    return after(best), lowest
