"""The distribution-based strategies of evosax, for comparison: `evosax:Sep_CMA_ES`, ...

`evosax:Open_ES@18` sets the population in the name and overrides the settings.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from evosax.algorithms.distribution_based import distribution_based_algorithms
from jaxtyping import Array, Float, Int

from jaxshape.checks import positive, whole
from jaxshape.search.batching import cast_like
from jaxshape.search.config import RefineConfig
from jaxshape.search.refiner import (
    Candidate,
    Objective,
    Refiner,
    Trace,
    finite_or_inf,
    keep_better,
    start_trace,
    summarise,
)

LEARNING_RATE = 0.3
"""Learning rate of the strategies that follow an estimated gradient, in units of sigma0: Adam
replaces their own optimisers, whose rates of 0.001 to 0.01 hardly move the mean."""

FOLLOW_A_GRADIENT = {
    "ARS",
    "ASEBO",
    "ESMC",
    "GuidedES",
    "NoiseReuseES",
    "Open_ES",
    "PGPE",
    "PersistentES",
    "SV_Open_ES",
}

SEVERAL_POPULATIONS = {"SV_CMA_ES", "SV_Open_ES"}
"""Strategies that divide the candidates between two populations."""

MULTIPLES = (
    dict.fromkeys(FOLLOW_A_GRADIENT | {"CR_FM_NES", "SV_CMA_ES"}, 2)  # mirrored candidates
    | {"SV_Open_ES": 4}
)
"""For each strategy, the number of which its population must be a multiple."""


class EvosaxState(NamedTuple):
    """The strategy's own state, and its origin in the search space.

    Attributes:
        mean: Centre of the distribution `[d]`.
        best: The best candidate so far.
        stop: Always RUNNING, since evosax has no stop criteria.
        origin: The first point `[d]`, the origin of the strategy's coordinates.
        evaluations: Evaluations of the objective so far, the start included.
        strategy_state: State of the evosax strategy.
    """

    mean: Float[Array, " d"]
    best: Candidate
    stop: Int[Array, ""]
    origin: Float[Array, " d"]
    evaluations: Int[Array, ""]
    strategy_state: Any


def build(variant: str | None, dim: int, config: RefineConfig) -> Refiner:
    """The strategy that the variant names, `NAME` or `NAME@POPULATION`.

    If the name has no population, the population is that of the settings, rounded up to a number
    that the strategy accepts: some need an even one.
    """
    name, at, number = (variant or "").partition("@")
    if not at:
        population = -(-config.population // MULTIPLES.get(name, 1)) * MULTIPLES.get(name, 1)
    elif number.isdecimal():
        population = int(number)
    else:
        raise ValueError(f"evosax:{variant} has no population behind the @; give a whole number.")
    return evosax_strategy(name, dim=dim, population=population, sigma0=config.sigma0)


def evosax_strategy(
    name: str,
    *,
    dim: int,
    population: int,
    sigma0: Float[Array, ""] | float,
    **settings: Any,
) -> Refiner:
    """An evosax strategy by name: "Sep_CMA_ES", "SNES", "Open_ES" and their like.

    The strategy searches for u, from u = 0, and the point is first + sigma0 u. So `sigma0` is the
    unit of every length and learning rate, and the initial standard deviation of strategies that
    start at their default of 1. Losses that are not finite count as the worst finite one.

    Args:
        name: Name of one of evosax's distribution-based strategies.
        dim: Dimension of a point, 1 or more.
        population: Candidates per iteration, 1 or more. Strategies that mirror their candidates
            need an even number; `SV_CMA_ES` and `SV_Open_ES` divide it between two populations.
        sigma0: Standard deviation of the first candidates, above 0, in units of the search space.
        **settings: Arguments of the strategy's constructor, for example
            `optimizer=optax.adam(0.1)`.

    Returns:
        The search.

    Raises:
        ValueError: The strategy is unknown, or it refuses the settings.
    """
    whole("dim", dim, 1)
    whole("population", population, 1)
    positive("sigma0", sigma0)
    strategy = _build(name, dim, population, settings)
    params = strategy.default_params
    populations = getattr(strategy, "num_populations", None)

    def init(
        key: Array, point: Float[Array, " d"], loss: Float[Array, ""]
    ) -> tuple[EvosaxState, Trace]:
        best = Candidate(point, finite_or_inf(loss))
        begun = strategy.init(key, jnp.zeros((populations, dim) if populations else dim), params)
        begun = jax.tree.map(jnp.asarray, begun)
        state = EvosaxState(point, best, jnp.int32(0), point, jnp.int32(1), begun)
        return state, start_trace(best)

    def step(key: Array, state: EvosaxState, objective: Objective) -> tuple[EvosaxState, Trace]:
        ask_key, tell_key = jax.random.split(key)
        units, asked = strategy.ask(ask_key, state.strategy_state, params)
        points = (state.origin + sigma0 * units).astype(state.origin.dtype)
        losses = jax.vmap(objective)(points)
        ranked = _worst_if_failed(losses).astype(units.dtype)
        updated, _ = strategy.tell(tell_key, units, ranked, asked, params)
        mean = updated.mean.mean(axis=0) if populations else updated.mean
        state = state._replace(
            mean=(state.origin + sigma0 * mean).astype(state.origin.dtype),
            best=keep_better(state.best, points, losses),
            evaluations=state.evaluations + len(points),
            strategy_state=cast_like(updated, state.strategy_state),
        )
        return state, summarise(state.best, points, losses, state.evaluations)

    return Refiner(init, step)


def _build(name: str, dim: int, population: int, settings: dict[str, Any]) -> Any:
    """The strategy, built once: evosax compiles anew for every instance."""
    if name not in distribution_based_algorithms:
        choices = ", ".join(sorted(distribution_based_algorithms))
        raise ValueError(f"There is no evosax strategy {name!r}; choose one of {choices}.")
    multiple = MULTIPLES.get(name, 1)
    if population % multiple:
        raise ValueError(
            f"The population of {name} is {population}; give a multiple of {multiple}, as"
            f" {population + -population % multiple}."
        )
    settings = _defaults(name, dim) | settings
    each = population // settings.get("num_populations", 1)
    try:
        return distribution_based_algorithms[name](
            population_size=each,
            solution=jnp.zeros(dim),
            metrics_fn=lambda *_: {},  # the default keeps three codes per generation
            **settings,
        )
    except (AssertionError, TypeError) as error:
        raise ValueError(
            f"evosax cannot build {name} with a population of {population} and the settings"
            f" {sorted(settings)}: {error}"
        ) from error


def _defaults(name: str, dim: int) -> dict[str, Any]:
    """Settings without which a strategy hardly moves, or cannot be built."""
    settings: dict[str, Any] = {}
    if name in FOLLOW_A_GRADIENT:
        settings["optimizer"] = optax.adam(LEARNING_RATE)
    if name in SEVERAL_POPULATIONS:
        settings["num_populations"] = 2
    if name == "RandomSearch":
        settings["sampling_fn"] = lambda key: jax.random.normal(key, (dim,))
    return settings


def _worst_if_failed(losses: Float[Array, " n"]) -> Float[Array, " n"]:
    """Losses in which values that are not finite become the largest finite one; 0 if none is
    finite."""
    finite = jnp.isfinite(losses)
    worst = jnp.max(losses, where=finite, initial=-jnp.inf)
    return jnp.where(finite, losses, jnp.where(jnp.any(finite), worst, 0))
