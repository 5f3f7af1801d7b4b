r"""Do the priors' predictions of hidden parts tell chairs, tables and other objects apart?

    python experiments/class_evidence.py

Objects that no network was trained on, seen in six frames along an arc of 90 to 200 degrees with a
Kinect's noise, 320 x 240 pixels; objects of neither class are boxes, plants, lamps, bins and balls.
The true front is the first of the four, so that a front is right where no quarter turn is found.

Results: experiments/results/class_evidence.json: the confusion table, and the figures of each
object; a killed run resumes.
"""

import json
from collections import Counter
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import tyro

import runs
from jaxshape.data.capture import camera_distance, capture, fused_frames, sensor_of
from jaxshape.data.families import FAMILIES, TEST_SEEDS
from jaxshape.data.virtual_cameras import VirtualCamera
from jaxshape.geometry import camera
from jaxshape.geometry.fusing import fusion_named
from jaxshape.geometry.grids import Grids
from jaxshape.mapping.scene.classes import decided, stances_of
from jaxshape.mapping.scene.evidence import predict_hidden
from jaxshape.model.shapes import ShapePrior
from jaxshape.model.weights import load_prior
from jaxshape.process import prepare_process
from jaxshape.results.journal import Journal
from things import KINDS, thing

CAMERA = VirtualCamera(320, 240, 62.7, 1.8)
FRAMES = 6


@dataclass(frozen=True)
class Config(runs.Config):
    """Settings of the experiment."""

    count: int = 40
    """Number of objects of each family; of objects of neither class there are twice as many."""
    tables: Path = runs.TABLES
    """Weights for tables."""


def main(config: Config) -> None:
    prepare_process()
    print(json.dumps(confusion(run(config.reduced(count=1)).rows), indent=1))


def run(config: Config) -> Journal:
    """Score all objects, going on from earlier results of the same settings."""
    journal = config.journal("class_evidence", count=config.count)
    priors = {"chair": load_prior("chair"), "table": load_prior(config.tables)}
    tasks = {f"{kind}-{seed}": partial(scored, priors, kind, seed)
             for kind, seed in objects(config.count)}  # fmt: skip
    runs.complete(journal, tasks, confusion, lambda one: str(one["class"]))
    return journal


def objects(count: int) -> list[tuple[str, int]]:
    """Kinds and seeds: `count` objects of each family, and twice as many of neither class."""
    n = len(KINDS)
    return [
        one
        for i in range(count)
        for one in (
            ("chair", i),
            ("table", i),
            (KINDS[i % n], i // n),
            (KINDS[(i + 2) % n], 100 + i // n),
        )
    ]


def seen(kind: str, seed: int) -> Grids:
    """F and M of an object, a batch of one."""
    mesh = FAMILIES[kind](TEST_SEEDS + 6000 + seed) if kind in FAMILIES else thing(kind, seed)
    rng = np.random.default_rng(seed)
    azimuth = rng.uniform(0, 360) + np.linspace(0, rng.uniform(90, 200), FRAMES)
    elevation = jnp.full(FRAMES, 28.0)
    T = camera.on_sphere(jnp.float32(azimuth), elevation, camera_distance(mesh, CAMERA))
    captured = capture(mesh, T, noise=True, seed=seed, camera=CAMERA)
    _, grids = fused_frames(captured, fusion_named("distance", 32), sensor_of(CAMERA))
    return Grids(grids.occupied[None], grids.occluded[None])


def scored(priors: dict[str, ShapePrior], kind: str, seed: int) -> dict[str, Any]:
    """The scores of the priors' predictions for an object, and the decision."""
    grids = seen(kind, seed)
    found = {
        name: np.asarray(predict_hidden(prior, grids, stances_of(name)))[0]
        for name, prior in priors.items()
    }
    decision = decided(found)
    return {
        "kind": kind,
        "class": decision.name,
        "quarters": decision.quarters,
        "sure": round(decision.sure, 3),
        "scores": decision.scores,
        "surface": {name: of.round(3).tolist() for name, of in found.items()},
    }


def confusion(done: dict[str, Any]) -> dict[str, Any]:
    """Number of objects of each kind by decided class, and of chairs with the right front."""
    table = {}
    for kind in ("chair", "table", *KINDS):
        those = [one for one in done.values() if one["kind"] == kind]
        counts = Counter(str(one["class"]) for one in those)
        table[kind] = {"objects": len(those), **dict(sorted(counts.items()))}
        if kind == "chair":
            right = [one for one in those if one["class"] == kind and one["quarters"] == 0]
            table[kind]["front right"] = len(right)
    return {"confusion": table}


if __name__ == "__main__":
    main(tyro.cli(Config))
