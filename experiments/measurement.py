r"""Measurements from frames, as points in voxels (paper, Eq. 6) and as fused signed distances.

    python experiments/measurement.py --meshes cad_chairs/

The 78 CAD seats, seen by a Kinect's noisy frames along an orbit. F is compared with the true
surface voxels. The oracle is F with its occluded voxels filled from the truth, which is the best
result that any prior could reach. Then the auto-encoder proposes a shape, Adam refines it in 60
steps, and the measured and the decoded shape are composed: from points by F and M, from distances
by their probabilities, and with the mirror image as further evidence.

Results: experiments/results/measurement.json; seats that are done are kept.
Time: 25 minutes on two cores.
"""

import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import runs
from filming import from_orbit
from jaxshape.data.capture import Capture, fuse_frames, measure_frames, sensor_of
from jaxshape.data.dataset import Object
from jaxshape.data.virtual_cameras import CAMERAS, CameraName
from jaxshape.geometry import evidence, fusion
from jaxshape.geometry.evidence import Evidence
from jaxshape.geometry.grids import Grids, binary
from jaxshape.geometry.overlap import iou
from jaxshape.geometry.pixels import Sensor
from jaxshape.geometry.symmetry import mirrored, symmetrised
from jaxshape.model.shapes import ShapePrior, decode, encode
from jaxshape.model.weights import fingerprint, load_prior
from jaxshape.results.journal import Journal
from jaxshape.search.composition import compose
from jaxshape.search.config import RefineConfig
from jaxshape.search.reconstruction import refiner_for, search_space
from jaxshape.search.residuals import BALANCED, SOFT, Target
from jaxshape.search.run import refine
from study import listed

SEATS_AT_A_TIME = 4


@dataclass(frozen=True)
class Config(runs.Config):
    """Settings of the experiment."""

    meshes: Path | None = None
    """Folder of the CAD seats; without it, procedural chairs kept for tests."""
    chairs: int = 78
    """Number of meshes or chairs."""
    camera: CameraName = "kinect"
    noise: bool = True
    frames: tuple[int, ...] = (1, 4, 8, 18)
    """Numbers of frames that are fused."""
    iterations: int = 60
    """Iterations of the search."""
    weights: Path = Path("chair-autoencoder")
    """Weights of the shape prior; the package's by default."""


class Seen(NamedTuple):
    """A chair after each number of frames."""

    points: tuple[np.ndarray, np.ndarray]
    """F and M."""
    evidence: Evidence
    surface: np.ndarray
    """The true voxels."""


def main(config: Config) -> None:
    journal = run(config.reduced(meshes=None, chairs=2, frames=(1, 4), iterations=2))
    for way, scores in means(journal).items():
        for score, values in scores.items():
            print(f"{way}, {score}".ljust(32) + "".join(f"{x:8.3f}" for x in values))


def run(config: Config) -> Journal:
    """Measure and rebuild every chair both ways, and write the results."""
    prior = load_prior(config.weights)
    journal = config.journal(
        "measurement",
        set="procedural" if config.meshes is None else "CAD",
        camera=config.camera,
        noise=config.noise,
        frames=config.frames,
        iterations=config.iterations,
        weights=fingerprint(prior),
    )
    chairs = listed(config.meshes, config.chairs)[: config.chairs]
    chairs = [chair for chair in chairs if chair.name not in journal.rows]
    rebuild, n = rebuilder(prior, config.iterations), len(config.frames)
    for start in range(0, len(chairs), SEATS_AT_A_TIME):
        began, some = time.perf_counter(), chairs[start : start + SEATS_AT_A_TIME]
        seen = [observe(chair, config) for chair in some]
        filled = (seen * SEATS_AT_A_TIME)[:SEATS_AT_A_TIME]  # one compiled program serves all
        scores = jax.device_get(rebuild(prior, jax.tree.map(lambda *x: np.concatenate(x), *filled)))
        rows = {
            chair.name: jax.tree.map(lambda x, i=i: rounded(x[i * n : (i + 1) * n]), scores)
            for i, chair in enumerate(some)
        }
        journal.add(rows, time.perf_counter() - began)
        print(f"{len(journal.rows)} of {config.chairs}", flush=True)
    journal.write({"means": means(journal)})
    return journal


def observe(chair: Object, config: Config) -> Seen:
    """Fuse the first k frames of an orbit, for every k, both ways."""
    device = CAMERAS[config.camera]
    _, captured = from_orbit(chair, max(config.frames), device, config.noise)
    points = jax.device_get(_points(captured, config.frames))
    found = jax.device_get(_evidence(captured, config.frames, sensor_of(device)))
    return Seen(points, found, np.stack([np.asarray(captured.surface)] * len(config.frames)))


@partial(jax.jit, static_argnames="frames")
def _points(captured: Capture, frames: tuple[int, ...]) -> tuple[jax.Array, jax.Array]:
    merged = fusion.merge_cumulative(measure_frames(captured))
    chosen = jax.tree.map(lambda x: x[np.array(frames) - 1], merged)
    return fusion.occupied(chosen), fusion.occluded(chosen)


@partial(jax.jit, static_argnames=("frames", "sensor"))
def _evidence(captured: Capture, frames: tuple[int, ...], sensor: Sensor) -> Evidence:
    fused = fuse_frames(captured, frames, sensor)
    return jax.lax.map(evidence.evidence, fused)


def rebuilder(prior: ShapePrior, iterations: int):
    """A compiled function that rebuilds a batch of cases each way, and scores them."""
    config = RefineConfig(iterations=iterations)
    refiner = refiner_for("gradient:adam", prior, config)
    assert refiner is not None

    def search(prior: ShapePrior, code: jax.Array, targets: Target) -> jax.Array:
        key, space = jax.random.key(0), search_space(prior, config)  # Adam draws no numbers
        return refine(key, prior, code, targets, refiner, iterations, space=space).logits

    @jax.jit
    def rebuild(prior: ShapePrior, seen: Seen) -> dict[str, dict[str, jax.Array]]:
        score = lambda shape: iou(shape, seen.surface)  # noqa: E731

        def judged(first, logits, composed):
            return {
                "first composed": score(composed(first)),
                "first decoded": score(first > 0),
                "refined composed": score(composed(logits)),
                "refined decoded": score(logits > 0),
            }

        def bounds(F, M):
            return {"F": score(F), "oracle": score(compose(F, M, seen.surface))}

        F, M = seen.points
        code = encode(prior, Grids(F, M))
        first = decode(prior, code)
        logits = search(prior, code, BALANCED.target(Grids(F, M), first))
        by_points = bounds(F, M) | judged(first, logits, lambda x: compose(F, M, x > 0))

        soft = evidence.as_grids(seen.evidence)
        near, hidden, _ = binary(soft)
        composed = lambda x: compose(soft.occupied, soft.occluded, jax.nn.sigmoid(x))  # noqa: E731
        code = encode(prior, soft)
        first = decode(prior, code)
        logits = search(prior, code, SOFT.target(soft, first))
        by_distances = bounds(near, hidden) | judged(first, logits, composed)
        by_distances["refined, F and M"] = score(compose(near, hidden, logits > 0))

        other = mirrored(seen.evidence)
        first, logits = (symmetrised(x, other) for x in (first, logits))
        by_mirror = judged(first, logits, composed) | {
            "agreement": other.agreement,
            "symmetric": other.symmetric.astype(jnp.float32),
        }
        return {"points": by_points, "distances": by_distances, "mirror": by_mirror}

    return rebuild


def rounded(values: np.ndarray) -> list[float]:
    return [round(float(x), 4) for x in values]


def means(journal: Journal) -> dict[str, dict[str, list[float]]]:
    """Means over chairs: `means[way][score]`, one for each number of frames."""
    rows = list(journal.rows.values())
    return {
        way: {
            score: rounded(np.mean([row[way][score] for row in rows], axis=0)) for score in scores
        }
        for way, scores in rows[0].items()
    }


if __name__ == "__main__":
    main(tyro.cli(Config))
