"""Refinement: the searches of many objects in one compiled program (the loop is in `loop`)."""

import math
from typing import Any, NamedTuple, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key, PyTree

from jaxshape import checks
from jaxshape.geometry.grids import Grids
from jaxshape.model.chunks import vary_like
from jaxshape.model.shapes import Precision, ShapePrior, as_codes, pick
from jaxshape.search.devices import over_devices
from jaxshape.search.keys import keys_of
from jaxshape.search.loop import Callback, Loop, Rows, SearchState, require_rows
from jaxshape.search.objective import (
    Evaluation,
    ObjectTerms,
    Penalty,
    evaluation,
    prepare_one,
)
from jaxshape.search.refiner import (
    Refiner,
    StopReason,
    Trace,
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
        ValueError: An argument is of another type or out of its range, the arguments do not belong
            to the same number of objects, both `previous` and `warm_start` are given, or `jax.vmap`
            is asked to search with several networks at once.
    """
    require_types(prior, refiner, residual)
    checks.whole("iterations", iterations, 1)
    checks.one_of("precision", precision, get_args(Precision))
    checks.at_least("penalty_weight", penalty_weight, 0)
    if target_loss is not None:
        checks.within("target_loss", target_loss, -math.inf, math.inf)
    if space is not None:
        checks.instance("space", space, LatentSpace, "whitened(prior)")
    for name, function in (("penalty", penalty), ("callback", callback)):
        if not (function is None or callable(function)):
            checks.refuse(name, function, "a function, or None")
    if previous is not None:
        checks.instance("previous", previous, Refined, "refine")
    if targets is None:
        checks.refuse("targets", targets, "the targets of all objects, jax.vmap(residual.target)")
    if previous is not None and warm_start is not None:
        raise ValueError(
            "Both previous and warm_start are given; give previous to go on with the same targets,"
            " warm_start for a new search near an earlier one."
        )
    rows = Rows(
        keys=keys_of(keys, codes, prior),
        codes=as_codes(prior, codes),
        targets=targets,
        grids=grids,
        first_losses=first_losses,
        begun=None if previous is None else _begun(previous),
        warm_start=warm_start,
    )
    alike = rows._asdict()
    require_rows(len(alike.pop("codes")), **alike)
    space = raw(prior) if space is None else space

    def search(shared, rows):
        prior, space, weight, target_loss = vary_like(shared, rows.codes)
        searched = prepare_one(prior, rows.grids, precision)
        own = ObjectTerms(
            searched.own, rows.targets, jnp.full(len(rows.codes), weight, jnp.float32)
        )
        how = _evaluation(prior, searched, residual, penalty, rows.codes, own)
        loop = Loop(refiner, how, space, own, target_loss, callback)
        states, steps, traces, path = loop.run(rows, iterations)
        if precision != "float32":
            exact = prepare_one(prior, rows.grids, "float32")
            how = how._replace(shared=(exact.shared, how.shared[1]))
            own = own._replace(features=exact.own)
        code, logits, loss = _best(how, own, states, space, rows.codes)
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


def require_types(prior: ShapePrior, refiner: Refiner | None, residual: Residual) -> None:
    """Raise `ValueError` where a name or a function is given instead of the object."""
    checks.instance("prior", prior, ShapePrior, "load_prior")
    if refiner is not None:
        checks.instance("refiner", refiner, Refiner, "build_refiner")
    checks.instance("residual", residual, Residual, "Residual(target, score)")


def _begun(previous: Refined) -> SearchState:
    """The states from which searches go on; those that reached their target may get a lower one."""
    state, trace = previous.state, jax.tree.map(lambda x: x[:, -1], previous.trace)
    stop = jnp.where(state.stop == StopReason.TARGET, StopReason.RUNNING, state.stop)
    return SearchState(state._replace(stop=stop), trace, previous.iterations)


def _evaluation(prior, prepared, residual, penalty, codes, own) -> Evaluation:
    """The scoring of codes, with the first object of a batch as an example of shapes."""
    how = evaluation(prior.model, prepared, residual, penalty, codes[0], pick(own, 0))
    return how._replace(shared=one_network(how.shared))


def _best(
    how: Evaluation,
    own: ObjectTerms,
    states: Any,
    space: LatentSpace,
    first: Float[Array, "object d"],
) -> tuple[Float[Array, "object d"], Float[Array, "object x y z"], Float[Array, " object"]]:
    """Code, logits and objective of the best that each search has found.

    The final mean of a search was never evaluated: it is the mean of a population, or the point
    after the last gradient step. It may be better than the best candidate. A search of your own may
    lose its best candidate to NaN; the first code stands in for it.
    """
    points = jnp.stack([states.best.point, states.mean], axis=1)
    codes = jax.vmap(jax.vmap(space.to_code))(points)
    is_code = jnp.all(jnp.isfinite(codes), axis=-1, keepdims=True)
    codes = jnp.where(is_code, codes, first[:, None])
    count, two, d = codes.shape
    owner = jnp.repeat(jnp.arange(count), two)
    logits, losses = how.shape(how.shared, codes.reshape(-1, d), own, owner)
    better = jnp.argmin(finite_or_inf(losses).reshape(count, two), axis=1)
    row = two * jnp.arange(count) + better
    return codes.reshape(-1, d)[row], logits[row], losses[row]
