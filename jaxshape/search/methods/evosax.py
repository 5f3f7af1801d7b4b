"""The distribution-based strategies of evosax, for comparison: `evosax:Sep_CMA_ES`, ..."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from evosax.algorithms.distribution_based import distribution_based_algorithms
from jaxtyping import Array, Float, Int

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


class State(NamedTuple):
    """The strategy's own state, and where it lies in the search space."""

    mean: Float[Array, " d"]
    best: Candidate
    stop: Int[Array, ""]  # evosax has no criteria: always RUNNING
    origin: Float[Array, " d"]  # the first point: zero of the strategy's coordinates
    evaluations: Int[Array, ""]
    strategy_state: Any


def build(variant: str | None, dim: int, config: RefineConfig) -> Refiner:
    """The strategy that the variant names."""
    return evosax_strategy(
        variant or "", dim=dim, population=config.population, sigma0=config.sigma0
    )


def evosax_strategy(
    name: str, *, dim: int, population: int, sigma0: float, **settings: Any
) -> Refiner:
    """An evosax strategy by name: "Sep_CMA_ES", "SNES", "Open_ES" and their like.

    The strategy searches u in point = first + sigma0 u from u = 0, so that `sigma0` is the
    standard deviation of those that start at their default of 1, and the unit of every length and
    learning rate. `settings` go to its constructor, for example `optimizer=optax.adam(0.1)`: some
    defaults (`Open_ES`: 1e-3) hardly move. Losses that are not finite count as the worst finite
    one. ValueError for an unknown name and for settings the strategy refuses.
    """
    strategy = _build(name, dim, population, settings)
    params = strategy.default_params

    def init(key: Array, point: Float[Array, " d"], loss: Float[Array, ""]) -> tuple[State, Trace]:
        best = Candidate(point, finite_or_inf(loss))
        begun = strategy.init(key, jnp.zeros_like(point), params)
        state = State(point, best, jnp.int32(0), point, jnp.int32(1), begun)
        return state, start_trace(best)

    def step(key: Array, state: State, objective: Objective) -> tuple[State, Trace]:
        ask_key, tell_key = jax.random.split(key)
        units, asked = strategy.ask(ask_key, state.strategy_state, params)
        points = state.origin + sigma0 * units
        losses = jax.vmap(objective)(points)
        told, _ = strategy.tell(tell_key, units, _worst_if_failed(losses), asked, params)
        state = state._replace(
            mean=state.origin + sigma0 * strategy.get_mean(told),
            best=keep_better(state.best, points, losses),
            evaluations=state.evaluations + population,
            strategy_state=told,
        )
        return state, summarise(state.best, points, losses, state.evaluations)

    return Refiner(init, step)


def _build(name: str, dim: int, population: int, settings: dict[str, Any]) -> Any:
    """The strategy, built once: evosax compiles anew for every instance."""
    if name not in distribution_based_algorithms:
        choices = ", ".join(sorted(distribution_based_algorithms))
        raise ValueError(f"There is no evosax strategy {name!r}; choose one of {choices}.")
    try:
        return distribution_based_algorithms[name](
            population_size=population,
            solution=jnp.zeros(dim),
            metrics_fn=lambda *_: {},  # the default keeps three codes per generation
            **settings,
        )
    except (AssertionError, TypeError) as error:
        raise ValueError(
            f"evosax cannot build {name} with a population of {population} and the settings"
            f" {sorted(settings)}: {error}"
        ) from error


def _worst_if_failed(losses: Float[Array, " n"]) -> Float[Array, " n"]:
    """Losses with those that are not finite set to the largest finite one, or all to 0."""
    finite = jnp.isfinite(losses)
    worst = jnp.max(losses, where=finite, initial=-jnp.inf)
    return jnp.where(finite, losses, jnp.where(jnp.any(finite), worst, 0))
