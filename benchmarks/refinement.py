"""A whole CMA-ES refinement, of one object and of sixteen at once.

Against the paper's own stack, pycma and PyTorch, one candidate at a time as the paper would and
batched as an expert would; and against evosax over a Flax decoder, the obvious JAX program.
"""

from collections.abc import Callable
from functools import partial

import jax
import numpy as np

from benchmarks import problems
from benchmarks.decode import torch_scores
from benchmarks.harness import Metric, alternate, compiled, fastest, optional, speedup
from benchmarks.problems import Problem
from jaxshape.search.run import Refined

POPULATION = 17
SIGMA0 = 0.1


def run(quick: bool) -> list[Metric]:
    return [
        *_one(problems.chairs(1), iterations=30 if quick else 350, rounds=2),
        *_together(problems.chairs(16), iterations=2 if quick else 25, rounds=2),
        *_obvious(problems.chairs(1), population=4),
    ]


def _one(problem: Problem, iterations: int, rounds: int) -> list[Metric]:
    ours, compile_seconds = _ours(problem, iterations)
    functions, best = {"jaxshape": ours}, {"jaxshape": lambda: float(ours().loss[0])}
    if (pycma := optional("pycma")) and (scores := torch_scores(problem, "float32")):
        start = np.array(problem.code[0]), problems.whitening(problem.prior)
        codes = np.array(problems.nearby_codes(problem, POPULATION))
        for name, sample in {"batched": codes, "one at a time": codes[:1]}.items():
            score = scores[fastest({name: partial(s, sample) for name, s in scores.items()})]
            functions[name] = best[name] = partial(
                pycma.search,
                score,
                *start,
                iterations=iterations,
                population=POPULATION,
                sigma0=SIGMA0,
                one_at_a_time=name == "one at a time",
            )
    seconds = alternate(functions, budget=0, at_least=rounds, warm_up=False)

    name, note = "refinement/one", f"{iterations} iterations of {POPULATION}"
    metrics = [
        Metric(f"{name}/compile", compile_seconds, "s"),
        Metric(f"{name}/jaxshape", np.median(seconds["jaxshape"]), "s", note=note),
        Metric(f"{name}/objective", best["jaxshape"](), "nats/voxel", note="jaxshape, at the end"),
    ]
    if len(functions) > 1:
        for rival, target in {"batched": 2.0, "one at a time": 5.0}.items():
            label = f"{name}/pycma_pytorch_{rival.replace(' ', '_')}"
            metrics += [
                Metric(label, np.median(seconds[rival]), "s", note=note),
                _speedup(f"{label}/speedup", seconds, rival, target),
            ]
        metrics.append(
            Metric(f"{name}/objective_of_pycma", best["batched"](), "nats/voxel", note="at the end")
        )
    return metrics


def _together(problem: Problem, iterations: int, rounds: int) -> list[Metric]:
    ours, compile_seconds = _ours(problem, iterations)
    functions = {"jaxshape": ours}
    if (pycma := optional("pycma")) and (pytorch := optional("pytorch")):
        decoder = pytorch.from_jaxshape(problem.prior.params).decoder
        score = pytorch.scorer(decoder, *problem.target, at_a_time=POPULATION)
        functions["batched"] = partial(
            pycma.search_together,
            score,
            np.array(problem.code),
            problems.whitening(problem.prior),
            iterations=iterations,
            population=POPULATION,
            sigma0=SIGMA0,
        )
    seconds = alternate(functions, budget=0, at_least=rounds, warm_up=False)

    count = len(problem.code)
    name, note = "refinement/sixteen", f"{iterations} iterations of {count} x {POPULATION}"
    metrics = [
        Metric(f"{name}/compile", compile_seconds, "s"),
        Metric(f"{name}/jaxshape", np.median(seconds["jaxshape"]), "s", note=note),
    ]
    if "batched" in functions:
        losses = functions["batched"]()
        metrics += [
            Metric(f"{name}/pycma_pytorch_batched", np.median(seconds["batched"]), "s", note=note),
            _speedup(f"{name}/pycma_pytorch_batched/speedup", seconds, "batched", 2.0),
            Metric(
                f"{name}/objective_over_pycma",
                float(np.mean(ours().loss) / np.mean(losses)),
                "x",
                "lower",
                tolerance=0.03,
                note="ratio of the mean objectives at the end",
            ),
        ]
    return metrics


def _obvious(problem: Problem, population: int) -> list[Metric]:
    """One iteration of a small population: XLA's CPU convolutions take seconds for each code."""
    rival = optional("evosax_flax")
    if rival is None:
        return []
    target = jax.tree.map(lambda x: x[0], problem.target)
    arguments = jax.random.key(0), problem.code[0], problems.whitening(problem.prior)
    arguments = (*arguments[:2], np.float32(arguments[2]))
    search = rival.search(problem.prior.params, target, iterations=1, population=population)
    theirs, compile_seconds = compiled(search, *arguments)
    ours, _ = _ours(problem, 1, population)
    seconds = alternate(
        {"jaxshape": ours, "evosax": partial(theirs, *arguments)}, budget=0, at_least=1
    )
    per_candidate = float(np.median(seconds["evosax"])) / population
    name = "refinement/evosax_flax"
    return [
        Metric(f"{name}/compile", compile_seconds, "s"),
        Metric(f"{name}/candidate", per_candidate, "s", note=f"one iteration of {population}"),
        Metric(
            f"{name}/whole",
            per_candidate * POPULATION * 350,
            "s",
            note=f"350 iterations of {POPULATION}, scaled from that one",
        ),
        Metric(
            f"{name}/speedup", speedup(seconds, "jaxshape", "evosax"), "x", "higher", tolerance=1.0
        ),
    ]


def _ours(
    problem: Problem, iterations: int, population: int = POPULATION
) -> tuple[Callable[[], Refined], float]:
    """The compiled search of all objects, and the seconds its compilation took."""
    search = problems.search(problem.prior, iterations, population)
    arguments = problems.keys(len(problem.code)), problem.code, problem.target
    executable, seconds = compiled(search, *arguments)
    return partial(executable, *arguments), seconds


def _speedup(name: str, seconds: dict[str, np.ndarray], rival: str, target: float) -> Metric:
    return Metric(name, speedup(seconds, "jaxshape", rival), "x", "higher", target=target)
