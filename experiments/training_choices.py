r"""The value of each choice in training: small networks at equal budget, judged by their shapes.

    jaxshape dataset --output data/chairs --count 16000
    python experiments/training_choices.py --dataset data/chairs --meshes cad_chairs/

and, for the variant that learns from real chairs made of boxes (research data),

    python experiments/procedural_vs_real.py --cad cad_chairs/ --boxes box_chairs.npz \
        --chairs 3858 --write-boxes boxes/
    jaxshape dataset --output data/boxes --meshes boxes/
    python experiments/training_choices.py --dataset data/chairs --meshes cad_chairs/ \
        --boxes data/boxes

For every variant of `VARIANTS` one network is trained from scratch on the same number of pairs. It
is then judged on chairs that no network was trained on, procedural ones and, if given, meshes. The
figures are the IoU of the shapes of the first code, CMA-ES and Adam from 1, 4 and 8 frames of an
orbit, the ceiling of its code space (codes fitted to the full truth), and the first code's IoU from
inputs with all faults at once. Training losses are not compared, because the variants have
different losses.

A finished variant is not run again; a killed one resumes from its checkpoint.
Results: experiments/results/training_choices.json and .png. Time: about 2 minutes a variant on two
quiet cores.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro

import runs
from figures import drawn
from jaxshape.data.archives import list_meshes
from jaxshape.data.config import DatasetConfig, FaultConfig, InputConfig
from jaxshape.data.dataset import Dataset, Object, hash_seed, load_object, open_dataset
from jaxshape.data.families import TEST_SEEDS, procedural_objects
from jaxshape.data.meshes import Model, Skipped
from jaxshape.data.paths import draw_path
from jaxshape.files import write_json
from jaxshape.geometry.grids import Grids
from jaxshape.geometry.overlap import iou
from jaxshape.model.config import PRESETS, Architecture, TrainConfig
from jaxshape.model.shapes import ShapePrior, decode, encode
from jaxshape.report.palette import COLORS
from jaxshape.results.evaluation import evaluate, summarize
from study import SEARCH, SEEN, tiny, train_reporting

SMALL = Architecture(encoder=(8, 16, 32, 64), decoder=(32, 16, 8))
UNCHANGED = InputConfig(complete=0.0, mirror=False, warp=0.0)
FAULTY = DatasetConfig(
    frames=(1, 4, 8),
    noisy=1.0,
    faults=FaultConfig(pose_error=0.3, missing=0.3, segmentation=0.1, hidden=0.3, loose=1.0),
)
"""Inputs of the test of robustness: they have every fault, and more of each than in training."""

# Each group changes one thing. The others of a group are compared with its first.
PLAIN = replace(PRESETS["autoencoder"], architecture=SMALL, inputs=UNCHANGED, occupied_weight=1.0)


def _inputs(**changes: Any) -> TrainConfig:
    return replace(PLAIN, inputs=replace(UNCHANGED, **changes))


def _space(**changes: Any) -> TrainConfig:
    return replace(PLAIN, architecture=replace(SMALL, **changes))


VARIANTS: dict[str, TrainConfig] = {
    "plain": PLAIN,
    "complete surfaces": _inputs(complete=0.1),
    "mirror": _inputs(mirror=True),
    "warp": _inputs(warp=0.3),
    "box chairs": PLAIN,
    "trained by Adam": replace(PLAIN, optimizer="adam", learning_rate=1e-3),
    "occupied x 1.5": replace(PLAIN, occupied_weight=1.5),
    "occupied x 2": replace(PLAIN, occupied_weight=2.0),
    "occluded x 2": replace(PLAIN, occluded_weight=2.0),
    "code 32": _space(code=32),
    "code 64": _space(code=64),
    "code 200": _space(code=200),
    "decoder half": _space(decoder=(16, 8, 4)),
    "decoder double": _space(decoder=(64, 32, 16)),
    "code noise 0.1": replace(PLAIN, code_noise=0.1),
    "code noise 0.3": replace(PLAIN, code_noise=0.3),
    "KL 1": replace(PLAIN, code_noise=1.0, code_weight=1.0),
}
GROUPS = {
    "inputs": ["plain", "complete surfaces", "mirror", "warp"],
    "shapes": ["plain", "box chairs"],
    "loss": ["plain", "occupied x 1.5", "occupied x 2", "occluded x 2", "trained by Adam"],
    "space": ["plain", "code 32", "code 64", "code 200", "decoder half", "decoder double",
              "code noise 0.1", "code noise 0.3", "KL 1"],
}  # fmt: skip


@dataclass(frozen=True)
class Config(runs.Config):
    """Settings of the experiment."""

    dataset: Path = Path("data/chairs")
    """Folder made by `jaxshape dataset`; half of its objects are used."""
    output: Path = Path("out/training_choices")
    """Folder for the runs."""
    variants: tuple[str, ...] = tuple(VARIANTS)
    """Variants to train; the figures of the others are kept."""
    steps: int = 200
    """Number of batches of 32 pairs for each variant."""
    chairs: int = 12
    """Procedural test chairs."""
    meshes: Path | None = None
    """Folder of meshes that variants are also judged on."""
    every: int = 3
    """Use every n-th of these meshes."""
    iterations: int = 40
    """Iterations of the searches."""
    boxes: Path | None = None
    """Folder of a dataset of box chairs; without it that variant is left out."""


# ------------------------------------------------------------------ one variant

Faulty = tuple[Grids, np.ndarray]
"""Measurements and the true surfaces `[input x y z]`."""


def examples(name: str, config: Config) -> Dataset:
    """Half of the objects, the same for all variants except the variant of box chairs."""
    if name == "box chairs":
        assert config.boxes is not None
        return open_dataset(config.boxes)
    dataset = open_dataset(config.dataset)
    half = slice(len(dataset.names) // 2)
    return dataset._replace(names=dataset.names[half], row=dataset.row[half])


def judge(
    prior: ShapePrior, tests: dict[str, Sequence[Model]], faulty: Faulty, config: Config
) -> dict[str, Any]:
    """IoU by frames and method, and ceiling, on each test set; and the encoder's with faults."""
    search = replace(SEARCH, iterations=config.iterations)
    methods = ("encoder", "cma", "gradient:adam")
    scoring = replace(SEEN, frames=(1, 4, 8), methods=methods, ceiling=True, refine=search)
    found: dict[str, Any] = {}
    for name, models in tests.items():
        scores = [s for s in evaluate(prior, models, scoring) if not isinstance(s, Skipped)]
        found[name] = summarize(scores, scoring)
    grids, surface = faulty
    first = jax.jit(lambda prior, grids: decode(prior, encode(prior, grids), grids) > 0)
    found["faulty inputs"] = float(np.mean(iou(first(prior, grids), surface)))
    return found


def loaded(objects: Sequence[Object]) -> list[Model]:
    """The objects that can be used."""
    return [one for one in map(load_object, objects) if isinstance(one, Model)]


def faulty_pairs(models: Sequence[Model]) -> Faulty:
    """Three inputs of each model with every fault at once, sensor noise included, and the truth."""
    paths = [draw_path(m.mesh, FAULTY, hash_seed(7, i)) for i, m in enumerate(models)]
    grids = jax.tree.map(lambda *x: np.concatenate(x), *[path.measured for path in paths])
    surfaces = [np.repeat(np.asarray(p.surface)[None], len(FAULTY.frames), 0) for p in paths]
    return grids, np.concatenate(surfaces)


def run(config: Config) -> dict[str, Any]:
    """Train and judge every variant that is not finished yet."""
    path = config.results / "training_choices.json"
    found = json.loads(path.read_text()) if path.exists() and not config.smoke else {}
    chairs = loaded(procedural_objects("chair", config.chairs, TEST_SEEDS))
    tests: dict[str, Any] = {"procedural": chairs}
    if config.meshes:
        tests["meshes"] = loaded(list_meshes(config.meshes)[:: config.every])
    faulty = faulty_pairs(chairs)
    for name in config.variants:
        if name == "box chairs" and not config.boxes:
            continue
        settings = replace(VARIANTS[name], steps=config.steps)
        if config.smoke:
            settings = tiny(settings, batch=4)
        if found.get(name, {}).get("settings") == json.loads(json.dumps(asdict(settings))):
            continue
        folder, data = config.output / name.replace(" ", "-"), examples(name, config)
        prior = train_reporting(name, folder, data, settings)
        found[name] = judge(prior, tests, faulty, config) | {
            "settings": asdict(settings), "samples": settings.steps * settings.batch
        }  # fmt: skip
        write_json(path, found)
        print(line(name, found[name]), flush=True)
    return found


def line(name: str, scores: dict[str, Any]) -> str:
    """The figures of a variant in a line, on the hardest test set."""
    test = scores.get("meshes", scores["procedural"])
    by_frames = [
        f"{k}: " + "/".join(f"{test[k][m]['iou']:.3f}" for m in ("encoder", "cma", "gradient:adam"))
        for k in ("1", "4", "8")
    ]
    return (
        f"{name:18} first code/CMA-ES/Adam from {', '.join(by_frames)} frames; "
        f"ceiling {test['8']['bounds']['ceiling']:.3f}; faulty inputs {scores['faulty inputs']:.3f}"
    )


# ------------------------------------------------------------------ figure


def plot(found: dict[str, Any], path: Path) -> None:
    """A row of dots for each variant: each figure's difference from the plain variant."""
    test = "meshes" if "meshes" in found["plain"] else "procedural"
    figures = {
        "first code, 4 frames": lambda s: s[test]["4"]["encoder"]["iou"],
        "CMA-ES, 4 frames": lambda s: s[test]["4"]["cma"]["iou"],
        "Adam, 4 frames": lambda s: s[test]["4"]["gradient:adam"]["iou"],
        "ceiling": lambda s: s[test]["8"]["bounds"]["ceiling"],
        "first code, faulty inputs": lambda s: s["faulty inputs"],
    }
    names = [n for group in GROUPS.values() for n in group[1:] if n in found]
    rows = np.arange(len(names))[::-1]
    with drawn(path, 11, 0.3 * len(names) + 1.2) as fig:
        fig.set_layout_engine("none")
        axes = fig.subplots(1, len(figures), sharey=True)
        for ax, (title, figure) in zip(axes, figures.items(), strict=True):
            base = figure(found["plain"])
            gains = np.array([figure(found[name]) - base for name in names])
            ax.axvline(0, color="0.6", lw=0.8)
            ax.hlines(rows, 0, gains, color=COLORS["measured"], lw=2)
            ax.plot(gains, rows, "o", color=COLORS["measured"], ms=5)
            ax.set_title(f"{title}\nplain: {base:.3f}", fontsize=9)
            ax.set_yticks(rows, names, fontsize=9)
            ax.tick_params(axis="x", labelsize=8)
            ax.spines[["top", "right", "left"]].set_visible(False)
            ax.grid(axis="x", color="0.92")
            ax.set_axisbelow(True)
        axes[len(axes) // 2].set_xlabel("IoU gained over the plain variant", fontsize=9)
        fig.tight_layout()


def main(config: Config) -> None:
    few = ("plain", "code 32")
    config = config.reduced(
        steps=1, chairs=2, iterations=2, meshes=None, variants=few, results=config.output
    )
    found = run(config)
    for name, scores in found.items():
        print(line(name, scores))
    plot(found, config.results / "training_choices.png")


if __name__ == "__main__":
    main(tyro.cli(Config))
