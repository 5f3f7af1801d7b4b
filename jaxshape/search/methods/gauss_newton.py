"""Levenberg-Marquardt on the Gauss-Newton matrix of the objective: `gauss-newton`.

The objective of a shape is nearly quadratic in the code: at the minimum of its quadratic model
about the best point, it is nearly as low as the model predicts. Each step goes to the minimum of
the model, in the directions in which the objective curves most (`curvature.py`), and is damped
where the model has proved wrong. `gauss-newton:20` takes 20 directions; as many as the dimension of
the code give the full matrix. On a CPU a product with the matrix takes as long as a gradient, and
the Jacobian of a 100-dimensional code as long as 47 gradients.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxshape.checks import at_least, positive, whole
from jaxshape.search.batching import select
from jaxshape.search.config import RefineConfig
from jaxshape.search.curvature import Expansion, Objective, expand, only_where
from jaxshape.search.refiner import (
    Candidate,
    Refiner,
    StopReason,
    Trace,
    finite_or_inf,
    keep_better,
    start_trace,
    summarise,
)

DIRECTIONS = 10
"""Directions of each expansion: with fewer the steps are shorter, with more they cost more."""

DAMPING = 2e-3
"""First damping, as a fraction of the largest curvature."""

EASIER, HARDER = 1 / 4, 4.0
"""Factors of the damping after a good and after a bad prediction of the model."""


class GaussNewtonState(NamedTuple):
    """The best point, and the quadratic model of the objective about it.

    Attributes:
        mean: The best point `[d]`.
        best: The best candidate so far.
        stop: Why the search ended, as a `StopReason`; RUNNING while it goes on.
        model: The objective about the best point: its gradient, and its curvature in the directions
            that were asked for.
        known: Whether the model was computed; before the first iteration it is all zeros.
        damping: Damping of the next step, as a fraction of the largest curvature.
        evaluations: Evaluations of the objective so far, the start included; a gradient is one, and
            so is a product with the matrix.
    """

    mean: Float[Array, " d"]
    best: Candidate
    stop: Int[Array, ""]
    model: Expansion
    known: Bool[Array, ""]
    damping: Float[Array, ""]
    evaluations: Int[Array, ""]


def build(variant: str | None, dim: int, config: RefineConfig) -> Refiner:
    """Levenberg-Marquardt with the number of directions that the variant gives."""
    if variant is not None and not variant.isdecimal():
        raise ValueError(
            f"There is no method 'gauss-newton:{variant}'; give a number of directions,"
            f" gauss-newton:{min(DIRECTIONS, dim)}."
        )
    directions = DIRECTIONS if variant is None else int(variant)
    return gauss_newton(dim=dim, directions=directions, tolerance=config.tolerance)


def gauss_newton(
    *,
    dim: int,
    directions: int = DIRECTIONS,
    damping: Float[Array, ""] | float = DAMPING,
    tolerance: Float[Array, ""] | float = 0.0,
) -> Refiner:
    """Levenberg-Marquardt steps to the minimum of the quadratic model about the best point.

    Each iteration evaluates one point. If the point is better than the best one, the model is
    computed again, at the cost of one gradient and `directions` products; if not, the damping
    grows. The first iteration only computes the model. The state keeps the model of the best point,
    so that the curvature of the objective can be read from it. The objectives of `refine` and
    `js.objective` have a Gauss-Newton matrix; for a plain function of JAX the matrix is the
    Hessian, whose negative curvature counts as 0.

    Args:
        dim: Dimension of a point, 1 or more.
        directions: Directions in which the curvature is computed, 1 or more; at most `dim` are
            used.
        damping: First damping, above 0, as a fraction of the largest curvature.
        tolerance: The search ends when the model promises to lower the loss by less than this, 0 or
            more, in the units of the loss; 0 never ends it.

    Returns:
        The search.

    Raises:
        ValueError: A setting is outside its range.
    """
    whole("dim", dim, 1)
    whole("directions", directions, 1)
    positive("damping", damping)
    at_least("tolerance", tolerance, 0)
    count = min(directions, dim)

    def init(
        key: Array, point: Float[Array, " d"], loss: Float[Array, ""]
    ) -> tuple[GaussNewtonState, Trace]:
        del key  # deterministic
        best = Candidate(point, finite_or_inf(loss))
        state = GaussNewtonState(
            mean=point,
            best=best,
            stop=jnp.int32(StopReason.RUNNING),
            model=_nothing(point, count),
            known=jnp.bool_(False),
            damping=jnp.asarray(damping, point.dtype),
            evaluations=jnp.int32(1),
        )
        return state, start_trace(best)

    def step(
        key: Array, state: GaussNewtonState, objective: Objective
    ) -> tuple[GaussNewtonState, Trace]:
        del key
        change, promised = damped_step(state.model, state.damping)
        point = state.mean + change
        loss = only_where(state.known, objective)(point)
        best = keep_better(state.best, point[None], loss[None])
        improved = best.loss < state.best.loss
        wanted = improved | ~state.known
        found = expand(only_where(wanted, objective), best.point, count)
        kept = (state.best.loss - loss) / promised  # NaN increases the damping
        factor = jnp.where(kept > 0.75, EASIER, jnp.where(kept > 0.25, 1, HARDER))
        is_still = promised < jnp.maximum(tolerance, jnp.finfo(loss.dtype).eps * jnp.abs(best.loss))
        stopped = state.known & is_still & (tolerance > 0)
        state = GaussNewtonState(
            mean=best.point,
            best=best,
            stop=jnp.where(stopped, jnp.int32(StopReason.TOLFUN), jnp.int32(StopReason.RUNNING)),
            model=select(wanted, found, state.model),
            known=jnp.bool_(True),
            damping=state.damping * jnp.where(state.known, factor, 1).astype(loss.dtype),
            evaluations=state.evaluations + state.known + jnp.where(wanted, 1 + count, 0),
        )
        shown = jnp.where(wanted, best.loss, loss)
        return state, summarise(best, point[None], shown[None], state.evaluations)

    def resume(
        key: Array, state: GaussNewtonState, loss: Float[Array, ""]
    ) -> tuple[GaussNewtonState, Trace]:
        fresh, trace = init(key, state.best.point, loss)
        return fresh._replace(damping=state.damping), trace

    return Refiner(init, step, resume)


def damped_step(
    model: Expansion, damping: Float[Array, ""] | float
) -> tuple[Float[Array, " d"], Float[Array, ""]]:
    """The minimum of a quadratic model with a multiple of I added to its curvature.

    Args:
        model: The objective about a point. Negative curvature counts as 0.
        damping: The multiple, above 0, as a fraction of the largest curvature.

    Returns:
        The step from the point to the minimum `[d]`, and the decrease of the loss that the undamped
        model predicts for it.
    """
    values, axes = jnp.linalg.eigh(model.matrix)
    values = jnp.maximum(values, 0)
    slopes = axes.T @ (model.directions @ model.slope)
    damped = values + damping * values[-1]
    lengths = jnp.where(damped > 0, -slopes / jnp.where(damped > 0, damped, 1), 0)
    promised = -jnp.sum(lengths * (slopes + values * lengths / 2))
    return (axes @ lengths) @ model.directions, promised


def _nothing(point: Float[Array, " d"], count: int) -> Expansion:
    """A model of zeros, for a search that has computed none yet."""
    zeros = lambda *shape: jnp.zeros(shape, point.dtype)  # noqa: E731
    return Expansion(zeros(), zeros(len(point)), zeros(count, len(point)), zeros(count, count))
