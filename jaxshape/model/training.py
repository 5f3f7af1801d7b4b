"""Training a network to complete partial grids (paper, section 2.3).

`train` yields after every report, so that the caller can show progress. The checkpoint holds
everything that is needed to resume. A run that was killed and resumed ends with the same weights as
an uninterrupted one, because batches depend only on the seed and the step.
"""

import hashlib
import json
import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P
from jaxtyping import Array, Float, Int, PyTree
from optax.contrib import MuonDimensionNumbers, muon
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from jaxshape import limits, reading
from jaxshape.data.dataset import Dataset
from jaxshape.data.inputs import draw_pair
from jaxshape.files import atomic_path, write_text
from jaxshape.geometry.grids import Grids
from jaxshape.geometry.overlap import iou
from jaxshape.model.config import TrainConfig
from jaxshape.model.families import Batch, family_of
from jaxshape.model.shapes import ShapeModel, ShapePrior, decode_prepared, encode
from jaxshape.model.weights import fingerprint, flatten


class TrainState(NamedTuple):
    """State of a training run between two steps.

    Attributes:
        step: Steps taken so far.
        variables: Parameters under `params`, and the network's other state.
        optimizer: State of the optimiser.
        average: Running average of the parameters; empty where none is kept.
    """

    step: Int[Array, ""]
    variables: dict[str, PyTree]
    optimizer: PyTree
    average: PyTree


class Report(NamedTuple):
    """Means over the steps since the last report.

    Attributes:
        step: Steps taken so far.
        loss: Training loss, in nats per voxel (paper, section 2.3).
        iou: IoU of the completed training grids, at threshold 0.5, from 0 to 1.
        validation_iou: IoU of the decoded first codes of objects kept out of training; None where
            none are.
        validation_occluded: The same metric in occluded voxels alone.
        samples_per_second: Pairs per second.
        seconds: Time spent on these steps.
    """

    step: int
    loss: float
    iou: float
    validation_iou: float | None
    validation_occluded: float | None
    samples_per_second: float
    seconds: float


# ------------------------------------------------------------------ one step


def optimizer_for(config: TrainConfig) -> optax.GradientTransformation:
    """The optimiser of a run: Adam with the paper's betas, or Muon for the kernels and Adam for the
    rest.
    """
    schedule = config.learning_rate
    if config.schedule == "cosine":
        warmup = min(200, config.steps // 10)
        schedule = optax.warmup_cosine_decay_schedule(0.0, schedule, warmup, config.steps)
    if config.optimizer == "adam":
        return optax.adam(schedule, b1=0.9, b2=0.999)
    return muon(
        schedule,
        consistent_rms=0.2,  # updates about as large as those of Adam at this step size
        muon_weight_dimension_numbers=partial(jax.tree.map, _as_matrix),
    )


def _as_matrix(weights: Array) -> MuonDimensionNumbers | None:
    """Treat a kernel as a matrix from its other axes to the last; None for biases and scales."""
    axes = tuple(range(weights.ndim - 1))
    return MuonDimensionNumbers(axes, weights.ndim - 1) if weights.ndim > 1 else None


def initial_state(config: TrainConfig, start: ShapePrior | None = None) -> TrainState:
    """The state of a run before its first step.

    Args:
        config: Settings of the run.
        start: Shape prior to continue training from; None for random weights.

    Raises:
        ValueError: The weights to start from are of another model or of other sizes.
    """
    family = family_of(config.architecture)
    if start is None:
        variables = family.initialize(jax.random.key(config.seed), config.architecture)
    elif start.model != family.model:
        raise ValueError(
            f"The weights to start from are of the kind {start.model.kind!r}, "
            f"the run is of {family.model.kind!r}; give weights of that kind."
        )
    elif family.architecture_of(start.params) == config.architecture:
        # A copy, because the training step donates its buffers.
        variables = family.variables(jax.tree.map(jnp.array, start.params))
    else:
        raise ValueError(
            f"The weights to start from are of {family.architecture_of(start.params)}, "
            f"the run of {config.architecture}; give the same sizes to both."
        )
    params = variables["params"]
    average = jax.tree.map(jnp.array, params) if config.average else ()
    return TrainState(
        jnp.zeros((), jnp.int32), variables, optimizer_for(config).init(params), average
    )


def train_step(
    state: TrainState, batch: Batch, config: TrainConfig, axis: str | None = None
) -> tuple[TrainState, tuple[Float[Array, ""], Float[Array, ""]]]:
    """One step of the optimiser on a batch.

    If the batch is spread over devices, each device holds a part of it; statistics, gradients and
    metrics still cover the whole batch.

    Args:
        state: State before the step.
        batch: Training pairs.
        config: Settings of the run.
        axis: Mesh axis over which the batch is spread; None where it is not spread.

    Returns:
        The state after the step, and the loss, in nats per voxel, and the mean IoU of the batch.
    """
    noise = _noise(state.step, len(batch.surface), config, axis)
    over_all = partial(lax.pmean, axis_name=axis) if axis else lambda x: x
    cost_of = family_of(config.architecture).cost

    def loss_of(params):
        cost = cost_of({**state.variables, "params": params}, batch, noise, config, axis)
        return cost.loss, cost

    params = state.variables["params"]
    gradients, cost = jax.grad(loss_of, has_aux=True)(params)
    moves, optimizer = optimizer_for(config).update(over_all(gradients), state.optimizer, params)
    params = optax.apply_updates(params, moves)
    average = ()
    if config.average:
        share = jnp.minimum(config.average, (1 + state.step) / (10 + state.step))
        average = optax.incremental_update(params, state.average, 1 - share)
    figures = cost.loss, jnp.mean(iou(cost.completed, batch.surface))
    variables = {"params": params, **cost.variables}
    return TrainState(state.step + 1, variables, optimizer, average), over_all(figures)


def _noise(step, count, config: TrainConfig, axis):
    """Noise for each code of this device; it depends on the code's index in the whole batch."""
    key = jax.random.fold_in(jax.random.key(config.seed + 1), step)
    first = lax.axis_index(axis) * count if axis else 0
    keys = jax.vmap(partial(jax.random.fold_in, key))(first + jnp.arange(count))
    return jax.vmap(partial(jax.random.normal, shape=(config.architecture.code,)))(keys)


def batch_of(
    dataset: Dataset, config: TrainConfig, step: int, part: tuple[int, int] = (0, 1)
) -> Batch:
    """The training pairs of one step; a function of the seed and the step.

    Objects come in a new order each epoch. Each pair has its own random numbers, so that `part` (i,
    n), the i-th of n parts, equals the same rows of the whole batch.
    """
    count, (index, parts) = len(dataset.names) - validation_size(dataset, config), part
    size = config.batch // parts
    first = step * config.batch + index * size
    places = range(first, first + size)
    orders = {e: np.random.default_rng((config.seed, 0, e)).permutation(count)
              for e in {place // count for place in places}}  # fmt: skip
    pairs = [
        draw_pair(
            dataset,
            int(orders[place // count][place % count]),
            config.inputs,
            np.random.default_rng((config.seed, 1, place)),
        )
        for place in places
    ]
    return _stacked(pairs)


def _stacked(pairs: Sequence[tuple[Grids, np.ndarray]]) -> Batch:
    grids, surfaces = zip(*pairs, strict=True)
    F, M, _ = zip(*grids, strict=True)
    return Batch(np.stack(F), np.stack(M), np.stack(surfaces))


def validation_size(dataset: Dataset, config: TrainConfig) -> int:
    """Objects kept out of training, at the end of the dataset; at most a tenth of it."""
    return min(config.validation, len(dataset.names) // 10)


def validation_batch(dataset: Dataset, config: TrainConfig) -> Batch | None:
    """One input of each object that is kept out of training; None if there is no such object."""
    count = len(dataset.names)
    kept = range(count - validation_size(dataset, config), count)
    rngs = (np.random.default_rng((config.seed, 2, index)) for index in kept)
    pairs = [draw_pair(dataset, i, config.inputs, rng) for i, rng in zip(kept, rngs, strict=True)]
    return _stacked(pairs) if pairs else None


@partial(jax.jit, static_argnums=0)
def validate(
    family_model: ShapeModel, params: PyTree, batch: Batch
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Mean IoU of the decoded first codes, everywhere and in occluded voxels."""
    prepared = family_model.prepare(params, batch.grids, "float32")
    code = family_model.encode(params, batch.grids)
    completed = decode_prepared(family_model, prepared, code) > 0
    hidden = batch.occluded > 0.5
    return jnp.mean(iou(completed, batch.surface)), jnp.mean(
        iou(completed & hidden, batch.surface & hidden)
    )


# ------------------------------------------------------------------ a run


def train(
    folder: str | os.PathLike[str],
    dataset: Dataset,
    config: TrainConfig,
    start: ShapePrior | None = None,
) -> Iterator[Report]:
    """Train until `config.steps`, resuming from the folder's checkpoint if there is one. [host]

    Each batch is spread over all devices of all processes (`jax.distributed`): each process reads
    its own part of the dataset, and only the first reads and writes the folder. Adds to
    `metrics.jsonl` and replaces `checkpoint.safetensors` at every report.

    Args:
        folder: Folder of the run; made if missing.
        dataset: Training pairs, of the resolution of the network.
        config: Settings of the run.
        start: Shape prior to continue training from; None for random weights.

    Yields:
        A report after every `config.report_every` steps and after the last.

    Raises:
        ValueError: The folder holds a run of other settings or on other pairs, the resolutions
            differ, the weights to start from do not fit, or a batch cannot be divided among the
            devices.
    """
    folder = Path(folder)
    if dataset.resolution != config.architecture.resolution:
        raise ValueError(
            f"The dataset holds grids of {dataset.resolution}^3 voxels, and the network is "
            f"made for {config.architecture.resolution}^3; give it others (--resolution, or for an "
            "auto-encoder one layer more or less), or build the dataset with another --resolution."
        )
    devices, processes = jax.device_count(), jax.process_count()
    if config.batch % devices:
        raise ValueError(
            f"A batch of {config.batch} cannot be divided among {devices} devices; "
            "give a multiple of their number."
        )
    mesh = jax.make_mesh((devices,), ("batch",))
    whole, spread = NamedSharding(mesh, P()), NamedSharding(mesh, P("batch"))
    share = partial(jax.make_array_from_process_local_data, whole)
    run = _identity(config, start, dataset)
    state = jax.tree.map(share, _agreed_state(folder, run, config, start))
    step_fn = _parallel_step(config, mesh)
    kept = validation_batch(dataset, config)
    metrics, began = [], time.perf_counter()
    for step in range(int(state.step), config.steps):
        batch = batch_of(dataset, config, step, (jax.process_index(), processes))
        batch = jax.tree.map(partial(jax.make_array_from_process_local_data, spread), batch)
        state, outcome = step_fn(state, batch)
        metrics.append(outcome)
        if (step + 1) % config.report_every == 0 or step + 1 == config.steps:
            loss, overlap = np.mean(jax.device_get(metrics), axis=0)
            seconds = time.perf_counter() - began
            rate = config.batch * len(metrics) / seconds
            scores = _scores(state, config, kept)
            report = Report(step + 1, float(loss), float(overlap), *scores, rate, seconds)
            if jax.process_index() == 0:
                _record(folder, report)
                save_checkpoint(folder, state, run)
            yield report
            metrics, began = [], time.perf_counter()


def _parallel_step(config: TrainConfig, mesh: Mesh):
    """`train_step` of a batch spread over the mesh, each device on its part."""
    axis = "batch" if mesh.size > 1 else None  # XLA keeps collectives even over a single device
    step = jax.shard_map(
        partial(train_step, config=config, axis=axis),
        mesh=mesh,
        in_specs=(P(), P("batch")),
        out_specs=P(),
        check_vma=False,  # custom derivatives of the convolutions do not declare how they vary
    )
    return jax.jit(step, donate_argnums=0)


def _scores(
    state: TrainState, config: TrainConfig, kept: Batch | None
) -> tuple[float | None, float | None]:
    """IoU of the objects kept out of training, everywhere and in occluded voxels."""
    if kept is None:
        return None, None
    family = family_of(config.architecture)
    scores = validate(family.model, jax.device_get(family.params(averaged(state))), kept)
    return float(scores[0]), float(scores[1])


def averaged(state: TrainState) -> dict[str, PyTree]:
    """The variables of a run, with the running average of the parameters where one is kept."""
    return state.variables | ({"params": state.average} if state.average else {})


def finished_prior(
    folder: str | os.PathLike[str], dataset: Dataset, config: TrainConfig, *, samples: int = 4096
) -> ShapePrior:
    """The shape prior of a finished run, with the statistics of the training set's codes. [host]

    Args:
        folder: Folder of the run.
        dataset: The training pairs.
        config: Settings of the run.
        samples: Largest number of codes from which the statistics are computed.
    """
    state = _read_checkpoint(Path(folder) / "checkpoint.safetensors", config)
    family = family_of(config.architecture)
    d = config.architecture.code
    params = jax.tree.map(jnp.asarray, family.params(averaged(state)))
    prior = ShapePrior(family.model, params, jnp.zeros(d), jnp.eye(d))
    if family.codes_are_normal:
        return prior
    many = replace(config, batch=64, seed=config.seed + 1)
    encode_batch = jax.jit(lambda prior, batch: encode(prior, batch.grids))
    steps = -(-min(samples, len(dataset.names)) // many.batch)
    codes = np.concatenate(
        [encode_batch(prior, batch_of(dataset, many, step)) for step in range(steps)]
    )
    covariance = np.cov(codes, rowvar=False)
    # Directions in which the codes do not vary keep a small variance for the search.
    covariance += 1e-3 * np.trace(covariance) / d * np.eye(d)
    return prior._replace(
        code_mean=jnp.asarray(codes.mean(0)), code_covariance=jnp.asarray(covariance, jnp.float32)
    )


def save_checkpoint(folder: Path, state: TrainState, run: str) -> None:
    """Replace the checkpoint of a run, atomically; `run` identifies the run."""
    tensors = {name: np.asarray(x) for name, x in flatten(state).items()}
    with atomic_path(folder / "checkpoint.safetensors") as temporary:
        save_file(tensors, temporary, {"run": run})


def _identity(config: TrainConfig, start: ShapePrior | None, dataset: Dataset) -> str:
    """Settings, start and pairs of a run, as text; its checkpoint must have the same."""
    pairs = hashlib.sha256("\n".join(dataset.names).encode())
    pairs.update(np.asarray(dataset.measured[0][:1]).tobytes())  # depends on all of its settings
    more = {"start": start and fingerprint(start), "pairs": pairs.hexdigest()}
    return json.dumps(asdict(config) | more)


def _agreed_state(
    folder: Path, run: str, config: TrainConfig, start: ShapePrior | None
) -> TrainState:
    """The state of the checkpoint, or the initial one where there is none, for all processes.

    Only the first process reads the folder, since the others may not have access to its disk; an
    error is raised in all processes.
    """
    share, is_first = multihost_utils.broadcast_one_to_all, jax.process_index() == 0
    path = folder / "checkpoint.safetensors"
    is_there = is_first and path.exists()
    if share(is_there and not _is_of(path, run)):
        raise ValueError(
            f"{str(folder)!r} holds a training run of other settings, or on another dataset; "
            "give the same ones to resume it, or another folder."
        )
    if is_first:
        return share(_read_checkpoint(path, config) if is_there else initial_state(config, start))
    shapes = jax.eval_shape(lambda: initial_state(config, start))
    return share(jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), shapes))


def _is_of(checkpoint: Path, run: str) -> bool:
    """Whether a checkpoint is of a run; those of earlier versions do not name their pairs."""
    wanted = json.loads(run)
    with _opened(checkpoint) as file:
        found = reading.parse_json((file.metadata() or {}).get("run", "null"))
    return found in (wanted, {name: x for name, x in wanted.items() if name != "pairs"})


@contextmanager
def _opened(checkpoint: Path) -> Iterator[Any]:
    """Open a checkpoint for the block that reads it; raises `ValueError` if it is damaged."""
    try:
        with reading.opened(checkpoint, limits.WEIGHT_BYTES), safe_open(checkpoint, "np") as file:
            yield file
    except (SafetensorError, OSError, ValueError) as problem:
        raise ValueError(
            f"{str(checkpoint)!r} cannot be resumed ({problem}); remove it to start again."
        ) from problem


def _read_checkpoint(path: Path, config: TrainConfig) -> TrainState:
    template = jax.eval_shape(lambda: initial_state(config))
    with _opened(path) as file:
        leaves = [jnp.asarray(file.get_tensor(name)) for name in flatten(template)]
        wanted = jax.tree.leaves(template)
        if any(
            x.shape != y.shape or x.dtype != y.dtype for x, y in zip(leaves, wanted, strict=True)
        ):
            raise ValueError("its arrays are of other shapes")
    return jax.tree.unflatten(jax.tree.structure(template), leaves)


def read_metrics(folder: str | os.PathLike[str]) -> list[Report]:
    """The reports of a run so far; none before the first."""
    path = Path(folder) / "metrics.jsonl"
    if not path.exists():
        return []
    try:
        return [_report(line) for line in reading.read_text(path).splitlines()]
    except (OSError, ValueError, TypeError) as problem:
        raise ValueError(f"{str(path)!r} is damaged ({problem}); remove it.") from problem


def _report(line: str) -> Report:
    report = Report(**reading.parse_json(line))
    for name, value in report._asdict().items():
        is_missing = value is None and name.startswith("validation")
        if not (is_missing or isinstance(value, int | float)):
            raise ValueError(f"a {name} is {value!r:.60}, not a number")
    return report


def _record(folder: Path, report: Report) -> None:
    """Add a report to the metrics; it replaces reports of steps that are repeated after a kill."""
    reports = [r for r in read_metrics(folder) if r.step < report.step] + [report]
    lines = (json.dumps(r._asdict()) + "\n" for r in reports)
    write_text(folder / "metrics.jsonl", "".join(lines))
