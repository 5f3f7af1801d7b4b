"""The interface of every search over a latent code.

A `Refiner` is two pure functions over ONE point of the search space (`space.py`). `init` takes the
first point and its loss, `step` does one iteration; both return the search's state and a `Trace` of
scalars and small vectors to plot. Batch them with one `jax.vmap`; the candidates of all objects
then reach the decoder as one batch. `run.py` is the loop.

    state, trace = refiner.init(key, point, objective(point))
    for key in keys:
        state, trace = refiner.step(key, state, objective)
    state.best.point, state.best.loss, state.mean, state.stop
"""

from collections.abc import Callable, Iterator
from enum import IntEnum
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxshape.search.batching import select
from jaxshape.search.curvature import Objective, only_where


class StopReason(IntEnum):
    """Why a search ended. All but the first three are criteria of pycma, by its names.

    Attributes:
        RUNNING: The search goes on (0).
        BUDGET: All iterations were used (1).
        TARGET: The requested loss was reached (2).
        TOLFUN: Losses of this and of recent iterations lie within `tolfun` (3).
        TOLFUNHIST: The best losses of recent iterations lie within `tolfunhist` (4).
        TOLX: The distribution is smaller than `tolx` (5).
        TOLXSTAGNATION: The mean no longer moves (6).
        TOLSTAGNATION: The medians of the losses no longer fall (7).
        TOLFACUPX: The distribution grew a thousandfold, since sigma0 was far too small (8).
        TOLUPSIGMA: Sigma grows while the distribution shrinks (9).
        TOLCONDITIONCOV: The covariance is nearly singular (10).
        TOLFLATFITNESS: The losses of a generation were equal twice in a row (11).
        NOEFFECT: A step along an axis or a coordinate is lost in rounding (12).
    """

    RUNNING = 0
    BUDGET = 1
    TARGET = 2
    TOLFUN = 3
    TOLFUNHIST = 4
    TOLX = 5
    TOLXSTAGNATION = 6
    TOLSTAGNATION = 7
    TOLFACUPX = 8
    TOLUPSIGMA = 9
    TOLCONDITIONCOV = 10
    TOLFLATFITNESS = 11
    NOEFFECT = 12


class Candidate(NamedTuple):
    """A point together with its loss as it was evaluated.

    Attributes:
        point: Coordinates in the search space `[d]`.
        loss: Loss of the point; +inf where the evaluation failed or was not made.
    """

    point: Float[Array, " d"]
    loss: Float[Array, ""]


class Distribution(NamedTuple):
    """The normal distribution that a population is drawn from.

    Attributes:
        sigma: Step size, the scale that all axes share.
        standard_deviations: Standard deviation of each coordinate `[d]`, in units of the search
            space.
        axis_lengths: Standard deviations along the principal axes `[d]`, ascending: square roots of
            the eigenvalues of sigma^2 C.
    """

    sigma: Float[Array, ""]
    standard_deviations: Float[Array, " d"]
    axis_lengths: Float[Array, " d"]


class Trace(NamedTuple):
    """Figures of one iteration, for plots and tables.

    Attributes:
        best_loss: Lowest loss so far, the start included; it never rises.
        loss: Lowest finite loss of this iteration's candidates; +inf where all failed.
        spread: Standard deviation of the candidates, root mean square over the coordinates.
        evaluations: Evaluations of the objective so far, the start included.
        distribution: The distribution that candidates are drawn from; None for searches that have
            none.
    """

    best_loss: Float[Array, ""]
    loss: Float[Array, ""]
    spread: Float[Array, ""]
    evaluations: Int[Array, ""]
    distribution: Distribution | None = None


class Refiner(NamedTuple):
    """A search over one point; batch it with `jax.vmap`.

    Every state has `best` (a `Candidate`), `mean` and `stop`. `mean` is the centre of the
    distribution that the search samples, or the current iterate of a gradient method, whose loss
    may not have been evaluated. `stop` is a `StopReason`; a search without criteria of its own
    leaves it at RUNNING. Numbers have the type of the point, counters are int32.

    An objective is called under `jax.vmap` or `jax.grad`; those of `refine` have a Gauss-Newton
    matrix, too (`jaxshape.search.curvature.expand`).

    Attributes:
        init: `(key, point [d], loss) -> state, trace`. It takes the loss of the first point, so
            that `best` is never worse than the start and no iteration spends an evaluation on it.
        step: `(key, state, objective) -> state, trace`, one iteration.
        resume: `(key, state, loss) -> state, trace`, which starts again from the state of an
            earlier search whose objective has changed since; `loss` is the present loss of
            `state.best.point`. None starts again by `init` at that point.
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
        trace: Trace of the previous iteration.
        objective: The loss of one point. A search that has stopped asks for points that are not
            finite.

    Returns:
        State and trace after the iteration; the same as before where the search has stopped.
    """
    running = state.stop == StopReason.RUNNING
    stepped = as_promised("step", refiner.step(key, state, only_where(running, objective)))
    _require_same(stepped, (state, trace))
    return select(running, stepped, (state, trace))


def as_promised(function: str, returned: Any) -> tuple[Any, Trace]:
    """Check that a function of a search returned a state and a trace, and return them.

    Args:
        function: Name of the function, `init`, `step` or `resume`.
        returned: What it returned.

    Raises:
        ValueError: It is not what `Refiner` promises.
    """
    is_pair = isinstance(returned, tuple) and len(returned) == 2 and isinstance(returned[1], Trace)
    fields = getattr(returned[0], "_fields", ()) if is_pair else ()
    if not {"best", "mean", "stop"} <= set(fields):
        raise ValueError(
            f"{function} of the search must return a state and a jaxshape.Trace; the state is a"
            " NamedTuple with best, mean and stop (jaxshape.Refiner explains them)."
        )
    return returned


def _require_same(stepped: tuple[Any, Trace], before: tuple[Any, Trace]) -> None:
    """Refuse a step that changes the shape or type of an array: compiled loops do not allow it."""
    new, old = dict(_kinds(stepped)), dict(_kinds(before))
    for name in old | new:
        if new.get(name) != old.get(name):
            raise ValueError(
                f"step of the search returned {name} as {new.get(name)}; it was {old.get(name)}"
                " before, and shapes and types must stay as init returns them."
            )


def _kinds(pair: tuple[Any, Trace]) -> Iterator[tuple[str, str]]:
    """Name, and type with shape, of each array of a state and its trace."""
    for tree, name in zip(pair, ("state", "trace"), strict=True):
        for path, x in jax.tree_util.tree_leaves_with_path(tree):
            kind = jax.typeof(x)
            yield name + jax.tree_util.keystr(path), f"{kind.dtype}{list(kind.shape)}"


def finite_or_inf(losses: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Rank failed evaluations last.

    Args:
        losses: Losses of any shape, finite or not.

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
        points: Points that were evaluated since `[n d]`.
        losses: Their losses `[n]`, in any order; NaN and infinite ones are failed evaluations.

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
        distribution: The distribution that candidates will be drawn from; None for searches that
            have none.

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
        best: The best candidate so far, including this iteration.
        points: Candidates of this iteration `[n d]`.
        losses: Losses of these candidates `[n]`.
        evaluations: Evaluations of the objective so far, the start included.
        distribution: The distribution that candidates are drawn from now; None for searches that
            have none.

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
