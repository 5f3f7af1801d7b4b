"""The refinement loop: many objects, each with its population, in one compiled program."""

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
from jaxshape.model.shapes import Precision, ShapePrior, pick
from jaxshape.search.devices import numbers, over_devices
from jaxshape.search.objective import (
    Evaluation,
    ObjectTerms,
    Penalty,
    composed,
    evaluation,
    prepare_one,
)
from jaxshape.search.refiner import (
    Refiner,
    StopReason,
    Trace,
    advance,
    finite_or_inf,
)
from jaxshape.search.residuals import BALANCED, Residual
from jaxshape.search.rows import one_network
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
        iterations: Iterations before the search stopped `[object]`, including the iterations of
            `previous`.
        stop: Why the search stopped `[object]`, as a `StopReason`.
        state: State of the refiner, one for each object; a later search can start from it
            (`warm_start`).
    """

    code: Float[Array, "object d"]
    logits: Float[Array, "object x y z"]
    loss: Float[Array, " object"]
    trace: Trace
    path: Float[Array, "object iteration d"]
    iterations: Int[Array, " object"]
    stop: Int[Array, " object"]
    state: Any


# The arguments of a callback after each iteration: numbers of the objects [n], the iterations that
# each of them has taken [n], and its trace [n ...], as NumPy arrays.
Callback = Callable[[np.ndarray, np.ndarray, Trace], None]


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
    penalty_weight: Float[Array, ""] | float = 1.0,
    first_losses: Float[Array, " object"] | None = None,
    target_loss: Float[Array, ""] | float | None = None,
    previous: Refined | None = None,
    warm_start: Any = None,
    callback: Callback | None = None,
    devices: int | None = None,
    precision: Precision = "float32",
) -> Refined:
    """Search from each object's first code for one that explains its target better (section 3.3).

    All candidates of all objects go through the decoder in one call per iteration. An object whose
    search has stopped is frozen and no longer decoded. Objects are spread over all devices of the
    process (`jaxshape.search.devices`).

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
        penalty_weight: Factor of the penalty, 0 or more.
        first_losses: Objectives of the first codes `[object]`, in nats per voxel; None where they
            are not known.
        target_loss: Objective that is low enough to stop, in nats per voxel; None for no target.
        previous: The outcome of an earlier call with the same arguments except `iterations` and
            `target_loss`: the search goes on as if it had not been interrupted. None begins a new
            search.
        warm_start: States of an earlier search in the same space (`Refined.state`), whose targets
            have changed since: this search starts from them instead of from `codes`. Give different
            keys, or it draws the same random numbers again. None starts from `codes`.
        callback: `(objects [n], iterations [n], trace [n ...])`, called on the host after each
            iteration while the compiled loop goes on, by each device for its objects; all are NumPy
            arrays. `jax.effects_barrier` waits for the last call. None costs nothing.
        devices: Devices of this process to spread objects over, 1 or more; None for all.
        precision: Precision of the decoder's matrix products during the search, `float32` or
            `bfloat16`; `logits` and `loss` are float32 in any case.

    Raises:
        ValueError: The arguments do not belong to the same number of objects, both `previous` and
            `warm_start` are given, or `jax.vmap` is asked to search with several networks at once.
    """
    if previous is not None and warm_start is not None:
        raise ValueError(
            "Both previous and warm_start are given; give previous to go on with the same targets,"
            " warm_start for a new search near an earlier one."
        )
    rows = _Rows(
        keys=keys_of(keys, codes, prior),
        codes=codes,
        targets=targets,
        grids=grids,
        first_losses=first_losses,
        begun=None if previous is None else _begun(previous),
        warm_start=warm_start,
    )
    space = raw(prior) if space is None else space

    def search(shared, rows):
        prior, space, weight, target_loss = vary_like(shared, rows.codes)
        searched = prepare_one(prior, rows.grids, precision)
        own = ObjectTerms(
            searched.own, rows.targets, jnp.full(len(rows.codes), weight, jnp.float32)
        )
        how = _evaluation(prior, searched, residual, penalty, rows.codes, own)
        loop = _Loop(refiner, how, space, own, target_loss, callback)
        states, steps, traces, path = loop.run(rows, iterations)
        if precision != "float32":
            exact = prepare_one(prior, rows.grids, "float32")
            how = how._replace(shared=(exact.shared, how.shared[1]))
            own = own._replace(features=exact.own)
        code, logits, loss = _best(how, own, states, space)
        return Refined(
            code=code,
            logits=logits,
            loss=loss,
            trace=traces,
            path=jax.vmap(jax.vmap(space.to_code))(path),
            iterations=steps,
            stop=jnp.where(states.stop == StopReason.RUNNING, StopReason.BUDGET, states.stop),
            state=states,
        )

    return over_devices(search, (prior, space, penalty_weight, target_loss), rows, devices)


class _Begun(NamedTuple):
    """Progress of the search of each object.

    Attributes:
        state: State of its refiner.
        trace: Trace of its last iteration.
        iterations: Iterations that it has taken `[object]`.
    """

    state: Any
    trace: Trace
    iterations: Int[Array, " object"]


def _begun(previous: Refined) -> _Begun:
    """The states from which searches go on; those that reached their target may get a lower one."""
    state, trace = previous.state, jax.tree.map(lambda x: x[:, -1], previous.trace)
    stop = jnp.where(state.stop == StopReason.TARGET, StopReason.RUNNING, state.stop)
    return _Begun(state._replace(stop=stop), trace, previous.iterations)


class _Rows(NamedTuple):
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
    begun: _Begun | None
    warm_start: Any


class _Loop(NamedTuple):
    """The loop over iterations, of a batch of objects.

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
        self, rows: _Rows, iterations: int
    ) -> tuple[Any, Int[Array, " object"], Trace, Float[Array, "object iteration d"]]:
        """States, iterations of each object, traces, and the best point after each iteration."""
        first = vary_like(self.first(rows), rows.codes)

        def iterate(now: _Begun, _: Any) -> tuple[_Begun, tuple[Trace, Array]]:
            running = now.state.stop == StopReason.RUNNING
            now = lax.cond(jnp.any(running), partial(self.move, rows), lambda now: now, now)
            return now, (now.trace, now.state.best.point)

        last, shown = lax.scan(iterate, first, length=iterations)
        over_iterations = partial(jnp.moveaxis, source=0, destination=1)
        traces, path = jax.tree.map(over_iterations, shown)
        return last.state, last.iterations, traces, path

    def first(self, rows: _Rows) -> _Begun:
        """The states at the start of the searches, or where they were interrupted."""
        if rows.begun is not None:
            begun = rows.begun
        else:
            keys = jax.vmap(jax.random.fold_in, (0, None))(rows.keys, 0)
            started = jax.vmap(self.begin)(
                keys, rows.codes, self.own, rows.first_losses, rows.warm_start
            )
            begun = _Begun(*started, jnp.zeros(len(rows.codes), jnp.int32))
        return begun._replace(state=_stop_at(self.target_loss, begun.state))

    def begin(
        self, key: Array, code: Array, own: ObjectTerms, loss: Any, state: Any
    ) -> tuple[Any, Trace]:
        """The first state of one object."""
        point = self.space.from_code(code) if state is None else state.best.point
        if loss is None or state is not None:
            loss = composed(self.how, self.space, own)(point)
        if state is None or self.refiner.resume is None:
            return self.refiner.init(key, point, loss)
        return self.refiner.resume(key, state, loss)

    def move(self, rows: _Rows, now: _Begun) -> _Begun:
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
        return _Begun(state, trace, iterations)


def _evaluation(prior, prepared, residual, penalty, codes, own) -> Evaluation:
    """The scoring of codes, with the first object of a batch as an example of shapes."""
    how = evaluation(prior.model, prepared, residual, penalty, codes[0], pick(own, 0))
    return how._replace(shared=one_network(how.shared))


def _best(
    how: Evaluation, own: ObjectTerms, states: Any, space: LatentSpace
) -> tuple[Float[Array, "object d"], Float[Array, "object x y z"], Float[Array, " object"]]:
    """Code, logits and objective of the best that each search has found.

    The final mean of a search was never evaluated: it is the mean of a population, or the point
    after the last gradient step. It may be better than the best candidate.
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
    return one_key_each(keys, len(codes))


def one_key_each(keys: Key[Array, "*object"], count: int) -> Key[Array, " object"]:
    """One key for each object, from one for each or one for all.

    Args:
        keys: One key for each object `[object]`, or one for all.
        count: Number of objects.

    Raises:
        ValueError: There are neither as many keys as objects nor one.
    """
    if not jnp.issubdtype(keys.dtype, jax.dtypes.prng_key):
        keys = jax.random.wrap_key_data(keys)
    if keys.ndim == 0:
        return jax.random.split(keys, count)
    if keys.shape != (count,):
        raise ValueError(
            f"There are keys of shape {keys.shape} for {count} objects; give one for each, "
            "jax.random.split(key, objects), or a single one."
        )
    return keys


def _stop_at(target_loss: Float[Array, ""] | float | None, states: Any) -> Any:
    """The states; objects whose loss has reached the target are stopped."""
    if target_loss is None:
        return states
    reached = states.best.loss <= target_loss
    return states._replace(stop=jnp.where(reached, StopReason.TARGET, states.stop))
