"""The default network, conditioned on the measurement: completing, and scoring codes.

Against the same network in PyTorch, in its fastest variant.
"""

from functools import partial

import jax
import numpy as np

import jaxshape as js
from benchmarks import problems
from benchmarks.decode import LIMITS, TARGETS, variants
from benchmarks.harness import LAYOUTS, Metric, against, compiled, optional
from benchmarks.problems import PRECISIONS, Problem
from jaxshape.geometry.grids import Grids
from jaxshape.model.config import Precision
from jaxshape.model.shapes import decode_prepared, pick

OBJECTS, POPULATIONS = (1, 16), (17, 64)


def run(quick: bool) -> list[Metric]:
    prior, budget = js.load_prior("chair"), 2.0 if quick else 15.0
    metrics = [m for n in OBJECTS for m in _complete(prior, problems.chairs(n), budget)]
    for precision in PRECISIONS:
        for population in POPULATIONS:
            metrics += _score(prior, problems.chairs(1), population, precision, budget)
    return metrics


def _complete(prior: js.ShapePrior, problem: Problem, budget: float) -> list[Metric]:
    """Logits of the first shapes, from F and M on."""
    grids = Grids(problem.occupied, problem.occluded)

    def complete(prior, grids):
        prepared = prior.model.prepare(prior.params, grids, "float32")
        code = prior.model.encode(prior.params, grids)
        return decode_prepared(prior.model, prepared, code)

    ours, compile_seconds = compiled(complete, prior, grids)
    rivals = {}
    if torch := optional("pytorch_completion"):
        network = torch.from_jaxshape(prior.params)
        seen = problems.channels_first(grids)
        rivals = {
            name: partial(torch.completer(network, channels_last=last), seen)
            for name, last in LAYOUTS.items()
        }
    return against(
        f"completion/complete/{len(problem.occupied)}",
        partial(ours, prior, grids),
        compile_seconds,
        rivals,
        budget,
        target=TARGETS["float32"],
        unit="",
        limit=1e-3,  # of logits
    )


def _score(
    prior: js.ShapePrior, problem: Problem, population: int, precision: Precision, budget: float
) -> list[Metric]:
    """Eq. 7 of codes of one object, whose measurement is prepared once."""
    grids = Grids(problem.occupied[:1], problem.occluded[:1])
    codes = 0.5 * jax.random.normal(jax.random.key(0), (population, prior.code_mean.size))
    target = jax.tree.map(lambda x: x[0], problem.target)
    prepare = partial(prior.model.prepare, precision=precision)
    prepared = jax.jit(prepare)(prior.params, grids)
    prepared = prepared._replace(own=pick(prepared.own, 0))
    arguments = prior.model, prepared, codes, target
    ours, compile_seconds = compiled(problems.score, *arguments)
    rivals, exact = {}, None
    if torch := optional("pytorch_completion"):
        network = torch.from_jaxshape(prior.params)
        scorer = partial(torch.scorer, network, problems.channels_first(grids)[0], *target)
        host = np.array(codes)
        rivals = {name: partial(one, host) for name, one in variants(scorer, precision).items()}
        exact = scorer()(host)
    return against(
        f"completion/{precision}/{population}",
        partial(ours, *arguments),
        compile_seconds,
        rivals,
        budget,
        target=TARGETS[precision],
        unit="nats/voxel",
        limit=LIMITS[precision],
        exact=exact,
    )
