"""What every benchmark has in common: metrics, paired timings, fresh processes, the machine."""

import importlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import jax
import numpy as np
from jaxtyping import Float

from jaxshape.bench.machine import describe_machine

ROOT = Path(__file__).parents[1]
LAYOUTS = {"contiguous": False, "channels last": True}
"""PyTorch's layouts of grids, and whether channels are last."""

BURST = 0.03
"""Seconds that a function is called again and again before it is another one's turn."""

PACKAGES = (
    "jaxshape", "jax", "jaxlib", "flax", "numpy", "torch", "cma", "evosax", "open3d", "small_gicp"
)  # fmt: skip


@dataclass(frozen=True)
class Metric:
    """One measured number, and what is asked of it."""

    name: str
    value: float
    unit: str
    direction: Literal["lower", "higher", "info"] = "info"
    """Which way is better; `info` is for the reader only."""
    tolerance: float = 0.4
    """How much worse than the baseline it may get, as a fraction of the baseline; on shared cores
    ratios move by a third from run to run."""
    limit: float | None = None
    """What it may not pass whatever the baseline says: for the agreement of outputs."""
    target: float | None = None
    """What the project set out to reach."""
    note: str = ""

    @property
    def reached(self) -> bool | None:
        """Whether the target is met; None where there is none."""
        return None if self.target is None else within(self, self.target)


def within(metric: Metric, bound: float) -> bool:
    """Whether a metric is at least as good as a bound; NaN never is."""
    return metric.value >= bound if metric.direction == "higher" else metric.value <= bound


# ------------------------------------------------------------------ time


def compiled(function: Callable, *arguments: Any) -> tuple[Callable, float]:
    """A function compiled for the shapes of its arguments, and the seconds that took."""
    start = time.perf_counter()
    executable = jax.jit(function).lower(*arguments).compile()
    return executable, time.perf_counter() - start


def alternate(
    functions: dict[str, Callable[[], Any]],
    *,
    budget: float,
    at_least: int = 3,
    warm_up: bool = True,
) -> dict[str, Float[np.ndarray, " round"]]:
    """Seconds per call of each function, in turns A B A B ... until the budget of seconds is spent.

    Taking turns gives whatever else the machine does to all alike. A turn is a burst of at least
    `BURST` seconds, or a function of a millisecond would be timed with the caches of another one
    and with threads that must wake first. The first call, which compiles and allocates, is not
    counted.
    """
    if warm_up:
        for function in functions.values():
            jax.block_until_ready(function())
    rounds, start = [], time.perf_counter()
    while len(rounds) < at_least or time.perf_counter() - start < budget:
        rounds.append([_seconds_per_call(function) for function in functions.values()])
    return dict(zip(functions, np.array(rounds).T, strict=True))


def _seconds_per_call(function: Callable[[], Any]) -> float:
    start, calls, elapsed = time.perf_counter(), 0, 0.0
    while elapsed < BURST:
        jax.block_until_ready(function())
        calls, elapsed = calls + 1, time.perf_counter() - start
    return elapsed / calls


def speedup(seconds: dict[str, np.ndarray], ours: str, rival: str) -> float:
    """How many times faster ours is: the median over the rounds, each its own comparison."""
    return float(np.median(seconds[rival] / seconds[ours]))


def fastest(functions: dict[str, Callable[[], Any]]) -> str:
    """Which of several variants of a rival is worth the comparison."""
    seconds = alternate(functions, budget=0.3, at_least=1)
    return min(seconds, key=lambda name: np.median(seconds[name]))


def against(
    name: str,
    ours: Callable[[], Any],
    compile_seconds: float,
    rivals: dict[str, Callable[[], Any]],
    budget: float,
    *,
    target: float | None,
    unit: str,
    limit: float,
    exact: Any = None,
) -> list[Metric]:
    """Times of ours and of PyTorch's fastest variant, in turns, and the difference of the outputs.

    Args:
        name: Name of the metrics.
        ours: Our function.
        compile_seconds: How long it took to compile.
        rivals: PyTorch's variants; none where PyTorch is missing.
        budget: Seconds of measuring.
        target: How many times faster ours is to be.
        unit: Unit of the outputs.
        limit: Largest difference of the outputs that rounding explains.
        exact: PyTorch's output in float32; None for that of the fastest variant.
    """
    functions, chosen = {"jaxshape": ours}, ""
    if rivals:
        chosen = fastest(rivals)
        functions["pytorch"] = rivals[chosen]
    seconds = alternate(functions, budget=budget)
    metrics = [
        Metric(f"{name}/compile", compile_seconds, "s"),
        Metric(f"{name}/jaxshape", 1e3 * float(np.median(seconds["jaxshape"])), "ms"),
    ]
    if rivals:
        exact = rivals[chosen]() if exact is None else exact
        times = 1e3 * float(np.median(seconds["pytorch"]))
        ratio = speedup(seconds, "jaxshape", "pytorch")
        note = "largest, from PyTorch in float32"
        metrics += [
            Metric(f"{name}/pytorch", times, "ms", note=chosen),
            Metric(f"{name}/speedup", ratio, "x", "higher", target=target),
            Metric(f"{name}/difference", difference(ours(), exact), unit, "lower",
                   limit=limit, note=note),
        ]  # fmt: skip
    return metrics


def difference(a: Any, b: Any) -> float:
    """Largest absolute difference of two outputs."""
    return float(np.max(np.abs(np.asarray(a, np.float64) - np.asarray(b, np.float64))))


# ------------------------------------------------------------------ surroundings


def optional(module: str) -> ModuleType | None:
    """A rival's module, or None where the package it needs is not installed."""
    try:
        return importlib.import_module(f"benchmarks.rivals.{module}")
    except ImportError:
        return None


def in_fresh_process(function: str, *arguments: Any, **environment: str) -> Any:
    """The result of `"module:function"` in a new interpreter, by way of JSON."""
    module, name = function.split(":")
    code = (
        f"import json, sys; from {module} import {name};"
        f"print(json.dumps({name}(*json.loads(sys.argv[1]))))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, json.dumps(arguments)],
        cwd=ROOT,
        env=os.environ | environment,
        capture_output=True,
        text=True,
    )
    if done.returncode:
        raise RuntimeError(f"{function} failed in a fresh process:\n{done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def machine() -> dict[str, Any]:
    """What a reader needs to compare figures: processor, device, versions."""
    return describe_machine(PACKAGES)
