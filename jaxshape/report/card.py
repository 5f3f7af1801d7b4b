"""The model card of a training run: data, training and quality of the weights.

A card is a dictionary, kept in the weights file and as JSON; `describe` writes it out in Markdown.
"""

import os
import platform
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import jax

from jaxshape.geometry.grid import RESOLUTION
from jaxshape.model import weights
from jaxshape.model.completion import COMPLETION
from jaxshape.model.config import TrainConfig
from jaxshape.model.families import family_of
from jaxshape.model.pca import PCA
from jaxshape.model.training import Report
from jaxshape.process import processor

COLUMNS = (
    "frames", "method", "IoU", "IoU composed", "IoU occluded", "nats occluded", "Chamfer-L1",
    "F-score", "objective",
)  # fmt: skip


_BOUNDS = {"occluded_empty": "F", "occluded_full": "F or M", "ceiling": "ceiling"}

FEW = 1000
"""Objects below which a card warns of memorising."""


def training_card(
    config: TrainConfig,
    metrics: Sequence[Report],
    data: dict[str, Any],
    *,
    start: Path | None,
    command: str,
    licence: str,
) -> dict[str, Any]:
    """The card of a finished run.

    Args:
        config: Settings of the run.
        metrics: Reports of the run.
        data: Description of the dataset, with its `source` and the number of objects `used`.
        start: Weights that the run began with (their own samples are counted under
            `samples_before`); None for random ones.
        command: The command that started the run.
        licence: Licence of the weights.
    """
    before = weights.load_card(start) if start else {}
    return basis_card(config, data, command=command, licence=licence) | {
        "model": family_of(config.architecture).model.kind,
        "config": asdict(config),
        "samples": config.steps * config.batch,
        "samples_before": before.get("samples", 0) + before.get("samples_before", 0),
        "start": weights.fingerprint(weights.load_prior(start)) if start else None,
        "training_loss": metrics[-1].loss,
        "training_iou": metrics[-1].iou,
        "validation_iou": metrics[-1].validation_iou,
        "validation_occluded": metrics[-1].validation_occluded,
        "training_seconds": round(sum(report.seconds for report in metrics)),
    }


def basis_card(
    config: TrainConfig, data: dict[str, Any], *, command: str, licence: str
) -> dict[str, Any]:
    """The card of principal components; `data` is the argument of `training_card`."""
    return {
        "model": "pca",
        "data": data,
        "licence": licence,
        "command": command,
        "code": config.architecture.code,
        "resolution": data["config"].get("resolution", RESOLUTION),
        "seed": config.seed,
        "hardware": hardware(),
    }


def rows_of(means: dict[str, Any]) -> Iterator[list[str]]:
    """The means of an evaluation as rows of a table under `COLUMNS`."""
    for frames, methods in means.items():
        for method, scores in methods.items():
            if method == "bounds":
                for name, value in scores.items():
                    yield [frames, _BOUNDS[name], f"{value:.3f}", *[""] * (len(COLUMNS) - 3)]
            else:
                values = [f"{x:.{4 if name == 'chamfer_l1' else 3}f}" for name, x in scores.items()]
                yield [frames, method, *values]


def markdown_table(means: dict[str, Any]) -> str:
    """The means of an evaluation as a Markdown table."""
    header = [list(COLUMNS), ["--:", "---"] + ["--:"] * (len(COLUMNS) - 2)]
    return "\n".join("| " + " | ".join(row) + " |" for row in [*header, *rows_of(means)])


def hardware() -> str:
    """The devices and versions that this process computes with."""
    kinds = Counter(device.device_kind for device in jax.devices())
    cores = f"{os.cpu_count()} CPU cores ({processor().name})"
    devices = ", ".join(cores if k == "cpu" else f"{count} x {k}" for k, count in kinds.items())
    return f"{devices}, Python {platform.python_version()}, jax {jax.__version__}"


def describe(name: str, card: dict[str, Any], scores: dict[str, Any] | None = None) -> str:
    """The card of `name`.safetensors in Markdown, with the figures of an evaluation if any."""
    facts = "\n".join(f"| {fact} | {text} |" for fact, text in _facts(card).items())
    limits = "\n".join(f"- {limit}" for limit in _limits(card, scores))
    return f"""# Model card: {name}.safetensors

A shape prior for jaxshape (`--weights {name}.safetensors`):
{_model(card)},
with the mean and covariance of the training codes.

| | |
|---|---|
{facts}

## Figures

{_figures(scores)}

## Limits

{limits}
"""


def _model(card: dict[str, Any]) -> str:
    grids = f"of {card['resolution']}^3 grids, a code of {card['code']} numbers"
    if card["model"] == "pca":
        return f"principal components {grids}"
    sizes = card["config"]["architecture"]
    if card["model"] == COMPLETION.kind:
        channels = _chain(sizes["channels"])
        return (
            f"a network conditioned on the measurement, {grids}, {channels} channels at a half, "
            "a quarter\nand an eighth of the resolution"
        )
    encoder, decoder = _chain(sizes["encoder"]), _chain([*sizes["decoder"], 1])
    return f"an auto-encoder {grids}, encoder {encoder}, decoder {decoder}"


def _chain(channels: Sequence[int]) -> str:
    return "-".join(map(str, channels))


def _facts(card: dict[str, Any]) -> dict[str, str]:
    data = card["data"]
    left_out = data["objects"] - data["used"]
    facts = {
        "Data": f"{data['used']:,} objects of `{data['source']}`"
        + f" ({left_out} more could not be used)" * bool(left_out)
        + f", each filmed along {_paths(data['config'])}",
        "Licence": card["licence"],
        "Command": f"`{card['command']}`",
    }
    return facts | ({} if card["model"] == PCA.kind else _run(card))


def _paths(config: dict[str, Any]) -> str:
    count = config["paths"]
    frames = ", ".join(map(str, config["frames"]))
    return (
        f"{count} path{'s' * (count > 1)} by a camera ({', '.join(config['cameras'])}), "
        f"{config['noisy']:.0%} with sensor noise; inputs are measurements of {frames} frames"
    )


def _run(card: dict[str, Any]) -> dict[str, str]:
    """The facts of a training run."""
    config = card["config"]
    facts = {
        "Training": f"{card['samples']:,} samples, {config['steps']:,} steps of "
        f"{config['batch']}; {config['optimizer'].capitalize()}, {config['schedule']} step size, "
        f"{config['learning_rate']:g} at its peak; "
        f"{'bfloat16' if config['bfloat16'] else 'float32'}; seed {config['seed']}",
        "Time and hardware": f"{card['training_seconds']:,} s on {card['hardware']}",
        "Last training loss": f"{card['training_loss']:.4f} nats per voxel, "
        f"IoU {card['training_iou']:.3f}",
    }
    if card["validation_iou"] is not None:
        facts["Objects kept out"] = (
            f"IoU {card['validation_iou']:.3f} of the decoded first codes, "
            f"{card['validation_occluded']:.3f} in occluded voxels"
        )
    if card["start"]:
        before = f"after {card['samples_before']:,} samples"
        facts["Started from"] = f"weights with the fingerprint {card['start'][:16]}, {before}"
    return facts


def _figures(scores: dict[str, Any] | None) -> str:
    if scores is None:
        return "None yet: score the weights on meshes that were held out, `jaxshape evaluate`."
    config = scores["config"]
    return f"""Means over the meshes held out of training, {len(scores["per_mesh"])} of the same \
folder; first k frames of an orbit at
30 degrees elevation, {_seen(config)}; {config["refine"]["iterations"]} iterations:

{markdown_table(scores["means"])}

IoU, Chamfer-L1 (a fraction of the bounding-box diagonal) and F-score (at 1 % of the grid's side)
are of the decoded shape; the composed shape keeps measured voxels and fills in only occluded ones.
IoU occluded is that of the composed shape in the occluded voxels alone, nats occluded the
cross-entropy there. F is the measurement alone, F or M the measurement with all occluded voxels
filled. Single meshes are in evaluation.json."""


def _seen(config: dict[str, Any]) -> str:
    """The camera of an evaluation, and how its frames were fused."""
    noise = "with noise" if config["noise"] else "without noise"
    fused = "signed distances" if config["fusion"] == "distance" else "points in voxels"
    return f"camera {config['camera']} {noise}, fused as {fused}"


def _limits(card: dict[str, Any], scores: dict[str, Any] | None) -> Iterator[str]:
    yield (
        "Knows only objects like its training objects: upright, front along +z, each axis scaled "
        "to fill\n  the grid up to a voxel on each side. Parts thinner than a voxel merge with "
        "their neighbours."
    )
    if scores is not None:
        yield (
            "The figures are for meshes from the training collection, seen by a "
            "simulated camera with\n  exact poses. Other objects, and real frames, will do worse."
        )
    if card["data"]["used"] < FEW:
        yield (
            f"{card['data']['used']} objects are few: the network may memorise them rather than "
            "learn the category."
        )
