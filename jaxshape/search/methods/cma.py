"""CMA-ES, with the variants `cma:ipop` and `cma:bipop` that restart."""

from jaxshape.search.cma import cma
from jaxshape.search.config import RefineConfig
from jaxshape.search.refiner import Refiner
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
