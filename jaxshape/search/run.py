"""The refinement loop: many objects, each with its population, in one compiled program."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, Key, PyTree

from jaxshape.model.autoencoder import decode, prepare_decoder
from jaxshape.search.batching import select
from jaxshape.search.config import Precision
from jaxshape.search.objective import Target, cross_entropy, objective
from jaxshape.search.refiner import Objective, Refiner, StopReason, Trace, finite_or_inf
from jaxshape.search.space import LatentSpace

# What a code costs besides its objective.
Penalty = Callable[[Float[Array, " d"]], Float[Array, ""]]


class Refined(NamedTuple):
    """The outcome of a search for each object of a batch."""

    code: Float[Array, "object d"]
    """The best code that was evaluated."""
    logits: Float[Array, "object x y z"]
    """Its decoded shape."""
    loss: Float[Array, " object"]
    """Its objective, in nats per voxel, with the penalty if there is one."""
    trace: Trace
    """Per object and iteration; constant once the object's search has stopped."""
    path: Float[Array, "object iteration d"]
    """The best code so far, after each iteration."""
    iterations: Int[Array, " object"]
    """How many the search took before it stopped."""
    stop: Int[Array, " object"]
    """Why it stopped, a `StopReason`."""
    state: Any
    """Of the refiner, one per object; a later search can start from it."""


def refine(
    keys: Key[Array, " object"],
    params: PyTree,
    codes: Float[Array, "object d"],
    targets: Target,
    refiner: Refiner,
    iterations: int,
    *,
    space: LatentSpace | None = None,
    penalty: Penalty = lambda code: jnp.zeros(()),
    first_losses: Float[Array, " object"] | None = None,
    target_loss: Float[Array, ""] | float | None = None,
    previous: Any = None,
    precision: Precision = "float32",
) -> Refined:
    """Search from each object's first code for one that explains its target better (section 3.3).

    All candidates of all objects go through the decoder in one call per iteration. `keys` holds one
    key per object: objects do not influence each other, and find the same in any company. An
    object whose search has stopped is frozen and no longer decoded.

    `space` are the coordinates of the search, the codes themselves by default. `penalty` of a code
    is added to its objective. `first_losses` are those of the first codes, where they are known.
    `target_loss` is low enough to stop. With `previous`, the states of an earlier search in the
    same space, this one goes on from these instead of from `codes`. `precision` is that of the
    decoder's products during the search; `logits` and `loss` are float32 in any case.
    """
    decoder = prepare_decoder(params)
    searched = decoder if precision == "float32" else prepare_decoder(params, precision)
    to_code = (lambda point: point) if space is None else space.to_code
    from_code = (lambda code: code) if space is None else space.from_code

    def loss_of(target: Target) -> Objective:
        def loss(point):
            code = to_code(point)
            return objective(searched, code, target) + penalty(code)

        return loss

    def begin(key, code, target, loss, state):
        point = from_code(code) if state is None else state.best.point
        if loss is None or state is not None:
            loss = loss_of(target)(point)
        if state is None or refiner.resume is None:
            return refiner.init(key, point, loss)
        return refiner.resume(key, state, loss)

    def move(key, state, target, trace):
        """One iteration of one object; nothing where its search has stopped."""
        loss, running = loss_of(target), state.stop == StopReason.RUNNING
        awake = lambda point: loss(jnp.where(running, point, jnp.nan))  # noqa: E731
        moved = refiner.step(key, state, awake)
        state, trace = select(running, moved, (state, trace))
        return _stop_at(target_loss, state), trace

    def iterate(carry, number):
        (states, traces), steps = carry
        running = states.stop == StopReason.RUNNING

        def move_all():
            step_keys = jax.vmap(jax.random.fold_in, (0, None))(keys, number + 1)
            return jax.vmap(move)(step_keys, states, targets, traces)

        states, traces = lax.cond(jnp.any(running), move_all, lambda: (states, traces))
        return ((states, traces), steps + running), (traces, states.best.point)

    first_keys = jax.vmap(jax.random.fold_in, (0, None))(keys, 0)
    started = jax.vmap(begin)(first_keys, codes, targets, first_losses, previous)
    started = _stop_at(target_loss, started[0]), started[1]
    steps = jnp.zeros(len(codes), jnp.int32)
    ((states, _), steps), (traces, path) = lax.scan(
        iterate, (started, steps), jnp.arange(iterations)
    )
    over_iterations = partial(jnp.moveaxis, source=0, destination=1)

    # Where the search stands at last was never evaluated: the mean of a population, or the point
    # after the last gradient step. It may be the better one.
    points = jnp.stack([states.best.point, states.mean], axis=1)
    codes = jax.vmap(jax.vmap(to_code))(points)
    logits = decode(decoder, codes)
    losses = cross_entropy(logits, jax.tree.map(lambda x: x[:, None], targets))
    losses = losses + jax.vmap(jax.vmap(penalty))(codes)
    better = jnp.argmin(finite_or_inf(losses), axis=1)
    code, logits, loss = (jax.vmap(lambda x, i: x[i])(x, better) for x in (codes, logits, losses))
    return Refined(
        code=code,
        logits=logits,
        loss=loss,
        trace=jax.tree.map(over_iterations, traces),
        path=jax.vmap(jax.vmap(to_code))(over_iterations(path)),
        iterations=steps,
        stop=jnp.where(states.stop == StopReason.RUNNING, StopReason.BUDGET, states.stop),
        state=states,
    )


def _stop_at(target_loss: Float[Array, ""] | float | None, states: Any) -> Any:
    """The states, with those stopped whose loss is low enough."""
    if target_loss is None:
        return states
    reached = states.best.loss <= target_loss
    return states._replace(stop=jnp.where(reached, StopReason.TARGET, states.stop))
