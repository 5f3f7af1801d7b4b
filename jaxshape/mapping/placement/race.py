"""Descent from several starting points, most of whose steps go to the most promising ones.

Every start takes the first fifth of the steps of Adam, two starts at a time. Two finalists are then
chosen, which take the other steps. They end as if they had been alone.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import lax
from jaxtyping import Array, Float, Int, PyTree

from jaxshape.model.shapes import pick
from jaxshape.search.batching import select
from jaxshape.search.refiner import finite_or_inf

LANES = 2
"""Starts that descend at the same time, and the number of finalists."""

HEAT = 5
"""The reciprocal of the share of the steps that every start takes."""


class _Race(NamedTuple):
    """Where each start is: its moves, in units, and the best of them so far with its misfit."""

    moves: PyTree[Float[Array, "h ..."]]
    adam: optax.OptState
    best: PyTree[Float[Array, "h ..."]]
    misfit: Float[Array, " h"]
    finalists: Int[Array, " lanes"]


def race(
    start: PyTree,
    misfits: Callable[[Any, Int[Array, " lanes"]], Float[Array, " lanes"]],
    unit: PyTree,
    steps: Array | int,
    choose: Callable[[Any, Float[Array, " h"]], Int[Array, " lanes"]],
) -> tuple[Any, Float[Array, " h"]]:
    """Move the starts down the gradients of their misfits, the finalists further than the others.

    Args:
        start: The starting points, h of them along the first axis of every array.
        misfits: Misfit of each of a few points, and the numbers of the starts that they belong to.
        unit: Length of one step in each number of a point.
        steps: Steps of a finalist, 0 or more.
        choose: The numbers of the finalists, `LANES` of them, from the points of all starts and
            their misfits.

    Returns:
        The point with the lowest misfit that each start came by, and that misfit; infinite where
        no misfit was finite.
    """
    h = len(jax.tree.leaves(start)[0])
    heats, heat = -(-h // LANES), jnp.asarray(steps) // HEAT
    adam = optax.scale_by_adam(b2=0.98)

    def after(moves, those):
        return jax.tree.map(lambda x, u, m: x[those] + u * m, start, unit, moves)

    def total(moves, those):
        each = finite_or_inf(misfits(after(moves, those), those))
        return jnp.sum(each), each

    def step(i, run: _Race):
        ended = i - heats * heat  # steps since the heats ended
        finalists = lax.cond(
            ended == 0,
            lambda: choose(after(run.best, jnp.arange(h)), run.misfit),
            lambda: run.finalists,
        )
        turn, of_heat = i // jnp.maximum(heat, 1), i % jnp.maximum(heat, 1)
        in_heat = jnp.minimum(LANES * turn + jnp.arange(LANES), h - 1)
        those = jnp.where(ended < 0, in_heat, finalists)
        taken = jnp.where(ended < 0, of_heat, heat + ended)
        slower = 0.05 + 0.95 * (1 + jnp.cos(jnp.pi * taken / steps)) / 2
        length = jnp.minimum((taken + 1) / 8, slower)
        moves, adam_state, best = pick((run.moves, run.adam, run.best), those)
        slope, misfit = jax.grad(total, has_aux=True)(moves, those)
        direction, adam_state = jax.vmap(adam.update)(slope, adam_state)
        better = misfit < run.misfit[those]
        best = jax.vmap(select)(better, moves, best)
        moves = jax.tree.map(lambda m, d: m - length * d, moves, direction)
        put = lambda whole, part: jax.tree.map(lambda x, y: x.at[those].set(y), whole, part)  # noqa: E731
        return _Race(
            put(run.moves, moves),
            put(run.adam, adam_state),
            put(run.best, best),
            run.misfit.at[those].min(misfit),
            finalists,
        )

    moves = jax.tree.map(jnp.zeros_like, start)
    infinite = jnp.full(h, jnp.inf, jnp.float32)
    run = _Race(moves, jax.vmap(adam.init)(moves), moves, infinite, jnp.arange(LANES))
    # One more step looks at where the last one led.
    run = lax.fori_loop(0, heats * heat + steps - heat + 1, step, run)
    return after(run.best, jnp.arange(h)), run.misfit
