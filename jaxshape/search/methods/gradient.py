"""Descent along the gradient: `gradient`, and any optax optimiser, `gradient:adam`, ..."""

import inspect
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
import optax.tree_utils
from jaxtyping import Array, Float, Int

from jaxshape.search.batching import select
from jaxshape.search.config import RefineConfig
from jaxshape.search.refiner import (
    Candidate,
    Objective,
    Refiner,
    StopReason,
    Trace,
    finite_or_inf,
    keep_better,
    start_trace,
    summarise,
)

STEP_SIZES = {"raw": 0.14, "whitened": 20.0}
"""Of plain descent: the paper's for codes, and for whitened codes one that is as good as any on
procedural chairs and oscillates only at three times its length."""

LEARNING_RATE = 0.1
"""Of optax optimisers that have none of their own, in either space; most turn the gradient into
steps of about this length in each coordinate."""


class State(NamedTuple):
    """The current iterate, the optimiser's own state, and the best point that was evaluated."""

    mean: Float[Array, " d"]
    best: Candidate
    stop: Int[Array, ""]
    optimizer_state: optax.OptState
    evaluations: Int[Array, ""]
    last_loss: Float[Array, ""]
    still: Int[Array, ""]  # iterations in a row that changed the loss by less than the tolerance


def build(variant: str | None, dim: int, config: RefineConfig) -> Refiner:
    """Plain descent, or the optax optimiser named by the variant."""
    del dim
    if variant is None:
        step_size = STEP_SIZES[config.space] if config.step_size is None else config.step_size
        return gradient(step_size, tolerance=config.tolerance)
    return gradient(_optimizer(variant, config.step_size), tolerance=config.tolerance)


def _optimizer(name: str, step_size: float | None) -> optax.GradientTransformation:
    factory = vars(optax).get(name)
    settings = inspect.signature(factory).parameters if inspect.isfunction(factory) else {}
    needed = {setting for setting, x in settings.items() if x.default is x.empty}
    if not inspect.isfunction(factory) or not needed <= {"learning_rate"} <= settings.keys():
        raise ValueError(
            f"optax has no optimiser {name!r} that needs a learning rate at most; adam, lbfgs and"
            " rmsprop are some that it has."
        )
    if step_size is not None:
        return factory(learning_rate=step_size)
    return factory(learning_rate=LEARNING_RATE) if needed else factory()


def gradient(
    optimizer: optax.GradientTransformation | float, *, tolerance: float = 0.0, patience: int = 10
) -> Refiner:
    """Descend the gradient of the objective; a number is a fixed step (0.14 in the paper).

    Optimisers with a line search (`optax.lbfgs`) work too; theirs evaluates the objective more
    than once per step. Each step evaluates the current point and then moves it, so the point that
    the last step arrives at is in `mean` and not yet in `best`. A loss or gradient that is not
    finite sends the search back to the best point, with the optimiser started afresh; where the
    same step fails every time, the search stays there. It ends when the loss has changed by less
    than `tolerance` for `patience` steps in a row; 0 never ends it.
    """
    if not isinstance(optimizer, optax.GradientTransformation):
        optimizer = optax.sgd(optimizer)
    transformation = optax.with_extra_args_support(optimizer)

    def init(key: Array, point: Float[Array, " d"], loss: Float[Array, ""]) -> tuple[State, Trace]:
        del key  # deterministic
        best = Candidate(point, finite_or_inf(loss))
        zero, one = jnp.int32(0), jnp.int32(1)
        state = State(
            point, best, zero, transformation.init(point), one, jnp.full_like(loss, jnp.inf), zero
        )
        return state, start_trace(best)

    def step(key: Array, state: State, objective: Objective) -> tuple[State, Trace]:
        del key
        point = state.mean
        loss, slope = jax.value_and_grad(objective)(point)
        updates, optimizer_state = transformation.update(
            slope, state.optimizer_state, point, value=loss, grad=slope, value_fn=objective
        )
        best = keep_better(state.best, point[None], loss[None])
        moved = (optax.apply_updates(point, updates), optimizer_state)
        restarted = (best.point, transformation.init(best.point))
        usable = jnp.isfinite(loss) & jnp.all(jnp.isfinite(slope))
        mean, optimizer_state = select(usable, moved, restarted)
        is_still = jnp.abs(loss - state.last_loss) < tolerance
        still = jnp.where(is_still, state.still + 1, 0)
        searched = optax.tree_utils.tree_get(optimizer_state, "num_linesearch_steps", 0)
        state = State(
            mean=mean,
            best=best,
            stop=jnp.where(still >= patience, StopReason.TOLFUNHIST, StopReason.RUNNING),
            optimizer_state=optimizer_state,
            evaluations=state.evaluations + 1 + jnp.int32(searched),
            last_loss=loss,
            still=still,
        )
        return state, summarise(best, point[None], loss[None], state.evaluations)

    return Refiner(init, step)
