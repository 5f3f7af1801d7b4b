"""The default network, conditioned on the measurement: completing, and scoring codes.

Against the same network in PyTorch, in its fastest variant.
"""

from collections.abc import Callable
from functools import partial
from itertools import product
from typing import Any

import jax
import numpy as np

import jaxshape as js
from benchmarks import problems
from benchmarks.harness import (
    Metric,
    alternate,
    compiled,
    difference,
    fastest,
    optional,
    speedup,
)
from benchmarks.problems import PRECISIONS, Problem
from jaxshape.geometry.grids import Grids
from jaxshape.model.completion import evidence_of
from jaxshape.model.config import Precision
from jaxshape.model.shapes import decode_prepared, pick

OBJECTS, POPULATIONS = (1, 16), (17, 64)
LAYOUTS = {"contiguous": False, "channels last": True}
TARGETS = {"float32": 1.3, "bfloat16": 1.0}
"""Times faster than PyTorch in completing and in scoring codes."""

LIMITS = {"float32": 2e-5, "bfloat16": 1e-2}
"""Differences of the objective, in nats per voxel, that rounding explains."""


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
        seen = _channels_first(grids)
        rivals = {
            name: partial(torch.completer(network, channels_last=last), seen)
            for name, last in LAYOUTS.items()
        }
    return _against(
        f"completion/complete/{len(problem.occupied)}",
        partial(ours, prior, grids),
        compile_seconds,
        rivals,
        budget,
        target=TARGETS["float32"],
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
        scorer = partial(torch.scorer, network, _channels_first(grids)[0], *target)
        host = np.array(codes)
        kinds = {"float32": ("no",), "bfloat16": ("autocast", "cast")}[precision]
        rivals = {
            f"{layout}, {size or 'all'} at a time" + (f", {kind}" if kind != "no" else ""): partial(
                scorer(channels_last=LAYOUTS[layout], bfloat16=kind, at_a_time=size), host
            )
            for layout, kind, size in product(LAYOUTS, kinds, (None, 8))
        }
        exact = scorer()(host)
    return _against(
        f"completion/{precision}/{population}",
        partial(ours, *arguments),
        compile_seconds,
        rivals,
        budget,
        target=TARGETS[precision],
        limit=LIMITS[precision],
        exact=exact,
    )


def _channels_first(grids: Grids) -> np.ndarray:
    """The four channels of evidence that the network sees, as PyTorch orders them."""
    return np.moveaxis(np.array(jax.jit(evidence_of)(grids)), -1, 1).copy()


def _against(
    name: str,
    ours: Callable[[], Any],
    compile_seconds: float,
    rivals: dict[str, Callable[[], Any]],
    budget: float,
    *,
    target: float,
    limit: float | None = None,
    exact: Any = None,
) -> list[Metric]:
    """Times of ours and of the fastest rival, in turns, and the difference of their outputs."""
    functions = {"jaxshape": ours}
    chosen = fastest(rivals) if rivals else ""
    if rivals:
        functions["pytorch"] = rivals[chosen]
    seconds = alternate(functions, budget=budget)
    metrics = [
        Metric(f"{name}/compile", compile_seconds, "s"),
        Metric(f"{name}/jaxshape", 1e3 * np.median(seconds["jaxshape"]), "ms"),
    ]
    if rivals:
        metrics += [
            Metric(f"{name}/pytorch", 1e3 * np.median(seconds["pytorch"]), "ms", note=chosen),
            Metric(f"{name}/speedup", speedup(seconds, "jaxshape", "pytorch"), "x", "higher",
                   target=target),
        ]  # fmt: skip
    if rivals and limit is not None:
        exact = rivals[chosen]() if exact is None else exact
        metrics.append(
            Metric(f"{name}/difference", difference(ours(), exact), "", "lower", limit=limit,
                   note="largest, from PyTorch")
        )  # fmt: skip
    return metrics
