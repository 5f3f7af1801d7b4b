"""Training the auto-encoder to complete partial grids (paper, section 2.3).

`train` yields after every report, so that the caller draws progress; everything it needs to go on
after a kill is in the checkpoint, and a run that was killed and resumed ends with the same weights
as one that was not: batches depend on the seed and the step alone.
"""

import json
import os
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, PyTree
from safetensors import safe_open
from safetensors.numpy import save_file

from jaxshape.data.dataset import Dataset, unpack
from jaxshape.files import atomic_path
from jaxshape.model.autoencoder import Architecture, AutoEncoder, encode, initialize
from jaxshape.model.weights import ShapePrior, flatten


@dataclass(frozen=True)
class TrainConfig:
    """Everything that decides a training run, besides its dataset."""

    architecture: Architecture = Architecture()
    steps: int = 10_000
    """Batches in all."""
    batch: int = 32
    learning_rate: float = 1e-3
    """Peak of Adam's step size; it decays to zero along a cosine (paper: 1e-4, constant)."""
    max_views: int = 18
    """Inputs fuse 1 to this many random views (paper: 1)."""
    bfloat16: bool = False
    """Compute convolutions in bfloat16; parameters, statistics and Adam stay in float32."""
    report_every: int = 100
    """Steps between checkpoints and lines of metrics."""
    seed: int = 0


class TrainState(NamedTuple):
    """What the next step needs."""

    step: Int[Array, ""]
    variables: PyTree
    """Flax collections `params` and `batch_stats`."""
    optimizer: PyTree


class Report(NamedTuple):
    """Means over the steps since the last report."""

    step: int
    loss: float
    """Binary cross-entropy in nats per voxel (paper, section 2.3)."""
    iou: float
    """Of the completed training grids, at threshold 0.5."""
    samples_per_second: float
    seconds: float
    """Spent on these steps."""


# ------------------------------------------------------------------ one step


def optimizer_for(config: TrainConfig) -> optax.GradientTransformation:
    """Adam with the paper's betas, its step size decaying along a cosine after a short warm-up."""
    warmup = min(200, config.steps // 10)
    schedule = optax.warmup_cosine_decay_schedule(0.0, config.learning_rate, warmup, config.steps)
    return optax.adam(schedule, b1=0.9, b2=0.999)


def initial_state(config: TrainConfig) -> TrainState:
    variables = initialize(jax.random.key(config.seed), config.architecture)
    return TrainState(
        jnp.zeros((), jnp.int32), variables, optimizer_for(config).init(variables["params"])
    )


def train_step(
    state: TrainState,
    measured: Bool[Array, "b x y z"],
    surface: Bool[Array, "b x y z"],
    config: TrainConfig,
) -> tuple[TrainState, tuple[Float[Array, ""], Float[Array, ""]]]:
    """One step of Adam on a batch; also its loss and mean IoU."""
    network = AutoEncoder(config.architecture, jnp.bfloat16 if config.bfloat16 else jnp.float32)

    def loss_of(params):
        variables = {**state.variables, "params": params}
        logits, updates = network.apply(variables, measured, train=True, mutable=["batch_stats"])
        loss = jnp.mean(optax.sigmoid_binary_cross_entropy(logits, surface))
        return loss, (updates, logits > 0)

    params = state.variables["params"]
    (loss, (updates, completed)), gradients = jax.value_and_grad(loss_of, has_aux=True)(params)
    moves, optimizer = optimizer_for(config).update(gradients, state.optimizer, params)
    variables = {"params": optax.apply_updates(params, moves), **updates}
    axes = (1, 2, 3)
    iou = jnp.mean(jnp.sum(completed & surface, axes) / jnp.sum(completed | surface, axes))
    return TrainState(state.step + 1, variables, optimizer), (loss, iou)


def batch_of(
    dataset: Dataset, config: TrainConfig, step: int
) -> tuple[Bool[np.ndarray, "b x y z"], Bool[np.ndarray, "b x y z"]]:
    """The fused views and complete surfaces of one step; a function of the seed and the step.

    Objects come in a new order each epoch; each sample fuses a random subset of its views.
    """
    count = len(dataset.names)
    places = np.arange(step * config.batch, (step + 1) * config.batch)
    orders = {e: np.random.default_rng((config.seed, 0, e)).permutation(count)
              for e in np.unique(places // count)}  # fmt: skip
    rng = np.random.default_rng((config.seed, 1, step))
    measured, surface = [], []
    for place in places:
        packed = dataset.packed(int(orders[place // count][place % count]))
        views = rng.integers(1, min(config.max_views, dataset.views) + 1)
        chosen = 1 + rng.choice(dataset.views, views, replace=False)
        measured.append(np.bitwise_or.reduce(packed[chosen], axis=0))
        surface.append(packed[0])
    return unpack(np.stack(measured)), unpack(np.stack(surface))


# ------------------------------------------------------------------ a run


def train(
    folder: str | os.PathLike[str], dataset: Dataset, config: TrainConfig
) -> Iterator[Report]:
    """Train until `config.steps`, from the checkpoint in `folder` where there is one.

    Adds to `metrics.jsonl` and replaces `checkpoint.safetensors` at every report.
    `ValueError` when the folder holds a run of other settings.
    """
    folder = Path(folder)
    state = _resume(folder, config)
    step_fn = jax.jit(partial(train_step, config=config), donate_argnums=0)
    metrics, start = [], time.perf_counter()
    for step in range(int(state.step), config.steps):
        state, outcome = step_fn(state, *batch_of(dataset, config, step))
        metrics.append(outcome)
        if (step + 1) % config.report_every == 0 or step + 1 == config.steps:
            loss, iou = np.mean(jax.device_get(metrics), axis=0)
            seconds = time.perf_counter() - start
            rate = config.batch * len(metrics) / seconds
            report = Report(step + 1, float(loss), float(iou), rate, seconds)
            _record(folder, report)
            save_checkpoint(folder, state, config)
            yield report
            metrics, start = [], time.perf_counter()


def finished_prior(
    folder: str | os.PathLike[str], dataset: Dataset, config: TrainConfig, *, samples: int = 4096
) -> ShapePrior:
    """The shape prior of a finished run, with the statistics of the training set's codes."""
    variables = _resume(Path(folder), config).variables
    many = replace(config, batch=64, seed=config.seed + 1)
    encode_batch = jax.jit(partial(encode, variables))
    steps = -(-min(samples, len(dataset.names)) // many.batch)
    codes = np.concatenate([encode_batch(batch_of(dataset, many, s)[0]) for s in range(steps)])
    covariance = np.cov(codes, rowvar=False)
    # Directions no code uses keep a little room to search in.
    covariance += 1e-3 * np.trace(covariance) / len(covariance) * np.eye(len(covariance))
    return ShapePrior(variables, jnp.asarray(codes.mean(0)), jnp.asarray(covariance, jnp.float32))


def save_checkpoint(folder: Path, state: TrainState, config: TrainConfig) -> None:
    """Replace the checkpoint of a run, atomically."""
    tensors = {name: np.asarray(x) for name, x in flatten(state).items()}
    with atomic_path(folder / "checkpoint.safetensors") as temporary:
        save_file(tensors, temporary, {"config": json.dumps(asdict(config))})


def _resume(folder: Path, config: TrainConfig) -> TrainState:
    """The state of the checkpoint, or the initial one where there is none."""
    path = folder / "checkpoint.safetensors"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        return initial_state(config)
    with safe_open(path, "np") as file:
        stored = json.loads(file.metadata()["config"])
        if stored != json.loads(json.dumps(asdict(config))):
            raise ValueError(
                f"{str(folder)!r} holds a training run of other settings; "
                "give the same ones to resume it, or another folder."
            )
        template = jax.eval_shape(lambda: initial_state(config))
        names = flatten(template)
        leaves = [jnp.asarray(file.get_tensor(name)) for name in names]
    return jax.tree.unflatten(jax.tree.structure(template), leaves)


def read_metrics(folder: str | os.PathLike[str]) -> list[Report]:
    """The reports of a run so far; none before the first."""
    path = Path(folder) / "metrics.jsonl"
    lines = path.read_text().splitlines() if path.exists() else []
    return [Report(**json.loads(line)) for line in lines]


def _record(folder: Path, report: Report) -> None:
    """Add a report to the metrics, in place of any from steps that a kill made to be repeated."""
    reports = [r for r in read_metrics(folder) if r.step < report.step] + [report]
    with atomic_path(folder / "metrics.jsonl") as path:
        path.write_text("".join(json.dumps(r._asdict()) + "\n" for r in reports))
