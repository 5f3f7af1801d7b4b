"""The refinement loop: many objects, each with its population, in one compiled program."""

from functools import partial
from typing import Any, NamedTuple

import jax
from jaxtyping import Array, Float, Key, PyTree

from jaxshape.refine.objective import Target, objective
from jaxshape.refine.refiner import Refiner, Trace, keep_better


class Refined(NamedTuple):
    """The outcome of a search for each object of a batch."""

    code: Float[Array, "object d"]
    """The best code that was evaluated."""
    loss: Float[Array, " object"]
    """Its objective, in nats per voxel; never above that of the first code."""
    trace: Trace
    """Per object and iteration."""
    state: Any
    """Of the refiner, one per object."""


def refine(
    keys: Key[Array, " object"],
    params: PyTree,
    codes: Float[Array, "object d"],
    targets: Target,
    refiner: Refiner,
    iterations: int,
) -> Refined:
    """Search from each object's first code for one that explains its target better (section 3.3).

    All candidates of all objects go through the decoder in one call per iteration. `keys` holds one
    key per object: objects do not influence each other, and find the same in any company.
    """
    search = partial(_refine_one, params, refiner, iterations)
    return jax.vmap(search)(keys, codes, targets)


def _refine_one(params, refiner: Refiner, iterations: int, key, code, target: Target) -> Refined:
    init_key, loop_key = jax.random.split(key)
    loss_of = lambda code: objective(params, code, target)  # noqa: E731
    state = refiner.init(init_key, code, loss_of(code))
    step = lambda state, key: refiner.step(key, state, loss_of)  # noqa: E731
    state, trace = jax.lax.scan(step, state, jax.random.split(loop_key, iterations))
    # Where the search stands at last was never evaluated: the mean of a population, or the code
    # after the last gradient step.
    best = keep_better(state.best, state.mean[None], loss_of(state.mean)[None])
    return Refined(best.code, best.loss, trace, state)
