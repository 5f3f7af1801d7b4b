"""The paper's search: pycma on the host, objectives from PyTorch."""

from collections.abc import Callable

import cma
import numpy as np
from jaxtyping import Float

Score = Callable[[Float[np.ndarray, "n d"]], Float[np.ndarray, " n"]]


def search(
    score: Score,
    code: Float[np.ndarray, " d"],
    root: Float[np.ndarray, "d d"],
    *,
    iterations: int,
    population: int = 17,
    sigma0: float = 0.1,
    one_at_a_time: bool = False,
    seed: int = 1,
) -> float:
    """The best objective of one search, in the space whitened by `root`, without stopping early.

    The paper scores one candidate after the other; an expert scores the population as a batch.
    """
    strategy = _start(len(code), sigma0, population, seed)
    for _ in range(iterations):
        points = strategy.ask()
        codes = (code + np.stack(points) @ root.T).astype(np.float32)
        batches = np.split(codes, len(codes)) if one_at_a_time else [codes]
        strategy.tell(points, np.concatenate([score(batch) for batch in batches]).tolist())
    return float(strategy.result.fbest)


def search_together(
    score: Callable[[Float[np.ndarray, "object n d"]], Float[np.ndarray, "object n"]],
    codes: Float[np.ndarray, "object d"],
    root: Float[np.ndarray, "d d"],
    *,
    iterations: int,
    population: int = 17,
    sigma0: float = 0.1,
    seed: int = 1,
) -> list[float]:
    """One strategy per object, all their candidates scored as one batch."""
    strategies = [_start(codes.shape[1], sigma0, population, seed + i) for i in range(len(codes))]
    for _ in range(iterations):
        points = [strategy.ask() for strategy in strategies]
        losses = score((codes[:, None] + np.array(points) @ root.T).astype(np.float32))
        for strategy, asked, told in zip(strategies, points, losses, strict=True):
            strategy.tell(asked, told.tolist())
    return [float(strategy.result.fbest) for strategy in strategies]


def _start(dim: int, sigma0: float, population: int, seed: int) -> cma.CMAEvolutionStrategy:
    options = {"popsize": population, "seed": seed, "verbose": -9}
    return cma.CMAEvolutionStrategy(np.zeros(dim), sigma0, options)
