"""Figures of the search of a problem: when it reached each target, and its best codes. [host]"""

import base64
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxshape.bench.config import LADDER, LEFT
from jaxshape.bench.problems import Problem
from jaxshape.bench.watching import Improvement, Observer
from jaxshape.geometry.overlap import iou
from jaxshape.model.shapes import decode

Row = dict[str, Any]
"""The figures of one problem: `calls` and `seconds` spent, `stop`; at each step of `LADDER` the
`objective` and `iou` of the best code so far; `reached`, calls and seconds at each target by
objective that was reached, in order; `code`, the last best code."""


def rows_of(
    problems: Sequence[Problem], observer: Observer, stops: Sequence[str]
) -> dict[str, Row]:
    """The rows of problems that were searched.

    Args:
        problems: The problems.
        observer: The evaluations of the problems.
        stops: Why each search stopped, as one word.
    """
    ladders = [[_best_within(found, rung) for rung in LADDER] for found in observer.improvements]
    codes = jnp.stack([jnp.stack([best.code for best in ladder]) for ladder in ladders])
    surfaces = jnp.stack([jnp.asarray(one.surface) for one in problems])
    ious = np.asarray(_ious(problems[0].decoder, codes, surfaces))
    return {
        one.name: {
            "calls": observer.calls[i],
            "seconds": _rounded(observer.seconds[i]),
            "stop": stops[i],
            "objective": [float(f"{best.loss:.7g}") for best in ladders[i]],
            "iou": [round(float(x), 5) for x in ious[i]],
            "reached": [
                [found.calls, _rounded(found.seconds)]
                for found in _first_below(observer.improvements[i], targets(one))
            ],
            "code": packed_code(ladders[i][-1].code),
        }
        for i, one in enumerate(problems)
    }


def targets(problem: Problem) -> list[float]:
    """The objectives to reach, from near that of the first code to near the lowest known."""
    first, best = float(problem.first_objective), problem.best_objective
    return [best + left * (first - best) for left in LEFT]


def _best_within(found: Sequence[Improvement], calls: int) -> Improvement:
    """The best code within a number of decoder calls."""
    return [one for one in found if one.calls <= calls][-1]


def _first_below(found: Sequence[Improvement], goals: Sequence[float]) -> list[Improvement]:
    """The first code that reached each goal, for the goals that were reached."""
    first = [next((one for one in found if one.loss <= goal), None) for goal in goals]
    return [one for one in first if one is not None]


@jax.jit
def _ious(
    prior: Any, codes: Float[Array, "problem rung d"], surfaces: Any
) -> Float[Array, "problem rung"]:
    return iou(decode(prior, codes) > 0, surfaces[:, None])


def _rounded(seconds: float) -> float:
    return float(f"{seconds:.4g}")


def packed_code(code: Float[Array | np.ndarray, " d"]) -> str:
    """A code as text."""
    return base64.b64encode(np.asarray(code, "<f4").tobytes()).decode()


def unpacked_code(text: str) -> Float[Array, " d"]:
    """The code that was written as text."""
    return jnp.asarray(np.frombuffer(base64.b64decode(text), "<f4"))
