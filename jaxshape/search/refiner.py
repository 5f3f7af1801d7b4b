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

from jaxshape.search.batching import select

# The loss of one point, in the point's own type; a refiner calls it under `jax.vmap` or `jax.grad`.
# A point that is not finite costs nothing and has the loss NaN.
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
    """A point together with its loss as it was evaluated.

    Attributes:
        point: Coordinates in the search space.
        loss: Its loss; +inf where it failed or was not evaluated.
    """

    point: Float[Array, " d"]
    loss: Float[Array, ""]


class Distribution(NamedTuple):
    """The normal distribution that a population is drawn from.

    Attributes:
        sigma: Step size, the scale that all axes share.
        standard_deviations: Standard deviation of each coordinate.
        axis_lengths: Standard deviations along the principal axes, ascending: the eigen-spectrum,
            with sigma.
    """

    sigma: Float[Array, ""]
    standard_deviations: Float[Array, " d"]
    axis_lengths: Float[Array, " d"]


class Trace(NamedTuple):
    """What a reader plots of one iteration.

    Attributes:
        best_loss: Lowest loss so far, the start included; never rises.
        loss: Lowest finite loss of this iteration's candidates; +inf where all failed.
        spread: Standard deviation of the candidates, rms over the coordinates.
        evaluations: Objectives evaluated so far, the start included.
        distribution: What candidates are drawn from; None for searches that draw from none.
    """

    best_loss: Float[Array, ""]
    loss: Float[Array, ""]
    spread: Float[Array, ""]
    evaluations: Int[Array, ""]
    distribution: Distribution | None = None


class Refiner(NamedTuple):
    """A search over one point; batch it with `jax.vmap`.

    Every state has `best` (a `Candidate`), `mean` and `stop`. `mean` is where the search stands:
    the centre of the distribution it samples, or the current iterate of a gradient method, whose
    loss may not have been evaluated. `stop` is a `StopReason`; a search without criteria of its
    own leaves it at RUNNING. Numbers have the type of the point, counters are int32.

    Attributes:
        init: `(key, point, loss) -> state, trace`. It takes the loss of the first point, so that
            `best` is never worse than the start and no iteration spends an evaluation on it.
        step: `(key, state, objective) -> state, trace`, one iteration.
        resume: `(key, state, loss) -> state, trace`, which starts again from the state of an
            earlier search whose objective has changed since; `loss` is that of `state.best.point`
            now. Without it, `init` at that point takes its place.
    """

    init: Callable[..., tuple[Any, Trace]]
    step: Callable[..., tuple[Any, Trace]]
    resume: Callable[..., tuple[Any, Trace]] | None = None


def advance(
    refiner: Refiner, key: Array, state: Any, trace: Trace, objective: Objective
) -> tuple[Any, Trace]:
    """One iteration of a search that may have stopped, for loops over a batch.

    Args:
        refiner: The search.
        key: Random key of this iteration.
        state: The search's state.
        trace: Of the iteration before.
        objective: The loss of one point. A search that has stopped asks for points that are not
            finite.

    Returns:
        State and trace after the iteration; the same as before where the search has stopped.
    """
    running = state.stop == StopReason.RUNNING
    awake = lambda point: objective(jnp.where(running, point, jnp.nan))  # noqa: E731
    return select(running, refiner.step(key, state, awake), (state, trace))


def finite_or_inf(losses: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Rank failed evaluations last.

    Args:
        losses: Any numbers.

    Returns:
        The losses, with +inf for NaN and for both infinities.
    """
    return jnp.where(jnp.isfinite(losses), losses, jnp.inf)


def keep_better(
    best: Candidate, points: Float[Array, "n d"], losses: Float[Array, " n"]
) -> Candidate:
    """The best candidate so far; ties and failed evaluations keep the earlier one.

    Args:
        best: The best candidate before.
        points: What was evaluated since.
        losses: Their losses, in any order; NaN and infinite ones are failed evaluations.

    Returns:
        `best`, or the first of the points with the lowest loss where that is lower.
    """
    losses = finite_or_inf(losses)
    winner = jnp.argmin(losses)
    improved = losses[winner] < best.loss
    return Candidate(
        jnp.where(improved, points[winner], best.point),
        jnp.where(improved, losses[winner], best.loss),
    )


def start_trace(first: Candidate, distribution: Distribution | None = None) -> Trace:
    """The trace of a search that has evaluated its first point only.

    Args:
        first: The first point and its loss.
        distribution: What candidates will be drawn from, in searches that have one.

    Returns:
        A trace with one evaluation and no spread.
    """
    loss = finite_or_inf(first.loss)
    return Trace(loss, loss, jnp.zeros_like(loss), jnp.int32(1), distribution)


def summarise(
    best: Candidate,
    points: Float[Array, "n d"],
    losses: Float[Array, " n"],
    evaluations: Int[Array, ""],
    distribution: Distribution | None = None,
) -> Trace:
    """The trace of one iteration.

    Args:
        best: The best candidate so far, those of this iteration included.
        points: Candidates of this iteration.
        losses: Their losses.
        evaluations: Objectives evaluated so far, the start included.
        distribution: What candidates are drawn from now, in searches that have one.

    Returns:
        The trace.
    """
    return Trace(
        best_loss=best.loss,
        loss=jnp.min(finite_or_inf(losses)),
        spread=jnp.sqrt(jnp.mean(jnp.var(points, axis=0))),
        evaluations=evaluations,
        distribution=distribution,
    )
