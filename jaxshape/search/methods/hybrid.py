"""CMA-ES first, then descent along the gradient from the best it found: `hybrid`, `hybrid:adam`.

The population finds the basin of a minimum and the gradient finds its floor. Far from the encoder's
guess gradients stall, and near a minimum a population of 17 needs hundreds of evaluations to learn
what one gradient shows. The second search is L-BFGS by default.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxshape.checks import whole
from jaxshape.search.batching import select
from jaxshape.search.config import RefineConfig
from jaxshape.search.curvature import only_where
from jaxshape.search.methods import build_refiner
from jaxshape.search.refiner import Candidate, Objective, Refiner, StopReason, Trace

POLISH = 0.2
"""Share of the iterations that the gradient search gets."""


class HybridState(NamedTuple):
    """The two searches, of which one is active.

    Attributes:
        mean: Mean of the active search `[d]`.
        best: The best candidate so far.
        stop: Why the search ended, as a `StopReason`; RUNNING while it goes on.
        searched: State and trace of the first search.
        polished: State of the second search.
        polishing: Whether the second search is active.
        iterations: Iterations so far, of both searches.
    """

    mean: Float[Array, " d"]
    best: Candidate
    stop: Int[Array, ""]
    searched: tuple[Any, Trace]
    polished: Any
    polishing: Bool[Array, ""]
    iterations: Int[Array, ""]


def build(variant: str | None, dim: int, config: RefineConfig) -> Refiner:
    """CMA-ES, polished by the optax optimiser that the variant names."""
    return polished(
        build_refiner("cma", dim, config),
        build_refiner(f"gradient:{variant or 'lbfgs'}", dim, config),
        max(1, round((1 - POLISH) * config.iterations)),
    )


def polished(search: Refiner, polish: Refiner, iterations: int) -> Refiner:
    """One search, then a second one from the best point of the first.

    Args:
        search: The first search, which runs until it stops or has used its iterations.
        polish: The second search, which starts from the best point of the first.
        iterations: Iterations of the first search at most, 1 or more.

    Returns:
        Both as one search.

    Raises:
        ValueError: `iterations` is not a whole number, or is below 1.
    """
    whole("iterations", iterations, 1)

    def init(
        key: Array, point: Float[Array, " d"], loss: Float[Array, ""]
    ) -> tuple[HybridState, Trace]:
        first, trace = search.init(key, point, loss)
        second, _ = polish.init(key, point, loss)
        begun = jnp.bool_(False), jnp.int32(0)
        state = HybridState(first.mean, first.best, first.stop, (first, trace), second, *begun)
        return state, trace

    def step(key: Array, state: HybridState, objective: Objective) -> tuple[HybridState, Trace]:
        # A batch has objects in both searches, so both make a step; but the inactive search gets
        # points that are not finite, which are not decoded.
        search_key, polish_key, begin_key = jax.random.split(key, 3)
        polishing = state.polishing
        stepped = search.step(search_key, state.searched[0], only_where(~polishing, objective))
        searched, trace = select(polishing, state.searched, stepped)
        polished, polish_trace = polish.step(
            polish_key, state.polished, only_where(polishing, objective)
        )
        polish_trace = polish_trace._replace(
            evaluations=trace.evaluations + polish_trace.evaluations - 1,
            distribution=trace.distribution,
        )
        best, mean, shown = select(
            polishing,
            (polished.best, polished.mean, polish_trace),
            (searched.best, searched.mean, trace),
        )
        stop = jnp.where(polishing, polished.stop, jnp.int32(StopReason.RUNNING))

        count = state.iterations + 1
        begins = ~polishing & ((count >= iterations) | (searched.stop != StopReason.RUNNING))
        fresh, _ = polish.init(begin_key, best.point, best.loss)
        polished = select(begins, fresh, polished)
        state = HybridState(
            mean, best, stop, (searched, trace), polished, polishing | begins, count
        )
        return state, shown

    return Refiner(init, step)
