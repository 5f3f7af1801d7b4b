"""The loop over iterations: a batch of objects, each with its own search, in one `lax.scan`."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, Key, PyTree

from jaxshape.geometry.grids import Grids
from jaxshape.model.chunks import vary_like
from jaxshape.search.devices import numbers
from jaxshape.search.objective import Evaluation, ObjectTerms, composed
from jaxshape.search.refiner import Refiner, StopReason, Trace, advance, as_promised
from jaxshape.search.space import LatentSpace

# The arguments of a callback after each iteration: numbers of the objects [n], the iterations that
# each of them has taken [n], and its trace [n ...], as NumPy arrays.
Callback = Callable[[np.ndarray, np.ndarray, Trace], None]


class SearchState(NamedTuple):
    """State of the search of each object.

    Attributes:
        state: State of its refiner.
        trace: Trace of its last iteration.
        iterations: Iterations that it has taken `[object]`.
    """

    state: Any
    trace: Trace
    iterations: Int[Array, " object"]


class Rows(NamedTuple):
    """The arrays that belong to single objects, with a leading axis over objects.

    Attributes:
        keys: Random key of each object.
        codes: First codes `[object d]`.
        targets: Targets of the residual.
        grids: F and M, or None.
        first_losses: Objectives of the first codes, or None.
        begun: States of an interrupted search, or None.
        warm_start: States of a search for an earlier measurement, or None.
    """

    keys: Key[Array, " object"]
    codes: Float[Array, "object d"]
    targets: PyTree
    grids: Grids | None
    first_losses: Float[Array, " object"] | None
    begun: SearchState | None
    warm_start: Any


def require_rows(count: int, **trees: PyTree) -> None:
    """Refuse an empty batch, and arrays without one row for each of its objects.

    Args:
        count: Number of objects.
        trees: Arguments with arrays `[object ...]`, by their names.

    Raises:
        ValueError: There is no object, or an array has another number of rows.
    """
    if count == 0:
        raise ValueError("There are no objects; give a batch of one or more.")
    for name, tree in trees.items():
        for leaf in jax.tree.leaves(tree):
            if jnp.shape(leaf)[:1] != (count,):
                raise ValueError(
                    f"{name} has an array of shape {jnp.shape(leaf)}, but there are {count}"
                    f" objects; give [{count}, ...], one row for each object."
                )


class Loop(NamedTuple):
    """The loop over iterations for a batch of objects.

    Attributes:
        refiner: The search.
        how: The scoring of codes.
        space: Coordinates of the search.
        own: Part of each object's objective that belongs to it alone.
        target_loss: Loss that is low enough to stop, or None.
        callback: Function that is called after every iteration, or None.
    """

    refiner: Refiner
    how: Evaluation
    space: LatentSpace
    own: ObjectTerms
    target_loss: Float[Array, ""] | float | None
    callback: Callback | None

    def run(
        self, rows: Rows, iterations: int
    ) -> tuple[Any, Int[Array, " object"], Trace, Float[Array, "object iteration d"]]:
        """Run the searches of all objects.

        Args:
            rows: The objects.
            iterations: Length of the loop; searches that have stopped no longer change.

        Returns:
            The states of the searches, the iterations of each, its trace, and its best point after
            each iteration, in the coordinates of the search.
        """
        first = vary_like(self._first(rows), rows.codes)

        def iterate(now: SearchState, _: Any) -> tuple[SearchState, tuple[Trace, Array]]:
            running = now.state.stop == StopReason.RUNNING
            now = lax.cond(jnp.any(running), partial(self._move, rows), lambda now: now, now)
            return now, (now.trace, now.state.best.point)

        last, shown = lax.scan(iterate, first, length=iterations)
        over_iterations = partial(jnp.moveaxis, source=0, destination=1)
        traces, path = jax.tree.map(over_iterations, shown)
        return last.state, last.iterations, traces, path

    def _first(self, rows: Rows) -> SearchState:
        """The states at the start of the searches, or where they were interrupted."""
        if rows.begun is not None:
            begun = rows.begun
        else:
            keys = jax.vmap(jax.random.fold_in, (0, None))(rows.keys, 0)
            started = jax.vmap(self._begin)(
                keys, rows.codes, self.own, rows.first_losses, rows.warm_start
            )
            begun = SearchState(*started, jnp.zeros(len(rows.codes), jnp.int32))
        return begun._replace(state=_stop_at(self.target_loss, begun.state))

    def _begin(
        self, key: Array, code: Array, own: ObjectTerms, loss: Any, state: Any
    ) -> tuple[Any, Trace]:
        """The first state of one object."""
        point = self.space.from_code(code) if state is None else state.best.point
        if loss is None or state is not None:
            loss = composed(self.how, self.space, own)(point)
        if state is None or self.refiner.resume is None:
            return as_promised("init", self.refiner.init(key, point, loss))
        return as_promised("resume", self.refiner.resume(key, state, loss))

    def _move(self, rows: Rows, now: SearchState) -> SearchState:
        """One iteration of all objects; stopped objects do not change."""
        running = now.state.stop == StopReason.RUNNING

        def move_one(key, state, own, trace):
            objective = composed(self.how, self.space, own)
            state, trace = advance(self.refiner, key, state, trace, objective)
            return _stop_at(self.target_loss, state), trace

        iterations = now.iterations + running
        keys = jax.vmap(jax.random.fold_in)(rows.keys, now.iterations + 1)
        state, trace = jax.vmap(move_one)(keys, now.state, self.own, now.trace)
        if self.callback is not None:
            jax.debug.callback(self.callback, numbers(len(iterations)), iterations, trace)
        return SearchState(state, trace, iterations)


def _stop_at(target_loss: Float[Array, ""] | float | None, states: Any) -> Any:
    """The states; objects whose loss has reached the target are stopped."""
    if target_loss is None:
        return states
    reached = states.best.loss <= target_loss
    return states._replace(stop=jnp.where(reached, StopReason.TARGET, states.stop))
