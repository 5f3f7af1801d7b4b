"""From nothing to the first refined shape: in a first process, and in one with a warm cache."""

import tempfile
import time

from benchmarks.harness import Metric, in_fresh_process

TARGETS = {"first": 15.0, "second": 6.0}
ITERATIONS = 5


def run(quick: bool) -> list[Metric]:
    del quick
    metrics = []
    with tempfile.TemporaryDirectory() as cache:
        for process, target in TARGETS.items():
            start = time.perf_counter()
            stages = in_fresh_process(
                "benchmarks.startup:first_result",
                JAX_COMPILATION_CACHE_DIR=cache,
                JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS="0",
                JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES="0",
            )
            total = time.perf_counter() - start
            # The measured grid would come from a camera: making it is no part of the start.
            total -= stages.pop("measure")
            name = f"startup/{process}"
            note = "all, with the interpreter"
            metrics.append(Metric(name, total, "s", "lower", 0.5, target=target, note=note))
            metrics += [Metric(f"{name}/{stage}", t, "s") for stage, t in stages.items()]
    return metrics


def first_result() -> dict[str, float]:
    """Seconds of each stage of the first refinement of one object."""
    clock = _Clock()
    import jax

    import jaxshape as js

    js.reconstruct, js.load_prior, js.refiner_for  # noqa: B018 (imported when first named)
    clock("import")
    prior = js.load_prior("chair-autoencoder")
    config = js.RefineConfig(iterations=ITERATIONS)
    search = js.refiner_for("cma", prior, config)
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

    def __init__(self):
        self.stages: dict[str, float] = {}
        self._last = time.perf_counter()

    def __call__(self, stage: str) -> None:
        now = time.perf_counter()
        self.stages[stage], self._last = now - self._last, now
