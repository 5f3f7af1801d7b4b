"""What decoding in bfloat16 costs in quality: test chairs refined in either precision."""

from functools import partial

import jax
import numpy as np

import jaxshape as js
from benchmarks import problems
from benchmarks.harness import Metric
from benchmarks.problems import PRECISIONS, Problem
from jaxshape.model.config import Precision

OBJECTS_AT_A_TIME = 16


def run(quick: bool) -> list[Metric]:
    count, iterations = (8, 5) if quick else (64, 50)
    problem = problems.chairs(count)
    scores = {p: _scores(problem, iterations, p) for p in PRECISIONS}
    loss = scores["float32"] - scores["bfloat16"]
    note = f"{count} chairs, 4 frames, {iterations} iterations of 17"
    return [
        *(
            Metric(f"precision/{p}/iou", float(iou.mean()), "", note=note)
            for p, iou in scores.items()
        ),
        Metric(
            "precision/iou_lost",
            float(loss.mean()),
            "",
            "lower",
            limit=0.002 if not quick else 0.01,
            target=0.002,
            note=f"in bfloat16; standard error {loss.std() / np.sqrt(count):.4f}",
        ),
    ]


def _scores(problem: Problem, iterations: int, precision: Precision) -> np.ndarray:
    """IoU of each refined shape."""
    config = js.RefineConfig(iterations=iterations, precision=precision)
    search = js.refiner_for("cma", problem.prior, config)
    rebuild = jax.jit(partial(js.reconstruct, refiner=search, config=config))
    count, scores = min(OBJECTS_AT_A_TIME, len(problem.code)), []
    for start in range(0, len(problem.code), count):
        keys, F, M, surface = (
            x[start : start + count] for x in (problems.keys(len(problem.code)), *problem[1:4])
        )
        scores.append(js.iou(rebuild(keys, problem.prior, F, M).completed, surface))
    return np.concatenate(scores)
