"""Gradient descent over a latent code, with any optax optimiser."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from jaxshape.refine.refiner import (
    Candidate,
    Objective,
    Refiner,
    Trace,
    finite_or_inf,
    keep_better,
    summarise,
)


class State(NamedTuple):
    """The current iterate, the optimiser's own state, and the best code that was evaluated."""

    mean: Float[Array, " d"]
    best: Candidate
    optimizer_state: optax.OptState


def gradient(optimizer: optax.GradientTransformation | float) -> Refiner:
    """Descend the gradient of the objective; a number is a fixed step (0.14 in the paper).

    Optimisers with a line search (`optax.lbfgs`) work too; theirs evaluates the objective more
    than once per step. Each step evaluates the current code and then moves it, so the code that
    the last step arrives at is in `mean` and not yet in `best`. A loss or gradient that is not
    finite sends the search back to the best code, with the optimiser started afresh; where the
    same step fails every time, the search stays there.
    """
    if not isinstance(optimizer, optax.GradientTransformation):
        optimizer = optax.sgd(optimizer)
    transformation = optax.with_extra_args_support(optimizer)

    def init(key: Array, code: Float[Array, " d"], loss: Float[Array, ""]) -> State:
        del key  # deterministic
        return State(code, Candidate(code, finite_or_inf(loss)), transformation.init(code))

    def step(key: Array, state: State, objective: Objective) -> tuple[State, Trace]:
        del key
        code = state.mean
        loss, slope = jax.value_and_grad(objective)(code)
        updates, optimizer_state = transformation.update(
            slope, state.optimizer_state, code, value=loss, grad=slope, value_fn=objective
        )
        best = keep_better(state.best, code[None], loss[None])
        moved = (optax.apply_updates(code, updates), best, optimizer_state)
        restarted = (best.code, best, transformation.init(best.code))
        usable = jnp.isfinite(loss) & jnp.all(jnp.isfinite(slope))
        state = jax.tree.map(lambda new, old: jnp.where(usable, new, old), moved, restarted)
        return State(*state), summarise(best, code[None], loss[None])

    return Refiner(init, step)
