"""CMA-ES, with the variants `cma:ipop` and `cma:bipop` that restart."""

import jax
from jaxtyping import Array, Float

from jaxshape.search.cma import (
    CmaState,
    checked_population,
    cma_ask,
    distribution,
    move,
    start,
    started,
)
from jaxshape.search.config import RefineConfig
from jaxshape.search.rates import constants
from jaxshape.search.refiner import Objective, Refiner, Trace, summarise
from jaxshape.search.restarts import with_restarts
from jaxshape.search.stopping import Tolerances


def build(variant: str | None, dim: int, config: RefineConfig) -> Refiner:
    """CMA-ES with `config.population` candidates per iteration."""
    sigma0, population = config.sigma0, config.population
    tolerances = Tolerances(tolfun=config.tolerance, tolfunhist=config.tolerance)
    if variant is None:
        return cma(dim=dim, sigma0=sigma0, population=population, tolerances=tolerances)
    if variant in ("ipop", "bipop"):
        return with_restarts(
            variant, dim=dim, sigma0=sigma0, population=population, tolerances=tolerances
        )
    raise ValueError(f"There is no method 'cma:{variant}'; choose cma, cma:ipop or cma:bipop.")


def cma(
    *,
    dim: int,
    sigma0: Float[Array, ""] | float,
    population: int | None = None,
    tolerances: Tolerances = Tolerances(),
) -> Refiner:
    """CMA-ES over points of dimension `dim`, starting from N(point, sigma0^2 I).

    To start from another covariance, search in another space (`space.py`). `resume` keeps mean,
    sigma and C of an earlier search, but not its evolution paths, which belong to another
    objective. For your own loop, or an objective outside of JAX, use `cma_start`, `cma_ask` and
    `cma_tell`.

    Args:
        dim: Dimension of a point, 1 or more.
        sigma0: First standard deviation, above 0, in units of the search space.
        population: Candidates per iteration, 3 or more; None for pycma's 4 + floor(3 ln dim).
        tolerances: Stop criteria that end the search.

    Returns:
        The search.

    Raises:
        ValueError: A setting is outside its range.
    """
    size = checked_population(dim, sigma0, population)

    def init(
        key: Array, point: Float[Array, " d"], loss: Float[Array, ""]
    ) -> tuple[CmaState, Trace]:
        del key  # the start is the given point
        return started(start(point, sigma0, dim, size, loss))

    def step(key: Array, state: CmaState, objective: Objective) -> tuple[CmaState, Trace]:
        points = cma_ask(key, state, size)
        losses = jax.vmap(objective)(points)
        rates = constants(dim, size, dtype=points.dtype)
        state = move(state, points, losses, rates, sigma0, size, tolerances)
        evaluations = 1 + size * state.generation
        return state, summarise(state.best, points, losses, evaluations, distribution(state))

    def resume(key: Array, state: CmaState, loss: Float[Array, ""]) -> tuple[CmaState, Trace]:
        fresh, _ = init(key, state.best.point, loss)
        kept = {name: getattr(state, name) for name in _DISTRIBUTION}
        return started(fresh._replace(**kept))

    return Refiner(init, step, resume)


_DISTRIBUTION = ("mean", "sigma", "covariance", "basis", "scales")
