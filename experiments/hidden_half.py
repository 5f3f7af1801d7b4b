r"""Which network fills the hidden half of a chair best? Four small networks at equal budget.

    jaxshape dataset --output data/chairs --count 4096
    python experiments/hidden_half.py --dataset data/chairs --meshes cad_chairs/

Each network is trained from scratch on the same pairs, and on the same number of them:

- conditional VAE: a U-Net of F and M whose decoder takes a code too, so that the code describes the
  hidden part (the package's default, at its full size);
- U-Net: the same network without a code;
- auto-encoder, F: the paper's network, which sees F alone, through a code of 100 numbers;
- auto-encoder, F and M: its encoder sees the occlusion mask, too;
- auto-encoder + U-Net: nothing new is trained. The U-Net's probabilities take the place of
  G(lambda_0) in Eq. 7 and fill the composed shape, and the code of the auto-encoder of F and M is
  searched.

They are judged on chairs that no network was trained on: IoU of the decoded shape, of the composed
shape, and of the composed shape in occluded voxels alone; before a search and after Adam.

Results: experiments/results/hidden_half.json and .png. Trained networks are kept in `--output`; a
killed training resumes from its checkpoint. Time: about an hour on two cores.
"""

import json
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import runs
from figures import drawn, number_axis
from jaxshape.data.config import CameraName
from jaxshape.data.dataset import open_dataset
from jaxshape.files import write_json
from jaxshape.geometry.grids import Grids
from jaxshape.geometry.overlap import iou
from jaxshape.model.config import PRESETS, Architecture, Completion, TrainConfig
from jaxshape.model.shapes import ShapePrior, decode, encode
from jaxshape.results.evaluation import Case, EvaluateConfig, fill
from jaxshape.results.metrics import occluded_scores
from jaxshape.search.composition import complete
from jaxshape.search.config import RefineConfig
from jaxshape.search.reconstruction import reconstruct, refiner_for
from jaxshape.search.residuals import SOFT, Residual
from study import Subject, listed, observed, tiny, together, train_reporting

CASES_AT_A_TIME = 64

UNET = replace(PRESETS["default"], architecture=Completion((16, 48, 64), 1), average=0.98)
AUTOENCODER = replace(
    PRESETS["autoencoder"],
    architecture=Architecture(encoder=(16, 32, 64, 128), decoder=(64, 32, 16)),
    occluded_weight=UNET.occluded_weight,
    average=UNET.average,
)
NETWORKS: dict[str, TrainConfig] = {
    "conditional VAE": UNET,
    "U-Net": replace(UNET, posterior_share=0.0),
    "auto-encoder, F": AUTOENCODER,
    "auto-encoder, F and M": replace(
        AUTOENCODER, architecture=replace(AUTOENCODER.architecture, occlusion=True)
    ),
}
CAMERAS: dict[str, tuple[CameraName, bool]] = {
    "paper, clean": ("paper", False),
    "kinect, noisy": ("kinect", True),
}
FRAMES = (1, 4, 8, 18)

# A search for which the U-Net takes the place of the decoded first code.
COMPLETED = Residual(lambda grids, _: SOFT.target(grids, grids.data), SOFT.score)


@dataclass(frozen=True)
class Config(runs.Config):
    """Settings of the experiment."""

    dataset: Path = Path("data/chairs")
    """Folder made by `jaxshape dataset`."""
    meshes: Path | None = None
    """Folder of meshes to judge on; without it, procedural chairs kept for tests."""
    chairs: int = 78
    """Number of meshes or chairs."""
    output: Path = Path("out/hidden_half")
    """Folder of the training runs."""
    steps: int = 400
    """Number of batches of 32 pairs for each network."""
    iterations: int = 64
    """Steps of Adam."""
    bfloat16: bool = False
    """Train in bfloat16, where the processor has matrix units for it."""


class Scores(NamedTuple):
    """IoU from 0 to 1, a number for each case."""

    decoded: jax.Array
    composed: jax.Array
    occluded: jax.Array


# ------------------------------------------------------------------ training


def trained(config: Config) -> tuple[dict[str, ShapePrior], dict[str, Any]]:
    """Every network after the same number of pairs, with its training cost."""
    dataset = open_dataset(config.dataset)
    priors, records = {}, {}
    for name, settings in NETWORKS.items():
        settings = replace(settings, steps=config.steps, bfloat16=config.bfloat16)
        if config.smoke:
            settings = tiny(settings, batch=2)
        folder = config.output / name.replace(", ", "-").replace(" ", "-")
        priors[name] = train_reporting(name, folder, dataset, settings)
        records[name] = record_of(folder, settings, priors[name])
    return priors, records


def record_of(folder: Path, settings: TrainConfig, prior: ShapePrior) -> dict[str, Any]:
    """Settings, size and time of a finished training run."""
    lines = map(json.loads, (folder / "metrics.jsonl").read_text().splitlines())
    return {
        "settings": asdict(settings),
        "pairs": settings.steps * settings.batch,
        "parameters": sum(x.size for x in jax.tree.leaves(prior.params)),
        "seconds": round(sum(line["seconds"] for line in lines)),
    }


# ------------------------------------------------------------------ judging


def scores_of(grids: Grids, logits, case: Case, conditional: bool, fill_logits=None) -> Scores:
    """Scores of a decoded shape, which fills hidden voxels unless other logits are given."""
    fill_logits = logits if fill_logits is None else fill_logits
    filled = complete(grids, fill_logits, symmetry=True, conditional=conditional)
    hidden = occluded_scores(filled.composed, filled.logits, grids.occluded, case.surface)
    return Scores(iou(logits > 0, case.surface), iou(filled.composed, case.surface), hidden.iou)


def contest(
    keys, priors: Mapping[str, ShapePrior], case: Case, config: RefineConfig
) -> dict[str, dict[str, Scores]]:
    """Scores of every network on a batch of cases: of the first code, and after Adam."""
    grids = Grids(*(jnp.asarray(x, jnp.float32) for x in case.grids[:2]))
    F, M, scores = grids.occupied, grids.occluded, {}
    for name, prior in priors.items():
        conditional = prior.model.conditional
        first = decode(prior, encode(prior, grids), grids)
        scores[name] = {"first code": scores_of(grids, first, case, conditional)}
        if name != "U-Net":  # it has no code
            adam = refiner_for("gradient:adam", prior, config)
            found = reconstruct(keys, prior, F, M, adam, config, residual=SOFT)
            scores[name]["searched"] = scores_of(grids, found.logits, case, conditional)
    unet, prior = priors["U-Net"], priors["auto-encoder, F and M"]
    proposal = decode(unet, encode(unet, grids), grids)
    adam = refiner_for("gradient:adam", prior, config)
    found = reconstruct(keys, prior, F, M, adam, config, residual=COMPLETED, data=proposal)
    scores["auto-encoder + U-Net"] = {
        "searched": scores_of(grids, found.logits, case, True, proposal)
    }
    return scores


def judged(priors: Mapping[str, ShapePrior], config: Config, camera: str) -> dict[str, Any]:
    """Mean scores by number of frames, network and stage, over the chairs that can be measured."""
    device, noise = CAMERAS[camera]
    chairs = listed(config.meshes, config.chairs)[: config.chairs]
    subjects = [Subject(chair.name, "", chair) for chair in chairs]
    seen = observed(subjects, EvaluateConfig(frames=FRAMES, camera=device, noise=noise))
    keys, case = together(seen, FRAMES)
    search = RefineConfig(iterations=config.iterations)
    run = jax.jit(lambda keys, priors, case: contest(keys, priors, case, search))
    batches, size = [], min(CASES_AT_A_TIME, len(keys))
    for start in range(0, len(keys), size):
        rows = slice(start, start + size)
        some_keys, some = jax.tree.map(lambda x, r=rows: fill(x[r], size), (keys, case))
        found, count = jax.device_get(run(some_keys, priors, some)), len(keys[rows])
        batches.append(jax.tree.map(lambda x, n=count: x[:n], found))
        print(f"{camera}: {start + count} of {len(keys)} cases", flush=True)
    scores = jax.tree.map(lambda *x: np.concatenate(x), *batches)
    n = len(FRAMES)
    return {
        str(k): jax.tree.map(
            lambda one, i=i: {
                name: round(float(x[i::n].mean()), 4) for name, x in one._asdict().items()
            },
            scores,
            is_leaf=lambda x: isinstance(x, Scores),
        )
        for i, k in enumerate(FRAMES)
    }


# ------------------------------------------------------------------ table and figure


def table(means: Mapping[str, Any]) -> str:
    """Decoded, composed and occluded IoU of every network by camera and number of frames."""
    lines = []
    for camera, by_frames in means.items():
        lines.append(f"{camera}: decoded / composed / occluded IoU after {FRAMES} frames")
        for name, stages in by_frames["1"].items():
            for stage in stages:
                cells = [by_frames[str(k)][name][stage].values() for k in FRAMES]
                row = "   ".join(" ".join(f"{x:.3f}" for x in cell) for cell in cells)
                lines.append(f"  {name + ', ' + stage:38} {row}")
    return "\n".join(lines)


def plot(means: Mapping[str, Any], path: Path) -> None:
    """IoU in occluded voxels by number of frames; dashed after the search."""
    with drawn(path, 10, 3.6) as figure:
        panels = figure.subplots(1, len(means), sharey=True, squeeze=False)[0]
        for axes, (camera, by_frames) in zip(panels, means.items(), strict=True):
            for i, (name, stages) in enumerate(by_frames["1"].items()):
                for stage in stages:
                    y = [by_frames[str(k)][name][stage]["occluded"] for k in FRAMES]
                    line = {"color": f"C{i}", "ls": "--" if stage == "searched" else "-"}
                    axes.plot(FRAMES, y, marker="o", ms=4, label=f"{name}, {stage}", **line)
            number_axis(axes, FRAMES, xlabel="frames", title=camera)
        panels[0].set_ylabel("IoU in occluded voxels")
        curves = panels[0].get_legend_handles_labels()
        figure.legend(*curves, loc="outside right center", frameon=False, fontsize=7)


def main(config: Config) -> None:
    config = config.reduced(steps=1, chairs=2, iterations=2, meshes=None, results=config.output)
    began = time.perf_counter()
    priors, training = trained(config)
    means = {camera: judged(priors, config, camera) for camera in CAMERAS}
    results = {
        "set": "procedural" if config.meshes is None else "meshes",
        "iterations": config.iterations,
        "seconds": round(time.perf_counter() - began),
        "means": means,
        "training": training,
    }
    write_json(config.results / "hidden_half.json", results)
    plot(means, config.results / "hidden_half.png")
    print(table(means))


if __name__ == "__main__":
    main(tyro.cli(Config))
