"""Two problems of the benchmark with a prior that compiles at once, and knows no chairs."""

import numpy as np
import pytest

from jaxshape.bench import problem_set as sets
from jaxshape.bench import problems as made
from jaxshape.bench.problems import problems
from jaxshape.model.weights import fingerprint


@pytest.fixture(scope="session")
def tiny_set(linear_prior):
    """The first object of the set, for the linear prior, as if four fifths were the best known."""
    found = sets.packaged_set()
    found = found._replace(
        objects=found.objects[:1],
        measured={kind: grids[:1] for kind, grids in found.measured.items()},
        surfaces=found.surfaces[:1],
        weights=fingerprint(linear_prior),
        best={},
    )
    first = problems(problem_set=found, prior=linear_prior)
    return found._replace(best={one.name: 0.975 * float(one.first_objective) for one in first})


@pytest.fixture(scope="session")
def two(tiny_set, linear_prior):
    """After four frames, clean and noisy."""
    return problems(frames=(4,), problem_set=tiny_set, prior=linear_prior)


@pytest.fixture
def tiny_benchmark(monkeypatch, tiny_set, linear_prior):
    """The packaged set and weights are the tiny ones."""
    for module in (sets, made):
        monkeypatch.setattr(module, "packaged_set", lambda: tiny_set)
    monkeypatch.setattr(made, "load_prior", lambda name: linear_prior)


@pytest.fixture
def rows(two):
    """Rows of a search that closes the gap at once, or not at all, by a setting."""

    def rows(closed: float, calls: int = 3):
        from jaxshape.bench.scoring import LADDER, LEFT

        first = [float(one.first_objective) for one in two]
        best = [one.best_objective for one in two]
        last = [b + (1 - closed) * (f - b) for f, b in zip(first, best, strict=True)]
        reached = [[calls, 0.5]] * int(np.sum(np.array(LEFT) >= 1 - closed - 1e-9))
        return {
            one.name: {
                "calls": 2048,
                "seconds": 1.0,
                "stop": "budget",
                "objective": [first[i]] + [last[i]] * (len(LADDER) - 1),
                "iou": [0.5] + [0.5 + 0.1 * closed] * (len(LADDER) - 1),
                "reached": reached,
                "code": "",
                "together": 2,
                "compiling": 0.0,
            }
            for i, one in enumerate(two)
        }

    return rows
