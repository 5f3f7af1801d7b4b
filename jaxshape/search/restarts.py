"""CMA-ES that starts again with a larger population when it stops: IPOP and BIPOP.

Everything happens inside the compiled loop, where shapes are fixed: every iteration evaluates the
same number of candidates, and a population m times as large collects the candidates of m iterations
before the distribution moves. Each object of a batch restarts on its own, and no evaluation is
wasted.

IPOP doubles the population at each restart (Auger and Hansen, "A restart CMA evolution strategy
with increasing population size", 2005). BIPOP spends an equal share of the evaluations on short
runs with small populations and steps (Hansen, "Benchmarking a BI-population CMA-ES on the
BBOB-2009 function testbed", 2009).
"""

from collections.abc import Callable
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxshape.checks import one_of, whole
from jaxshape.search import cma
from jaxshape.search.batching import apply_if, select
from jaxshape.search.rates import constants
from jaxshape.search.refiner import (
    Candidate,
    Objective,
    Refiner,
    StopReason,
    Trace,
    finite_or_inf,
    keep_better,
    summarise,
)
from jaxshape.search.stopping import Tolerances


class Run(NamedTuple):
    """Limits and spending of one run between two restarts.

    Attributes:
        multiple: Population of the run as a multiple of the first population; a generation takes as
            many iterations.
        sigma0: First standard deviation of the run.
        is_small: Whether the run counts towards the small regime of BIPOP.
        iterations: Iterations spent.
        allowed: Iterations allowed.
    """

    multiple: Int[Array, ""]
    sigma0: Float[Array, ""]
    is_small: Bool[Array, ""]
    iterations: Int[Array, ""]
    allowed: Int[Array, ""]


class RestartState(NamedTuple):
    """The current run, the generation that it collects, and the best of earlier runs.

    Attributes:
        mean: Centre of the present distribution `[d]`.
        best: The best candidate of all runs.
        stop: Why the search ended, as a `StopReason`; RUNNING while it goes on.
        first: The point that the first run began at, and its loss.
        search: State of the present run.
        points: Candidates of the generation that is being collected `[capacity d]`.
        losses: Losses of these candidates `[capacity]`.
        run: Limits and spending of the present run.
        large_runs: Restarts with doubled population.
        spent_small: Iterations of finished runs with small populations.
        spent_large: Iterations of finished runs with large populations.
        restarts: Restarts of either kind.
        reason: Why the last run ended, as a `StopReason`.
    """

    mean: Float[Array, " d"]
    best: Candidate
    stop: Int[Array, ""]
    first: Candidate
    search: cma.CmaState
    points: Float[Array, "capacity d"]
    losses: Float[Array, " capacity"]
    run: Run
    large_runs: Int[Array, ""]
    spent_small: Int[Array, ""]
    spent_large: Int[Array, ""]
    restarts: Int[Array, ""]
    reason: Int[Array, ""]


def with_restarts(
    kind: Literal["ipop", "bipop"],
    *,
    dim: int,
    sigma0: Float[Array, ""] | float,
    population: int | None = None,
    doublings: int = 5,
    restart_point: Callable[[Array, Float[Array, " d"]], Float[Array, " d"]] | None = None,
    tolerances: Tolerances = Tolerances(),
) -> Refiner:
    """CMA-ES with restarts; the number of candidates per iteration stays the same for every
    population.

    Args:
        kind: "ipop", which doubles the population at each restart, or "bipop", which spends as many
            evaluations on short runs with small populations.
        dim: Dimension of a point, 1 or more.
        sigma0: First standard deviation, above 0, in units of the search space.
        population: Candidates per iteration and population of the first run, 3 or more; None for
            pycma's 4 + floor(3 ln dim).
        doublings: Doublings of the population, 0 or more. The search ends when the run after the
            last restart stops.
        restart_point: `(key, first point [d]) -> point [d]`, the mean of a new run; None begins
            every run at the first point.
        tolerances: Stop criteria that end a run.

    Returns:
        The search.

    Raises:
        ValueError: A setting is outside its range.
    """
    one_of("kind", kind, ("ipop", "bipop"))
    size = cma.checked_population(dim, sigma0, population)
    whole("doublings", doublings, 0)
    capacity = size * 2**doublings
    unlimited = jnp.iinfo(jnp.int32).max

    def init(
        key: Array, point: Float[Array, " d"], loss: Float[Array, ""]
    ) -> tuple[RestartState, Trace]:
        search, trace = cma.started(cma.start(point, sigma0, dim, size, loss))
        zero = jnp.int32(0)
        run = Run(
            multiple=jnp.int32(1),
            sigma0=search.sigma,
            is_small=jnp.bool_(True),
            iterations=zero,
            allowed=jnp.int32(unlimited),
        )
        state = RestartState(
            mean=search.mean,
            best=search.best,
            stop=search.stop,
            first=search.best,
            search=search,
            points=jnp.tile(point, (capacity, 1)),
            losses=jnp.full(capacity, jnp.inf, point.dtype),
            run=run,
            large_runs=zero,
            spent_small=zero,
            spent_large=zero,
            restarts=zero,
            reason=zero,
        )
        return state, trace

    def step(key: Array, state: RestartState, objective: Objective) -> tuple[RestartState, Trace]:
        ask_key, restart_key = jax.random.split(key)
        points = cma.cma_ask(ask_key, state.search, size)
        losses = jax.vmap(objective)(points)
        state = _collect(state, points, losses, size)
        run = state.run
        complete = run.iterations % run.multiple == 0
        search, *_ = apply_if(complete, move, state.search, state.points, state.losses, run)
        state = state._replace(search=search, mean=search.mean)
        over = (search.stop != StopReason.RUNNING) | (run.iterations >= run.allowed)
        last = over & (state.large_runs >= doublings)
        again = begin_again(restart_key, state)
        state = select(over & ~last, again, state)
        state = state._replace(stop=jnp.where(last, search.stop, StopReason.RUNNING))
        evaluations = 1 + size * (state.spent_small + state.spent_large + state.run.iterations)
        shape = cma.distribution(state.search)
        return state, summarise(state.best, points, losses, evaluations, shape)

    def move(search, points, losses, run):
        """One generation of the whole population."""
        population = size * run.multiple
        rates = constants(dim, population, capacity, points.dtype)
        search = cma.move(search, points, losses, rates, run.sigma0, population, tolerances)
        return search, points, losses, run

    def begin_again(key: Array, state: RestartState) -> RestartState:
        """The state at the start of the next run."""
        point_key, size_key, step_key = jax.random.split(key, 3)
        run = state.run
        spent_small = state.spent_small + jnp.where(run.is_small, run.iterations, 0)
        spent_large = state.spent_large + jnp.where(run.is_small, 0, run.iterations)
        is_small = jnp.bool_(kind == "bipop") & (spent_small < jnp.maximum(1, spent_large))
        large_runs = state.large_runs + jnp.where(is_small, 0, 1)
        largest = jnp.left_shift(1, large_runs)
        # A small population lies between the first one and the largest, mostly near the first.
        share = jax.random.uniform(size_key) ** 2
        small = jnp.floor(largest.astype(jnp.float32) ** share).astype(jnp.int32)
        shrink = 0.01 ** jax.random.uniform(step_key, dtype=run.sigma0.dtype)
        run = Run(
            multiple=jnp.where(is_small, small, largest),
            sigma0=sigma0 * jnp.where(is_small, shrink, 1),
            is_small=is_small,
            iterations=jnp.zeros_like(run.iterations),
            allowed=jnp.where(is_small, spent_large // 2, unlimited),
        )
        first = state.first.point
        point = first if restart_point is None else restart_point(point_key, first)
        unknown = jnp.full_like(state.best.loss, jnp.inf)
        return state._replace(
            search=cma.start(point, run.sigma0, dim, size, unknown),
            losses=jnp.full_like(state.losses, jnp.inf),  # forgets those of a larger population
            mean=point,
            run=run,
            large_runs=large_runs,
            spent_small=spent_small,
            spent_large=spent_large,
            restarts=state.restarts + 1,
            reason=state.search.stop,
        )

    return Refiner(init, step)


def _collect(
    state: RestartState, points: Float[Array, "n d"], losses: Float[Array, " n"], size: int
) -> RestartState:
    """Add the candidates of one iteration to the generation that is being collected."""
    run = state.run
    first = (run.iterations % run.multiple) * size
    write = jax.lax.dynamic_update_slice_in_dim
    return state._replace(
        best=keep_better(state.best, points, losses),
        points=write(state.points, points, first, axis=0),
        losses=write(state.losses, finite_or_inf(losses), first, axis=0),
        run=run._replace(iterations=run.iterations + 1),
    )
