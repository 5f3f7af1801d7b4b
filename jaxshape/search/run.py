"""The refinement loop: many objects, each with its population, in one compiled program."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, Key, PyTree

from jaxshape.geometry.grids import Grids
from jaxshape.model.shapes import Precision, ShapePrior, pick
from jaxshape.search.objective import Evaluation, Penalty, evaluation, prepare_one
from jaxshape.search.refiner import (
    Objective,
    Refiner,
    StopReason,
    Trace,
    advance,
    finite_or_inf,
)
from jaxshape.search.residuals import BALANCED, Residual
from jaxshape.search.space import LatentSpace, raw


class Refined(NamedTuple):
    """The outcome of a search for each object of a batch.

    Attributes:
        code: The best code that was evaluated `[object d]`.
        logits: Logits of its decoded shape `[object x y z]`, occupied where positive.
        loss: Its objective `[object]`, in nats per voxel, with the penalty if there is one.
        trace: Figures of each iteration `[object iteration ...]`; constant once the object's search
            has stopped.
        path: The best code so far, after each iteration `[object iteration d]`.
        iterations: Iterations that the search took before it stopped `[object]`.
        stop: Why the search stopped `[object]`, as a `StopReason`.
        state: State of the refiner, one for each object; a later search can start from it
            (`previous`).
    """

    code: Float[Array, "object d"]
    logits: Float[Array, "object x y z"]
    loss: Float[Array, " object"]
    trace: Trace
    path: Float[Array, "object iteration d"]
    iterations: Int[Array, " object"]
    stop: Int[Array, " object"]
    state: Any


def refine(
    keys: Key[Array, "*object"],
    prior: ShapePrior,
    codes: Float[Array, "object d"],
    targets: PyTree,
    refiner: Refiner,
    iterations: int,
    *,
    residual: Residual = BALANCED,
    grids: Grids | None = None,
    space: LatentSpace | None = None,
    penalty: Penalty | None = None,
    first_losses: Float[Array, " object"] | None = None,
    target_loss: Float[Array, ""] | float | None = None,
    previous: Any = None,
    precision: Precision = "float32",
) -> Refined:
    """Search from each object's first code for one that explains its target better (section 3.3).

    All candidates of all objects go through the decoder in one call per iteration. An object whose
    search has stopped is frozen and no longer decoded.

    Args:
        keys: One random key for each object `[object]`, or one for all, which is split. The result
            of an object does not depend on the others in its batch.
        prior: The shape prior.
        codes: First code of each object `[object d]`.
        targets: Target of each object, `residual.target(grids, first_logits)`: a pytree whose
            arrays have a leading axis over objects.
        refiner: The search to run, as `build_refiner` gives it.
        iterations: Steps of the search at most, 1 or more.
        residual: The residual that the targets belong to.
        grids: F and M of each object `[object x y z]`, for models whose decoder takes the
            measurement; None for models that decode from the code alone.
        space: Coordinates of the search; None for the codes themselves.
        penalty: `code [d] -> ` nats per voxel, added to the residual; None for no penalty.
        first_losses: Objectives of the first codes `[object]`, in nats per voxel; None where they
            are not known.
        target_loss: Objective that is low enough to stop, in nats per voxel; None for no such
            target.
        previous: States of an earlier search in the same space (`Refined.state`): this search goes
            on from them instead of from `codes`. None starts from `codes`.
        precision: Precision of the decoder's matrix products during the search, `float32` or
            `bfloat16`; `logits` and `loss` are float32 in any case.

    Raises:
        ValueError: The arguments do not belong to the same number of objects, or `jax.vmap` is
            asked to search with several networks at once.
    """
    keys = keys_of(keys, codes, prior)
    space = raw(prior) if space is None else space
    exact = prepare_one(prior, grids, "float32")
    searched = exact if precision == "float32" else prepare_one(prior, grids, precision)
    how = _evaluation(prior, searched, residual, penalty, codes, targets)

    def loss_of(own: PyTree) -> Objective:
        return lambda point: how.loss(how.shared, space.to_code(point), own)

    def begin(key, code, own, loss, state):
        point = space.from_code(code) if state is None else state.best.point
        if loss is None or state is not None:
            loss = loss_of(own)(point)
        if state is None or refiner.resume is None:
            return refiner.init(key, point, loss)
        return refiner.resume(key, state, loss)

    def move(key, state, own, trace):
        state, trace = advance(refiner, key, state, trace, loss_of(own))
        return _stop_at(target_loss, state), trace

    def iterate(carry, number):
        (states, traces), steps = carry
        running = states.stop == StopReason.RUNNING

        def move_all():
            step_keys = jax.vmap(jax.random.fold_in, (0, None))(keys, number + 1)
            return jax.vmap(move)(step_keys, states, own, traces)

        states, traces = lax.cond(jnp.any(running), move_all, lambda: (states, traces))
        return ((states, traces), steps + running), (traces, states.best.point)

    own = searched.own, targets
    first_keys = jax.vmap(jax.random.fold_in, (0, None))(keys, 0)
    started = jax.vmap(begin)(first_keys, codes, own, first_losses, previous)
    started = _stop_at(target_loss, started[0]), started[1]
    steps = jnp.zeros(len(codes), jnp.int32)
    ((states, _), steps), (traces, path) = lax.scan(
        iterate, (started, steps), jnp.arange(iterations)
    )
    over_iterations = partial(jnp.moveaxis, source=0, destination=1)
    final = how._replace(shared=(exact.shared, how.shared[1]))
    code, logits, loss = _best(final, (exact.own, targets), states, space)
    return Refined(
        code=code,
        logits=logits,
        loss=loss,
        trace=jax.tree.map(over_iterations, traces),
        path=jax.vmap(jax.vmap(space.to_code))(over_iterations(path)),
        iterations=steps,
        stop=jnp.where(states.stop == StopReason.RUNNING, StopReason.BUDGET, states.stop),
        state=states,
    )


def _evaluation(prior, prepared, residual, penalty, codes, targets) -> Evaluation:
    """The scoring of codes, with the first object of a batch as an example of shapes."""
    own = pick((prepared.own, targets), 0)
    return evaluation(prior.model, prepared, residual, penalty, codes[0], own)


def _best(
    how: Evaluation, own: PyTree, states: Any, space: LatentSpace
) -> tuple[Float[Array, "object d"], Float[Array, "object x y z"], Float[Array, " object"]]:
    """Code, logits and objective of the best that each search has found.

    Where a search stands at last was never evaluated: the mean of a population, or the point after
    the last gradient step. It may be the better one.
    """
    points = jnp.stack([states.best.point, states.mean], axis=1)
    codes = jax.vmap(jax.vmap(space.to_code))(points)
    count, two, d = codes.shape
    owner = jnp.repeat(jnp.arange(count), two)
    logits, losses = how.shape(how.shared, codes.reshape(-1, d), own, owner)
    better = jnp.argmin(finite_or_inf(losses).reshape(count, two), axis=1)
    row = two * jnp.arange(count) + better
    return codes.reshape(-1, d)[row], logits[row], losses[row]


def keys_of(
    keys: Key[Array, "*object"], codes: Float[Array, "object d"], prior: ShapePrior
) -> Key[Array, " object"]:
    """One key for each code, from one for each or one for all.

    Args:
        keys: One key for each code `[object]`, or one for all.
        codes: Codes of the objects `[object d]`.
        prior: The shape prior.

    Raises:
        ValueError: There are neither as many keys as codes nor one, or codes have another size.
    """
    if codes.ndim != 2 or codes.shape[-1] != prior.code_size:
        raise ValueError(
            f"codes have shape {codes.shape}; give [object, {prior.code_size}], one code for each "
            "object of the batch (code[None] for one object)."
        )
    if not jnp.issubdtype(keys.dtype, jax.dtypes.prng_key):
        keys = jax.random.wrap_key_data(keys)
    if keys.ndim == 0:
        return jax.random.split(keys, len(codes))
    if keys.shape != (len(codes),):
        raise ValueError(
            f"There are keys of shape {keys.shape} for {len(codes)} objects; give one for each, "
            "jax.random.split(key, objects), or a single one."
        )
    return keys


def _stop_at(target_loss: Float[Array, ""] | float | None, states: Any) -> Any:
    """The states, with those stopped whose loss is low enough."""
    if target_loss is None:
        return states
    reached = states.best.loss <= target_loss
    return states._replace(stop=jnp.where(reached, StopReason.TARGET, states.stop))
