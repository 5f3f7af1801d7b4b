"""Searches of other packages, which run on the host and ask for points: pycma and nevergrad. [host]

In a benchmark their names are `pycma` and `nevergrad:NAME`. Your own function that returns an
`AskTell` enters by its import path, just like one that returns a `Refiner`.
"""

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np
from jaxtyping import Float

from jaxshape.search.config import RefineConfig


class Asker(Protocol):
    """A search that proposes points and takes their losses."""

    def ask(self) -> Float[np.ndarray, "n d"]:
        """The points to evaluate next."""
        ...

    def tell(self, points: Float[np.ndarray, "n d"], losses: Float[np.ndarray, " n"]) -> str | None:
        """Take the losses of these points, NaN for failures; return a reason when it stops."""
        ...


class AskTell(NamedTuple):
    """A search on the host, from one first point.

    Attributes:
        start: `(seed, point [d], loss) -> Asker`.
    """

    start: Callable[[int, Float[np.ndarray, " d"], float], Asker]


def pycma(variant: str | None, dim: int, config: RefineConfig) -> AskTell:
    """CMA-ES of the package `cma`, with its own stop criteria.

    Args:
        variant: None; there are no variants.
        dim: Dimension of a point.
        config: Settings of the search; `population`, `sigma0` and `bound` are used.

    Raises:
        ValueError: There is a variant, or the package is not installed.
    """
    cma = _imported("cma")
    if variant:
        raise ValueError(f"pycma has no variant {variant!r}; give pycma.")
    options: dict[str, Any] = {"popsize": config.population, "verbose": -9, "verb_log": 0}
    if config.bound is not None:
        options["bounds"] = [-config.bound, config.bound]

    class Search:
        def __init__(self, seed, point, loss):
            del loss
            # For the seed 0, pycma takes one from the clock.
            chosen = options | {"seed": 1 + seed}
            self.strategy = cma.CMAEvolutionStrategy(np.float64(point), config.sigma0, chosen)

        def ask(self):
            return np.stack(self.strategy.ask())

        def tell(self, points, losses):
            self.strategy.tell(list(points), losses.tolist())
            return next(iter(self.strategy.stop()), None)

    del dim
    return AskTell(Search)


def nevergrad(variant: str | None, dim: int, config: RefineConfig) -> AskTell:
    """An optimiser of nevergrad, which is told the whole budget at the start.

    Args:
        variant: Name in nevergrad's registry, such as `TwoPointsDE`; None for `NGOpt`, which
            chooses an optimiser itself.
        dim: Dimension of a point.
        config: Settings of the search: it proposes `population` candidates in each of `iterations`
            iterations; `sigma0` is the scale of a mutation, `bound` a box.

    Raises:
        ValueError: The package lacks this optimiser, or is not installed.
    """
    ng = _imported("nevergrad")
    name = variant or "NGOpt"
    if name not in ng.optimizers.registry:
        raise ValueError(
            f"nevergrad has no optimiser {name!r}; choose, for example, NGOpt or TwoPointsDE."
        )

    class Search:
        def __init__(self, seed, point, loss):
            del loss
            array = ng.p.Array(init=np.float64(point))
            array.set_mutation(sigma=config.sigma0)
            if config.bound is not None:
                array.set_bounds(-config.bound, config.bound)
            array.random_state.seed(seed)
            calls, together = config.iterations * config.population, config.population
            self.optimizer = ng.optimizers.registry[name](array, calls, num_workers=together)
            self.optimizer.suggest(np.float64(point))  # otherwise some optimisers start at random

        def ask(self):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # warnings on its own choice of settings
                self.asked = [self.optimizer.ask() for _ in range(config.population)]
            return np.stack([one.value for one in self.asked])

        def tell(self, points, losses):
            for one, loss in zip(self.asked, losses.tolist(), strict=True):
                self.optimizer.tell(one, loss if np.isfinite(loss) else 1e9)
            return None

    del dim
    return AskTell(Search)


ASK_TELL: dict[str, Callable[..., AskTell]] = {"pycma": pycma, "nevergrad": nevergrad}
"""The searches of this module, by the first part of their names."""


def _imported(package: str) -> Any:
    """A package of the extra `bench`."""
    try:
        return __import__(package)
    except ImportError as missing:
        raise ValueError(
            f"The package {package} cannot be imported ({missing}); it comes with"
            " pip install 'jaxshape[bench]'."
        ) from missing
