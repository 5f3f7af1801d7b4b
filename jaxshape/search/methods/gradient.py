"""Descent along the gradient: `gradient`, and any optax optimiser, `gradient:adam`, ...

Optimisers of `optax.contrib` are found by name, too, as in `gradient:prodigy`.
"""

import functools
import inspect
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
import optax.contrib
import optax.tree_utils
from jaxtyping import Array, Float, Int

from jaxshape.checks import at_least, positive, whole
from jaxshape.search.batching import cast_like, select
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
"""Step size of plain descent: the paper's for raw codes; for whitened codes the best on procedural
chairs, where descent oscillates only with three times this step."""

LIKE_PLAIN_DESCENT = {
    "adagrad",
    "momo",
    "optimistic_gradient_descent",
    "polyak_sgd",
    "schedule_free_sgd",
    "sgd",
}
"""Optimisers whose steps are as short as the gradient, so that they need the step size of plain
descent."""

LEARNING_RATE = 0.1
"""Learning rate of optimisers without an entry below, in either space; most of them turn the
gradient into steps of about this length in each coordinate."""

LEARNING_RATES = (
    dict.fromkeys(["adafactor", "fromage", "lamb", "lion", "rmsprop"], 0.02)
    | dict.fromkeys(["sign_sgd", "signum", "simplified_ademamix"], 0.02)
    | dict.fromkeys(["momo_adam", "schedule_free_adamw"], LEARNING_RATE)
    | dict.fromkeys(["madgrad", "radam", "sm3", "yogi"], 1.0)
    | {"acprop": 0.005, "adadelta": 20.0, "lars": 20.0}
)
"""Learning rates of optimisers that need another one: the best of 0.02, 0.1, 1 and 20 on procedural
chairs. With the defaults of optax, `adadelta` climbs and `adafactor` diverges."""

UNUSABLE = {
    "dpsgd": "it clips the gradients of single examples, and an objective has only one gradient",
    "lookahead": "it changes another optimiser",
    "mechanize": "it changes another optimiser",
    "sam": "it changes another optimiser",
    "schedule_free": "it changes another optimiser",
    "sophia": "it estimates the Hessian, and the objective of a shape has first derivatives only",
}
"""Optimisers that cannot be chosen by name, and the reason."""


class GradientState(NamedTuple):
    """The current iterate, the optimiser's own state, and the best point that was evaluated.

    Attributes:
        mean: The current iterate `[d]`, which may not have been evaluated.
        best: The best candidate so far.
        stop: Why the search ended, as a `StopReason`; RUNNING while it goes on.
        optimizer_state: State of the optax optimiser.
        evaluations: Evaluations of the objective so far, the start included.
        last_loss: Loss of the previous iteration.
        still: Iterations in a row that changed the loss by less than the tolerance.
    """

    mean: Float[Array, " d"]
    best: Candidate
    stop: Int[Array, ""]
    optimizer_state: optax.OptState
    evaluations: Int[Array, ""]
    last_loss: Float[Array, ""]
    still: Int[Array, ""]


def build(variant: str | None, dim: int, config: RefineConfig) -> Refiner:
    """Plain descent, or the optax optimiser named by the variant."""
    del dim
    if variant is None:
        step_size = STEP_SIZES[config.space] if config.step_size is None else config.step_size
        return gradient(step_size, tolerance=config.tolerance)
    return gradient(_optimizer(variant, config), tolerance=config.tolerance)


def optimizers() -> dict[str, Callable[..., optax.GradientTransformation]]:
    """The optimisers of optax and optax.contrib that need at most a learning rate, by name."""
    both = vars(optax.contrib) | vars(optax)
    names = sorted(name for name, x in both.items() if _is_optimizer(name, x))
    return {name: both[name] for name in names if name not in UNUSABLE}


def _is_optimizer(name: str, x: Any) -> bool:
    is_function = inspect.isfunction(x) or isinstance(x, functools.partial)
    return is_function and not name.startswith(("_", "scale_by")) and bool(_rate_name(x))


def _rate_name(factory: Callable[..., Any]) -> str:
    """Name of the factory's argument for the learning rate; empty if it has none."""
    names = inspect.signature(factory).parameters
    return next((name for name in ("learning_rate", "max_learning_rate") if name in names), "")


def _optimizer(name: str, config: RefineConfig) -> optax.GradientTransformation:
    """The optimiser of that name, with the learning rate of the settings or a good one."""
    if name in UNUSABLE:
        raise ValueError(
            f"gradient:{name} cannot be used: {UNUSABLE[name]}. Build your own search from it with"
            " jaxshape.gradient."
        )
    factory = optimizers().get(name)
    if factory is None:
        raise ValueError(
            f"optax has no optimiser {name!r} that needs only a learning rate; choose, for"
            " example, adam, lbfgs or rmsprop."
        )
    rate = config.step_size
    if rate is None:
        rate = STEP_SIZES[config.space] if name in LIKE_PLAIN_DESCENT else LEARNING_RATES.get(name)
    arguments = inspect.signature(factory).parameters
    argument = arguments[_rate_name(factory)]
    if rate is None and argument.default is argument.empty:
        rate = LEARNING_RATE
    settings: dict[str, Any] = {} if rate is None else {argument.name: rate}
    if "key" in arguments:  # optimisers that add noise
        settings["key"] = 0
    return factory(**settings)


def gradient(
    optimizer: optax.GradientTransformation | Float[Array, ""] | float,
    *,
    tolerance: Float[Array, ""] | float = 0.0,
    patience: int = 10,
) -> Refiner:
    """Descend the gradient of the objective.

    Optimisers with a line search (`optax.lbfgs`) work too; the line search evaluates the objective
    more than once per step. Each step evaluates the current point and then moves it, so the end
    point of the last step is in `mean`, but not in `best`. A loss or gradient that is not finite
    sends the search back to the best point, with the optimiser started afresh; where the same step
    fails every time, the search stays there.

    Args:
        optimizer: An optax optimiser, or a number above 0: the step size of plain descent (paper:
            0.14).
        tolerance: The search ends when the loss has changed by less than this for `patience` steps
            in a row, 0 or more, in the units of the loss; 0 never ends it.
        patience: Steps in a row, 1 or more.

    Returns:
        The search.

    Raises:
        ValueError: A setting is outside its range.
    """
    at_least("tolerance", tolerance, 0)
    whole("patience", patience, 1)
    if not isinstance(optimizer, optax.GradientTransformation):
        positive("step_size", optimizer)
        optimizer = optax.sgd(optimizer)
    transformation = optax.with_extra_args_support(optimizer)

    def init(
        key: Array, point: Float[Array, " d"], loss: Float[Array, ""]
    ) -> tuple[GradientState, Trace]:
        del key  # deterministic
        best = Candidate(point, finite_or_inf(loss))
        zero, one = jnp.int32(0), jnp.int32(1)
        state = GradientState(
            point, best, zero, transformation.init(point), one, jnp.full_like(loss, jnp.inf), zero
        )
        return state, start_trace(best)

    def step(key: Array, state: GradientState, objective: Objective) -> tuple[GradientState, Trace]:
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
        mean, optimizer_state = select(usable, cast_like(moved, restarted), restarted)
        is_still = jnp.abs(loss - state.last_loss) < tolerance
        still = jnp.where(is_still, state.still + 1, 0)
        searched = optax.tree_utils.tree_get(optimizer_state, "num_linesearch_steps", 0)
        state = GradientState(
            mean=mean,
            best=best,
            stop=jnp.where(still >= patience, jnp.int32(StopReason.TOLFUNHIST), jnp.int32(0)),
            optimizer_state=optimizer_state,
            evaluations=state.evaluations + 1 + jnp.int32(searched),
            last_loss=loss,
            still=still,
        )
        return state, summarise(best, point[None], loss[None], state.evaluations)

    return Refiner(init, step)
