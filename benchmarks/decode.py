"""Decode and score populations of codes: against PyTorch, and against the machine's own limit.

The limit is the time that the decoder's useful arithmetic would take at the best rate at which the
machine multiplies matrices in that precision. Useful are the taps that land inside the grid.
"""

from collections.abc import Callable
from functools import partial
from itertools import pairwise, product

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import problems
from benchmarks.harness import LAYOUTS, Metric, against, alternate, compiled, optional
from benchmarks.problems import PRECISIONS, Problem
from jaxshape.model.autoencoder import architecture_of
from jaxshape.model.config import Architecture, Precision

POPULATIONS = (17, 64, 256)
TARGETS = {"float32": 1.3, "bfloat16": 1.0}
"""Times faster than PyTorch, of 17 and 64 codes."""

LIMITS = {"float32": 2e-5, "bfloat16": 1e-2}
"""Differences of the objective, in nats per voxel, that rounding explains."""


def run(quick: bool) -> list[Metric]:
    problem, metrics = problems.chairs(1), []
    for precision in PRECISIONS:
        rate, multiplied_by = matrix_rate(precision)
        note = f"best of {multiplied_by}"
        metrics.append(Metric(f"decode/{precision}/matrix_rate", rate / 1e9, "GFLOP/s", note=note))
        for population in POPULATIONS[:2] if quick else POPULATIONS:
            metrics += _compare(problem, population, precision, rate, 2.0 if quick else 15.0)
    return metrics


def _compare(
    problem: Problem, population: int, precision: Precision, rate: float, budget: float
) -> list[Metric]:
    codes = problems.nearby_codes(problem, population)
    target = jax.tree.map(lambda x: x[0], problem.target)
    # Once per search, as PyTorch's folding is.
    prior = problem.prior
    prepare = partial(prior.model.prepare, grids=None, precision=precision)
    arguments = prior.model, jax.jit(prepare)(prior.params), codes, target
    ours, compile_seconds = compiled(problems.score, *arguments)
    scores, host = torch_scores(problem, precision), np.array(codes)
    exact = None
    if scores:
        exact = torch_scores(problem, "float32")["contiguous, all at a time"](host)
    name = f"decode/{precision}/{population}"
    metrics = against(
        name,
        partial(ours, *arguments),
        compile_seconds,
        {variant: partial(score, host) for variant, score in scores.items()},
        budget,
        target=TARGETS[precision] if population < 256 else None,
        unit="nats/voxel",
        limit=LIMITS[precision],
        exact=exact,
    )
    seconds = next(one.value for one in metrics if one.name == f"{name}/jaxshape") / 1e3
    useful = population * useful_flops(architecture_of(prior.params))
    times_limit = Metric(
        f"{name}/times_limit",
        seconds * rate / useful,
        "x",
        "lower",
        tolerance=1.5,  # the two rates are measured one after the other, not in turns
        target=2.0 if precision == "float32" and population < 256 else None,
        note="time over that of the useful products at the best matrix rate",
    )
    return [*metrics, times_limit]


def torch_scores(problem: Problem, precision: Precision) -> dict[str, Callable]:
    """PyTorch's variants; none where PyTorch is missing. Batch normalisation is folded in all."""
    pytorch = optional("pytorch")
    if pytorch is None:
        return {}
    decoder = pytorch.from_jaxshape(problem.prior.params).decoder
    target = [x[0] for x in problem.target]
    return variants(partial(pytorch.scorer, decoder, *target), precision)


def variants(scorer: Callable[..., Callable], precision: Precision) -> dict[str, Callable]:
    """Every way in which PyTorch may score codes: layouts, arithmetic, and codes at a time."""
    arithmetic = {"float32": ("no",), "bfloat16": ("autocast", "cast")}[precision]
    return {
        f"{layout}, {size or 'all'} at a time" + (f", {how}" if how != "no" else ""): scorer(
            channels_last=last, bfloat16=how, at_a_time=size
        )
        for (layout, last), how, size in product(LAYOUTS.items(), arithmetic, (None, 8))
    }


# ------------------------------------------------------------------ the limit


def useful_flops(architecture: Architecture) -> int:
    """Floating-point operations to decode one code, over taps that land inside the grid."""
    channels = (architecture.code, *architecture.decoder, 1)
    pairs = [4, *(5 * n - 3 for n in (4, 8, 16))]  # (coarse voxel, tap) along one axis
    return sum(2 * n**3 * i * o for n, (i, o) in zip(pairs, pairwise(channels), strict=True))


def matrix_rate(precision: Precision) -> tuple[float, str]:
    """Best measured rate of matrix products, in FLOP/s, and whose it was."""
    shapes = [(2048, 2048, 2048), (4096, 512, 512), (512, 1152, 512)]
    functions = {}
    for m, k, n in shapes:
        a, b = np.random.default_rng(0).random((m, k)), np.random.default_rng(1).random((k, n))
        x, y = (jnp.asarray(matrix, precision) for matrix in (a, b))
        functions[f"jax, {m} x {k} x {n}"] = partial(jax.jit(jnp.matmul), x, y)
        if pytorch := optional("pytorch"):
            functions[f"pytorch, {m} x {k} x {n}"] = pytorch.product(a, b, precision)
    seconds = alternate(functions, budget=1.0, at_least=5)
    flops = {name: 2 * np.prod(shape) for name, shape in _by_shape(functions, shapes)}
    rates = {name: flops[name] / seconds[name].min() for name in functions}
    best = max(rates, key=lambda name: rates[name])
    return float(rates[best]), best


def _by_shape(functions, shapes):
    each = len(functions) // len(shapes)
    return zip(functions, [shape for shape in shapes for _ in range(each)], strict=True)
