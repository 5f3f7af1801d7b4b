"""From nothing to the first shape: in a first process, and in one with a warm cache."""

import tempfile
import time

from benchmarks.harness import Metric, in_fresh_process

TARGETS = {"first": 10.0, "second": 3.0}
"""Seconds until the first shape, in a process that has to compile and in the next one."""

CASES = {
    "default": ("chair", "encoder"),
    "adam": ("chair-autoencoder", "gradient:adam"),
    "cma": ("chair-autoencoder", "cma"),
}
"""Weights and search: the defaults of both networks, and the paper's search."""

ITERATIONS = 5


def run(quick: bool) -> list[Metric]:
    cases = ("default",) if quick else CASES
    return [metric for case in cases for metric in _both_processes(case)]


def _both_processes(case: str) -> list[Metric]:
    metrics = []
    with tempfile.TemporaryDirectory() as cache:
        for process, target in TARGETS.items():
            stages = in_fresh_process(
                "benchmarks.startup:first_result",
                *CASES[case],
                time.time(),
                JAX_COMPILATION_CACHE_DIR=cache,
                JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS="0",
                JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES="0",
            )
            # The measured grid would come from a camera: making it is no part of the start.
            del stages["measure"]
            name, total = f"startup/{case}/{process}", sum(stages.values())
            note = "all, with the interpreter"
            metrics.append(Metric(name, total, "s", "lower", 0.5, target=target, note=note))
            metrics += [Metric(f"{name}/{stage}", t, "s") for stage, t in stages.items()]
    return metrics


def first_result(weights: str, method: str, started: float) -> dict[str, float]:
    """Seconds of each stage of the first shape of one object, from the start of the process on.

    Args:
        weights: Name of the weights.
        method: Name of the search.
        started: Time at which the process was started, in seconds since 1970.
    """
    clock = _Clock(started)
    clock("start")
    import jax

    import jaxshape as js

    js.reconstruct, js.load_prior, js.refiner_for  # noqa: B018 (imported when first named)
    clock("import")
    prior = js.load_prior(weights)
    config = js.RefineConfig(iterations=ITERATIONS)
    search = js.refiner_for(method, prior, config)
    clock("load")
    F, M = _measured()
    clock("measure")
    rebuild = jax.jit(lambda key, prior, F, M: js.reconstruct(key, prior, F, M, search, config))
    arguments = jax.random.key(0)[None], prior, F[None], M[None]
    traced = rebuild.trace(*arguments)
    clock("trace")
    lowered = traced.lower()
    clock("lower")
    executable = lowered.compile()
    clock("compile")
    jax.block_until_ready(executable(*arguments))
    clock("run")
    return clock.stages


def _measured():
    """F and M of a box seen from the front: only their shapes matter."""
    import jax.numpy as jnp
    import numpy as np

    F, M = np.zeros((2, 32, 32, 32), bool)
    F[8:24, 8:24, 20] = True
    M[8:24, 8:24, :20] = True
    return jnp.asarray(F), jnp.asarray(M)


class _Clock:
    """Notes how long each stage took."""

    def __init__(self, started: float):
        self.stages: dict[str, float] = {}
        self._last = started

    def __call__(self, stage: str) -> None:
        now = time.time()
        self.stages[stage], self._last = now - self._last, now
