"""One training step of 32 pairs, of both networks, against the same network in PyTorch.

The batch is spread over the cores, as `jaxshape train` spreads it: each measurement runs in a
process of its own, in which JAX counts the cores as devices.
"""

import math
import os
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from typing import Any, Literal

import jax
import numpy as np
from jax.sharding import NamedSharding
from jax.sharding import PartitionSpec as P

import jaxshape as js
from benchmarks import problems
from benchmarks.harness import (
    LAYOUTS,
    Metric,
    alternate,
    compiled,
    difference,
    fastest,
    in_fresh_process,
    optional,
    speedup,
)
from benchmarks.problems import PRECISIONS
from jaxshape.model.config import PRESETS, Precision
from jaxshape.model.families import Batch
from jaxshape.model.training import _parallel_step, initial_state

Network = Literal["autoencoder", "completion"]

BATCH = 32
CASES = {"autoencoder": ("chair-autoencoder", "autoencoder"), "completion": ("chair", "default")}
"""Weights and settings of each network."""

LIMITS = {"float32": 1e-5, "bfloat16": 3e-3}
"""Differences of the loss, in nats per voxel, that rounding explains."""


def run(quick: bool) -> list[Metric]:
    budget, devices = 4.0 if quick else 40.0, math.gcd(BATCH, os.cpu_count() or 1)
    step = partial(in_fresh_process, "benchmarks.training:step", JAX_NUM_CPU_DEVICES=str(devices))
    return [
        Metric(**metric)
        for network in CASES
        for precision in PRECISIONS
        for metric in step(network, precision, budget)
    ]


def step(network: Network, precision: Precision, budget: float) -> list[dict[str, Any]]:
    """Metrics of a step of Adam with one network, as dictionaries."""
    weights, preset = CASES[network]
    config = replace(
        PRESETS[preset],
        batch=BATCH,
        optimizer="adam",
        average=0.0,
        occupied_weight=1.0,
        occluded_weight=1.0,
        bfloat16=precision == "bfloat16",
    )
    prior, problem = js.load_prior(weights), problems.chairs(4)
    tile = lambda x: np.tile(np.array(x), (BATCH // 4, 1, 1, 1))  # noqa: E731
    batch = Batch(*(tile(x).astype(np.float32) for x in problem[1:3]), tile(problem.surface))
    variables = prior.params if network == "autoencoder" else {"params": prior.params}

    mesh = jax.make_mesh((jax.device_count(),), ("batch",))
    spread = jax.device_put(batch, NamedSharding(mesh, P("batch")))
    state = initial_state(config)._replace(variables=variables)
    state = jax.device_put(state, NamedSharding(mesh, P()))
    executable, compile_seconds = compiled(_parallel_step(config, mesh), state, spread)

    def ours() -> float:
        nonlocal state
        state, (loss, _) = executable(state, spread)  # the state before the step is used up
        return float(loss)

    name, functions = f"training/{network}/{precision}", {"jaxshape": ours}
    metrics, chosen = [Metric(f"{name}/compile", compile_seconds, "s")], ""
    if rivals := _rivals(network, prior, batch, config.bfloat16):
        losses = ours(), rivals["contiguous"]()
        chosen = fastest(rivals)
        functions["pytorch"] = rivals[chosen]
        if network == "autoencoder":  # the other one draws codes
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
    return [asdict(metric) for metric in metrics]


def _rivals(
    network: Network, prior: js.ShapePrior, batch: Batch, bfloat16: bool
) -> dict[str, Callable[[], float]]:
    """PyTorch's variants; none where PyTorch is missing."""
    if network == "autoencoder":
        torch, arguments = optional("pytorch"), (batch.occupied, batch.surface)
    else:
        seen = problems.channels_first(batch.grids)
        noise = np.random.default_rng(0).normal(size=(BATCH, prior.code_size))
        torch = optional("pytorch_completion")
        arguments = seen, batch.surface, noise
    if torch is None:
        return {}
    same = torch.from_jaxshape(prior.params)
    return {
        layout: partial(torch.trainer(same, channels_last=last, bfloat16=bfloat16), *arguments)
        for layout, last in LAYOUTS.items()
    }
