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
