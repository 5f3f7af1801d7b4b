"""The distribution-based strategies of evosax as refiners, for comparison with `cma`."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from evosax.algorithms.distribution_based import distribution_based_algorithms
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
    """The strategy's own state, and where it lies in the space of codes."""

    origin: Float[Array, " d"]  # the first code: zero of the strategy's coordinates
    mean: Float[Array, " d"]
    best: Candidate
    strategy_state: Any


def evosax_strategy(
    name: str, *, dim: int, population: int, sigma0: float, **settings: Any
) -> Refiner:
    """An evosax strategy by name: "Sep_CMA_ES", "SNES", "Open_ES" and their like.

    The strategy searches u in code = first code + sigma0 u from u = 0, so that `sigma0` is the
    standard deviation of those that start at their default of 1, and the unit of every length and
    learning rate. `settings` go to its constructor, for example `optimizer=optax.adam(0.1)`: some
    defaults (`Open_ES`: 1e-3) hardly move. Losses that are not finite count as the worst finite
    one. ValueError for an unknown name and for settings the strategy refuses.
    """
    strategy = _build(name, dim, population, settings)
    params = strategy.default_params

    def init(key: Array, code: Float[Array, " d"], loss: Float[Array, ""]) -> State:
        best = Candidate(code, finite_or_inf(loss))
        return State(code, code, best, strategy.init(key, jnp.zeros_like(code), params))

    def step(key: Array, state: State, objective: Objective) -> tuple[State, Trace]:
        ask_key, tell_key = jax.random.split(key)
        points, strategy_state = strategy.ask(ask_key, state.strategy_state, params)
        codes = state.origin + sigma0 * points
        losses = jax.vmap(objective)(codes)
        strategy_state, _ = strategy.tell(
            tell_key, points, _worst_if_failed(losses), strategy_state, params
        )
        mean = state.origin + sigma0 * strategy.get_mean(strategy_state)
        best = keep_better(state.best, codes, losses)
        return State(state.origin, mean, best, strategy_state), summarise(best, codes, losses)

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
