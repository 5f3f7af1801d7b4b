"""How time and memory grow with the number of objects and of candidates."""

import resource
import sys
from functools import partial

import jax
import numpy as np

from benchmarks import problems
from benchmarks.harness import Metric, alternate, compiled, in_fresh_process

OBJECTS = (1, 2, 4, 8, 16, 32, 64)
POPULATIONS = (17, 64, 256, 1024)
LARGEST = (64, 1024)
ITERATIONS = 3
GIBIBYTE = 2**30


def run(quick: bool) -> list[Metric]:
    objects = (1, 4, 16) if quick else OBJECTS
    populations = (17, 256) if quick else POPULATIONS
    over_objects = {b: seconds_per_candidate(b, 17) for b in objects}
    over_populations = {n: seconds_per_candidate(1, n) for n in populations}
    metrics = [
        Metric(f"scaling/{b}x{n}/candidate", 1e3 * seconds, "ms")
        for b, n, seconds in [
            *((b, 17, s) for b, s in over_objects.items()),
            *((1, n, s) for n, s in over_populations.items() if n != 17),
        ]
    ]
    metrics += [
        Metric(
            f"scaling/{axis}/exponent",
            _exponent(times),
            "",
            "lower",
            tolerance=0.1,
            note=f"of the time of one iteration over {axis}, {min(times)} to {max(times)}",
        )
        for axis, times in {"objects": over_objects, "population": over_populations}.items()
    ]
    metrics.append(
        Metric(
            "scaling/falls_with_objects",
            over_objects[max(objects)] / over_objects[1],
            "x",
            "lower",
            target=1.0,
            note=f"time per candidate with {max(objects)} objects over that with one",
        )
    )
    return metrics + _memory(quick)


def seconds_per_candidate(objects: int, population: int) -> float:
    """Of the decoder, the objective and CMA-ES together, once compiled."""
    problem = problems.tiled(objects)
    search = problems.search(problem.prior, ITERATIONS, population)
    arguments = problems.keys(objects), problem.code, problem.target
    executable, _ = compiled(search, *arguments)
    seconds = alternate({"jaxshape": partial(executable, *arguments)}, budget=1.0, at_least=1)
    # Besides the populations: the first code, and at the end the best and the mean.
    candidates = objects * (ITERATIONS * population + 3)
    return float(np.median(seconds["jaxshape"])) / candidates


def _exponent(times: dict[int, float]) -> float:
    """Of the power law of total time over size, fitted to the logarithms."""
    sizes = np.log(list(times))
    return float(1 + np.polyfit(sizes, np.log(list(times.values())), 1)[0])


# ------------------------------------------------------------------ memory


def _memory(quick: bool) -> list[Metric]:
    """Of one iteration in a fresh process: resident, and what XLA plans for its buffers."""
    sizes = [(1, 17)] if quick else [(1, 17), (64, 17), (1, 1024), LARGEST]
    metrics = []
    for objects, population in sizes:
        peak = in_fresh_process("benchmarks.scaling:peak_memory", objects, population, True)
        name = f"scaling/{objects}x{population}/memory"
        metrics.append(Metric(name, peak["resident"] / GIBIBYTE, "GiB", "lower"))
    planned = in_fresh_process("benchmarks.scaling:peak_memory", *LARGEST, False)["planned"]
    name = f"scaling/{LARGEST[0]}x{LARGEST[1]}/planned_memory"
    note = "XLA's buffers, known without running"
    return [*metrics, Metric(name, planned / GIBIBYTE, "GiB", "lower", target=4.0, note=note)]


def peak_memory(objects: int, population: int, run: bool) -> dict[str, float]:
    """Bytes of one iteration: most that was resident, and planned for arguments and buffers."""
    problem = problems.tiled(objects)
    search = problems.search(problem.prior, 1, population)
    arguments = problems.keys(objects), problem.code, problem.target
    executable = jax.jit(search).lower(*arguments).compile()
    plan = executable.memory_analysis()
    planned = plan.argument_size_in_bytes + plan.output_size_in_bytes + plan.temp_size_in_bytes
    if run:
        jax.block_until_ready(executable(*arguments))
    unit = 1 if sys.platform == "darwin" else 1024
    resident = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
    return {"resident": float(resident), "planned": float(planned)}
