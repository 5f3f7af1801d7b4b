"""When a search by CMA-ES is over: the criteria of pycma, per object, inside the compiled loop.

The names are pycma's. Two differences: `tolstagnation` compares windows of a fixed length, where
pycma's grow with very long runs; and losses closer than their own rounding count as equal, since
in float32 an absolute `tolfun` of 1e-11 would never be met by losses near 1.
"""

import math
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxshape.checks import one_of, within
from jaxshape.search.batching import apply_if
from jaxshape.search.config import Number
from jaxshape.search.refiner import StopReason, finite_or_inf

RECORD_EVERY = 5
"""Generations between entries of the long history."""


@dataclass(frozen=True)
class Tolerances:
    """Thresholds of the stop criteria of CMA-ES, by pycma's names, each 0 or more.

    0 turns a criterion off; infinity turns an upper limit off. A range or a length below its
    threshold ends the search.

    Attributes:
        tolfun: Range of the losses of a generation and of the best losses of recent ones.
        tolfunhist: Range of the best losses of recent generations.
        tolx: Standard deviation of every coordinate, in units of the search space.
        tolxstagnation: Distance that the mean moves over 20 generations plus a tenth of all so far,
            in units of the search space.
        tolstagnation: Whether to end after 100 + 100 d^1.5 / population generations without falling
            medians.
        tolfacupx: Growth of a coordinate's standard deviation over sigma0; an upper limit.
        tolupsigma: Growth of sigma over sigma0 and over the longest axis; an upper limit.
        tolconditioncov: Condition number of the covariance; an upper limit.
        tolflatfitness: Generations in a row in which three quarters of the losses are equal; an
            upper limit.
        noeffect: Whether to end where a step no longer changes the mean.

    Raises:
        ValueError: A threshold is negative or not a number. Traced values are not checked.
    """

    tolfun: Number = 1e-11
    tolfunhist: Number = 1e-12
    tolx: Number = 1e-11
    tolxstagnation: Number = 1e-9
    tolstagnation: bool = True
    tolfacupx: Number = 1e3
    tolupsigma: Number = 1e20
    tolconditioncov: Number = 1e14
    tolflatfitness: Number = 1.0
    noeffect: bool = True

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.type is bool:
                one_of(field.name, value, (True, False))
            else:
                within(field.name, value, 0, math.inf)


class History(NamedTuple):
    """Earlier iterations, as far as the stop criteria need them; newest entries first.

    Attributes:
        tolstagnation: Generations without improvement that end a search; restarts keep the number
            of the first run.
        best_losses: Best losses of recent generations `[short]`; +inf before the first.
        recorded: Number of entries that the long history has received, including those that no
            longer fit.
        long_best: Best loss of every fifth generation `[long]`.
        long_median: Median loss of every fifth generation `[long]`.
        flat: Generations in a row whose losses were flat.
        anchor: Mean after its last move `[d]`.
        anchored: The generation in which the mean last moved.
        lowest: Best loss of all generations.
        improved: The evaluation in which that loss was found, counted from 1.
        stagnates: Whether the long history no longer falls.
    """

    tolstagnation: Int[Array, ""]
    best_losses: Float[Array, " short"]
    recorded: Int[Array, ""]
    long_best: Float[Array, " long"]
    long_median: Float[Array, " long"]
    flat: Int[Array, ""]
    anchor: Float[Array, " d"]
    anchored: Int[Array, ""]
    lowest: Float[Array, ""]
    improved: Int[Array, ""]
    stagnates: Bool[Array, ""]


def no_history(point: Float[Array, " d"], population: int) -> History:
    """The history of a search before its first generation."""
    dim, zero = len(point), jnp.int32(0)
    nothing = lambda *shape: jnp.full(shape, jnp.inf, point.dtype)  # noqa: E731
    tolstagnation = 100 + math.floor(100 * dim**1.5) // population
    long = nothing(2 * _window(tolstagnation))
    return History(
        tolstagnation=jnp.int32(tolstagnation),
        best_losses=nothing(_recent(dim, population)),
        recorded=zero,
        long_best=long,
        long_median=long,
        flat=zero,
        anchor=point,
        anchored=zero,
        lowest=nothing(),
        improved=zero,
        stagnates=jnp.bool_(False),
    )


def _recent(dim: int, population: Any) -> Any:
    """Generations in pycma's short history, 10 + 30 d / population."""
    return 10 + 30 * dim // population


def _window(tolstagnation: Any) -> Any:
    """Entries of the long history in each of the two windows that are compared."""
    return tolstagnation // (2 * RECORD_EVERY)


def check(
    state: Any,
    losses: Float[Array, " capacity"],
    sigma0: Float[Array, ""] | float,
    population: int | Int[Array, ""],
    tolerances: Tolerances,
) -> Any:
    """The state after `cma_tell`, with its history and, where a criterion is met, its stop reason.

    Args:
        state: The state that `cma_tell` returned.
        losses: Losses of the generation that `cma_tell` has just seen `[capacity]`.
        sigma0: First standard deviation of the search.
        population: Candidates of the generation. A traced population may be smaller than the number
            of losses; the losses after it do not count.
        tolerances: Thresholds of the criteria.
    """
    counts = jnp.arange(len(losses)) < population
    losses = jnp.where(counts, finite_or_inf(losses), jnp.inf)
    ranked = jnp.sort(losses)
    history = _remember(state, losses, ranked, population, tolerances)
    met = _criteria(state, history, ranked, sigma0, population, tolerances)
    reason = jnp.int32(StopReason.RUNNING)
    for name, is_met in met.items():
        reason = jnp.where((reason == StopReason.RUNNING) & is_met, jnp.int32(name), reason)
    return state._replace(history=history, stop=reason)


def _remember(
    state: Any,
    losses: Float[Array, " capacity"],
    ranked: Float[Array, " capacity"],
    population: int | Int[Array, ""],
    tolerances: Tolerances,
) -> History:
    """The history with this generation added."""
    old, now = state.history, state.generation
    best, window = ranked[0], _window(old.tolstagnation)
    median = (ranked[(population - 1) // 2] + ranked[population // 2]) / 2
    record = now % RECORD_EVERY == 0
    # The longer the mean has stood still, the further it must go to count as moving.
    age = (now - old.anchored) / _patience(now)
    reach = tolerances.tolxstagnation * jnp.sqrt(jnp.maximum(1, age))
    moved = jnp.linalg.norm(state.mean - old.anchor) > reach
    recorded = old.recorded + record
    winner = (now - 1) * population + jnp.argmin(losses) + 1
    history = History(
        tolstagnation=old.tolstagnation,
        best_losses=_push(old.best_losses, best),
        recorded=recorded,
        long_best=jnp.where(record, _push(old.long_best, best), old.long_best),
        long_median=jnp.where(record, _push(old.long_median, median), old.long_median),
        flat=jnp.where(best < ranked[3 * population // 4], 0, old.flat + 1),
        anchor=jnp.where(moved, state.mean, old.anchor),
        anchored=jnp.where(moved, now, old.anchored),
        lowest=jnp.minimum(best, old.lowest),
        improved=jnp.where(best < old.lowest, winner.astype(jnp.int32), old.improved),
        stagnates=old.stagnates,
    )
    due = record & (recorded > jnp.maximum(2 * window, 100))
    return apply_if(due, _compare_windows, history)[0]


def _push(values: Float[Array, " n"], newest: Float[Array, ""]) -> Float[Array, " n"]:
    return jnp.concatenate([newest[None], values[:-1]])


def _patience(generation: Int[Array, ""]) -> Float[Array, ""]:
    """Generations that the mean may stand still."""
    return 20 + 0.1 * generation


def _criteria(
    state: Any,
    history: History,
    ranked: Float[Array, " capacity"],
    sigma0: Float[Array, ""] | float,
    population: int | Int[Array, ""],
    tolerances: Tolerances,
) -> dict[StopReason, Bool[Array, ""]]:
    """The criteria that are met; if several are, the first one names the reason."""
    t, mean, dim, now = tolerances, state.mean, len(state.mean), state.generation
    deviations = state.sigma * jnp.sqrt(jnp.diag(state.covariance))

    rounding = jnp.finfo(mean.dtype).eps * jnp.abs(ranked[0])
    generation_range = ranked[population - 1] - ranked[0]
    recent = jnp.arange(len(history.best_losses)) < jnp.minimum(now, _recent(dim, population))
    losses = history.best_losses
    recent_range = jnp.max(losses, where=recent, initial=-jnp.inf) - jnp.min(
        losses, where=recent, initial=jnp.inf
    )

    def within(spread, tolerance):
        return (spread < jnp.maximum(tolerance, rounding)) & (tolerance > 0)

    stagnates = history.stagnates & (now > dim * (5 + 100 / population))
    since = (now * population - history.improved) / population
    stagnates &= since > history.tolstagnation / 2

    axis = now % dim
    axis_step = 0.1 * state.sigma * state.scales[axis] * state.basis[:, axis]
    no_effect = jnp.any(mean == mean + 0.2 * deviations) | jnp.all(mean == mean + axis_step)
    return {
        StopReason.TOLFUN: within(generation_range, t.tolfun) & within(recent_range, t.tolfun),
        StopReason.TOLFUNHIST: (now > 9) & within(recent_range, t.tolfunhist),
        StopReason.TOLX: jnp.all(deviations < t.tolx)
        & jnp.all(state.sigma * state.path_c < t.tolx),
        StopReason.TOLXSTAGNATION: (now - history.anchored > _patience(now))
        & (t.tolxstagnation > 0),
        StopReason.TOLSTAGNATION: stagnates & t.tolstagnation,
        StopReason.TOLFACUPX: jnp.any(deviations > t.tolfacupx * sigma0),
        StopReason.TOLUPSIGMA: state.sigma > t.tolupsigma * sigma0 * state.scales[-1],
        StopReason.TOLCONDITIONCOV: state.scales[-1] > t.tolconditioncov**0.5 * state.scales[0],
        StopReason.TOLFLATFITNESS: history.flat > t.tolflatfitness,
        StopReason.NOEFFECT: no_effect & t.noeffect,
    }


def _compare_windows(history: History) -> tuple[History]:
    """Note whether neither best nor median losses are lower in the newer of two windows."""
    window = _window(history.tolstagnation)
    place = jnp.arange(len(history.long_best))

    def median(values, first):
        inside = (place >= first) & (place < first + window)
        ranked = jnp.sort(jnp.where(inside, values, jnp.inf))
        return (ranked[(window - 1) // 2] + ranked[window // 2]) / 2

    both = [median(x, 0) >= median(x, window) for x in (history.long_best, history.long_median)]
    return (history._replace(stagnates=both[0] & both[1]),)
