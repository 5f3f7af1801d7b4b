"""One training step of 32 pairs, against the same network in PyTorch."""

from dataclasses import replace
from functools import partial

import jax.numpy as jnp
import numpy as np

from benchmarks import problems
from benchmarks.harness import Metric, alternate, compiled, difference, fastest, optional, speedup
from benchmarks.problems import PRECISIONS
from jaxshape.model.config import PRESETS, Precision
from jaxshape.model.families import Batch
from jaxshape.model.training import initial_state, train_step

BATCH = 32
LIMITS = {"float32": 1e-5, "bfloat16": 3e-3}
"""Differences of the loss, in nats per voxel, that rounding explains."""


def _step(state, measured, surface, config):
    pairs = Batch(measured.astype(jnp.float32), jnp.zeros(measured.shape), surface)
    return train_step(state, pairs, config)


def run(quick: bool) -> list[Metric]:
    return [m for p in PRECISIONS for m in _compare(p, budget=4.0 if quick else 40.0)]


def _compare(precision: Precision, budget: float) -> list[Metric]:
    config = replace(
        PRESETS["autoencoder"],
        batch=BATCH,
        optimizer="adam",
        occupied_weight=1.0,
        bfloat16=precision == "bfloat16",
    )
    problem = problems.chairs(4)
    batch = [
        np.tile(np.array(x), (BATCH // 4, 1, 1, 1)) for x in (problem.occupied, problem.surface)
    ]
    step = partial(_step, config=config)
    state = initial_state(config)._replace(variables=problem.prior.params)
    ours, compile_seconds = compiled(step, state, *batch)
    functions = {"jaxshape": partial(ours, state, *batch)}

    name = f"training/{precision}"
    metrics = [Metric(f"{name}/compile", compile_seconds, "s")]
    if pytorch := optional("pytorch"):
        network = pytorch.from_jaxshape(problem.prior.params)
        variants = {
            layout: partial(
                pytorch.trainer(network, channels_last=last, bfloat16=config.bfloat16), *batch
            )
            for layout, last in {"contiguous": False, "channels last": True}.items()
        }
        losses = float(ours(state, *batch)[1][0]), variants["contiguous"]()
        chosen = fastest(variants)
        functions["pytorch"] = variants[chosen]
        note = "of the first loss, from PyTorch in the same precision"
        metrics.append(
            Metric(f"{name}/difference", difference(*losses), "nats/voxel", "lower",
                   limit=LIMITS[precision], note=note)
        )  # fmt: skip
    seconds = alternate(functions, budget=budget, at_least=2)
    for who, times in seconds.items():
        note = chosen if who == "pytorch" else ""
        metrics.append(Metric(f"{name}/{who}", BATCH / np.median(times), "samples/s", note=note))
    if "pytorch" in functions:
        ratio = speedup(seconds, "jaxshape", "pytorch")
        metrics.append(Metric(f"{name}/speedup", ratio, "x", "higher", target=1.0))
    return metrics
