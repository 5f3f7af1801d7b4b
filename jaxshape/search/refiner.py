"""What every search over a latent code has in common.

A `Refiner` is two pure functions over ONE point of the search space (`space.py`). `init` takes the
first point and its loss, `step` does one iteration; both return the search's state and a `Trace` of
scalars and small vectors to plot. Batch them with one `jax.vmap`; the candidates of all objects
then reach the decoder as one batch. `run.py` is the loop.

    state, trace = refiner.init(key, point, objective(point))
    for key in keys:
        state, trace = refiner.step(key, state, objective)
    state.best.point, state.best.loss, state.mean, state.stop
"""

from collections.abc import Callable
from enum import IntEnum
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

# The loss of one point; a refiner calls it under `jax.vmap` or `jax.grad`. A point that is not
# finite costs nothing and has the loss NaN.
Objective = Callable[[Float[Array, " d"]], Float[Array, ""]]


class StopReason(IntEnum):
    """Why a search ended. All but the first three are the criteria of pycma, by its names."""

    RUNNING = 0
    BUDGET = 1  # all iterations were used
    TARGET = 2  # the loss asked for was reached
    TOLFUN = 3  # losses of this and of recent iterations lie within tolfun
    TOLFUNHIST = 4  # the best losses of recent iterations lie within tolfunhist
    TOLX = 5  # the distribution is smaller than tolx
    TOLXSTAGNATION = 6  # the mean no longer moves
    TOLSTAGNATION = 7  # the medians of the losses no longer fall
    TOLFACUPX = 8  # the distribution grew a thousandfold: sigma0 was far too small
    TOLUPSIGMA = 9  # sigma grows while the distribution shrinks
    TOLCONDITIONCOV = 10  # the covariance is nearly singular
    TOLFLATFITNESS = 11  # the losses of a generation are equal, twice in a row
    NOEFFECT = 12  # a step along an axis or a coordinate is lost in rounding


class Candidate(NamedTuple):
    """A point together with its loss as it was evaluated."""

    point: Float[Array, " d"]
    loss: Float[Array, ""]


class Distribution(NamedTuple):
    """The normal distribution that a population is drawn from."""

    sigma: Float[Array, ""]
    """Step size, the scale that all axes share."""
    standard_deviations: Float[Array, " d"]
    """Of each coordinate."""
    axis_lengths: Float[Array, " d"]
    """Standard deviations along the principal axes, ascending: the eigen-spectrum, with sigma."""


class Trace(NamedTuple):
    """What a reader plots of one iteration."""

    best_loss: Float[Array, ""]
    """Lowest loss so far, the start included; never rises."""
    loss: Float[Array, ""]
    """Lowest finite loss of this iteration's candidates; else +inf."""
    spread: Float[Array, ""]
    """Standard deviation of the candidates, rms over the coordinates."""
    evaluations: Int[Array, ""]
    """Objectives evaluated so far, the start included."""
    distribution: Distribution | None = None
    """For searches that draw from one."""


class Refiner(NamedTuple):
    """A search over one point; every state has `best` (a `Candidate`), `mean` and `stop`.

    `init(key, point, loss)` takes the loss of the first point, so that `best` is never worse than
    the start and no iteration spends an evaluation on it. `step(key, state, objective)` is one
    iteration. `mean` is where the search stands: the centre of the distribution it samples, or the
    current iterate of a gradient method, whose loss may not have been evaluated. `stop` is a
    `StopReason`; a search without criteria of its own leaves it at RUNNING. `resume(key, state,
    loss)` starts again from the state of an earlier search whose objective has changed since, where
    `loss` is that of `state.best.point` now; without it, `init` at that point takes its place.
    """

    init: Callable[..., tuple[Any, Trace]]
    step: Callable[..., tuple[Any, Trace]]
    resume: Callable[..., tuple[Any, Trace]] | None = None


def finite_or_inf(losses: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Losses with NaN and both infinities set to +inf: a failed evaluation ranks last."""
    return jnp.where(jnp.isfinite(losses), losses, jnp.inf)


def keep_better(
    best: Candidate, points: Float[Array, "n d"], losses: Float[Array, " n"]
) -> Candidate:
    """The best candidate so far; ties and failed evaluations keep the earlier one."""
    losses = finite_or_inf(losses)
    winner = jnp.argmin(losses)
    improved = losses[winner] < best.loss
    return Candidate(
        jnp.where(improved, points[winner], best.point),
        jnp.where(improved, losses[winner], best.loss),
    )


def start_trace(first: Candidate, distribution: Distribution | None = None) -> Trace:
    """The trace of a search that has evaluated its first point only."""
    loss = finite_or_inf(first.loss)
    return Trace(loss, loss, jnp.zeros_like(loss), jnp.int32(1), distribution)


def summarise(
    best: Candidate,
    points: Float[Array, "n d"],
    losses: Float[Array, " n"],
    evaluations: Int[Array, ""],
    distribution: Distribution | None = None,
) -> Trace:
    """The trace of one iteration that evaluated `points`; `best` includes them already."""
    return Trace(
        best_loss=best.loss,
        loss=jnp.min(finite_or_inf(losses)),
        spread=jnp.sqrt(jnp.mean(jnp.var(points, axis=0))),
        evaluations=evaluations,
        distribution=distribution,
    )
