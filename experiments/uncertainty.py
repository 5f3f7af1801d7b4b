r"""Are probabilities reliable? Calibration in occluded voxels, and the gain from samples.

    python experiments/uncertainty.py --seats cad_chairs --tables cad_tables

Shapes are completed from 1, 4 and 8 noisy frames of a Kinect along an orbit. Every way to estimate
the probability of a voxel has its own calibration, fitted to procedural objects of the network's
class that are neither in the training nor in the test:

- decoder: the logits of the shape, with slope and offset (Platt scaling);
- conditional prior: the slope falls with the spread of 16 shapes whose codes are drawn from the
  conditional network's prior (the package's way);
- auto-encoder, decoder: like the first way, for the paper's network after 60 steps of Adam;
- auto-encoder, curvature: samples by Laplace's approximation from the Gauss-Newton matrix;
- auto-encoder, CMA-ES: samples from the covariance matrix C of CMA-ES after 60 generations, scaled
  by the factor among three that makes the calibration chairs most probable.

The auto-encoder's rows use 4 frames and fewer objects, because each object takes a search.

Results: experiments/results/uncertainty.json, .png and uncertainty_hypotheses.png.
Time: about half an hour on two cores.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import runs
from figures import drawn
from jaxshape.data.families import FamilyName, procedural_objects
from jaxshape.files import write_json
from jaxshape.geometry.grids import Grids
from jaxshape.model.calibration import Calibration
from jaxshape.model.shapes import ShapePrior, decode, encode
from jaxshape.model.weights import load_prior
from jaxshape.report.figures import tidy
from jaxshape.report.panels import grid_panel
from jaxshape.results.evaluation import Case, EvaluateConfig, case_keys
from jaxshape.results.metrics import reliability
from jaxshape.search.calibrating import fit
from jaxshape.search.composition import complete
from jaxshape.search.config import RefineConfig
from jaxshape.search.posterior import hypotheses
from jaxshape.search.reconstruction import reconstruct, refiner_for, residual_for
from jaxshape.search.run import refine
from jaxshape.search.space import whitened
from study import Subject, listed, observed

FRAMES = (1, 4, 8)
SEEN = EvaluateConfig(frames=FRAMES, camera="kinect", noise=True)
SAMPLES, STEPS = 16, 60
FIRST_SEED = 500_000
"""Seed of the first chair that calibrations are fitted to: between the training and test seeds."""
SCALES = (0.1, 0.3, 1.0)
"""Factors of CMA-ES's covariance matrix, which has shrunk by the end of a search."""
AT_A_TIME = 6


@dataclass(frozen=True)
class Config(runs.Config):
    """Settings of the experiment."""

    seats: Path = Path("cad_chairs")
    """Folder of the CAD seats."""
    tables: Path | None = None
    """Folder of the CAD tables; without it they are left out."""
    chairs: int = 96
    """Procedural chairs kept for tests."""
    calibration: int = 48
    """Procedural objects that calibrations are fitted to."""
    searched: int = 12
    """Number of calibration chairs and of CAD seats in the auto-encoder's rows."""
    weights: Path | None = None
    """Weights of the conditional network for chairs; the package's weights by default."""
    table_weights: Path = runs.TABLES
    """Weights of the conditional network for tables."""


class Voxels(NamedTuple):
    """Occluded voxels of some objects after some number of frames, one after the other."""

    logits: np.ndarray
    spread: np.ndarray
    occupied: np.ndarray


Predictor = Callable[[ShapePrior, Any, Grids], tuple[jax.Array, jax.Array]]
Seen = list[tuple[Subject, Case]]

# ------------------------------------------------------------------ ways to say how sure


def samples(method: str, prior: ShapePrior, keys, grids: Grids) -> tuple[jax.Array, jax.Array]:
    """A method's shape, and the spread of samples about it.

    They are drawn from the conditional prior (`encoder`, the first code's shape) or, for the
    auto-encoder, by Laplace's approximation.
    """
    config = RefineConfig(samples=SAMPLES, iterations=STEPS)
    refiner = refiner_for(method, prior, config)
    found = reconstruct(keys, prior, grids.occupied, grids.occluded, refiner, config)
    assert found.samples is not None
    return found.fill_logits, jnp.std(found.samples, axis=1)


def covariance(scale: float, prior: ShapePrior, keys, grids: Grids):
    """The shape of CMA-ES's mean, and the spread of samples from its covariance matrix."""
    config, space = RefineConfig(iterations=STEPS), whitened(prior)
    residual, first = residual_for(grids, config), encode(prior, grids)
    target = jax.vmap(residual.target)(grids, decode(prior, first, grids))
    search = refiner_for("cma", prior, config)
    assert search is not None
    found = refine(keys, prior, first, target, search, STEPS, residual=residual, space=space)
    mean, C = found.state.mean, found.state.covariance
    size = jnp.trace(C, axis1=1, axis2=2)[:, None, None] / C.shape[-1]
    root = scale * jnp.linalg.cholesky(C / size)
    noise = jax.random.normal(keys[0], (len(mean), SAMPLES, C.shape[-1]))
    points = mean[:, None] + jnp.einsum("oij,osj->osi", root, noise)
    logits = decode(prior, jax.vmap(jax.vmap(space.to_code))(points))
    fill = partial(complete, symmetry=True)
    each = Grids(*(jnp.broadcast_to(x[:, None], logits.shape) for x in grids[:2]))
    here = fill(grids, decode(prior, jax.vmap(space.to_code)(mean))).logits
    return here, jnp.std(fill(each, logits).logits, axis=1)


# ------------------------------------------------------------------ voxels and figures


def cases_of(objects: Sequence[Any]) -> Seen:
    return list(observed([Subject(one.name, "", one) for one in objects], SEEN))


def voxels(predictor: Predictor, prior: ShapePrior, cases: Seen, frame: int) -> Voxels:
    """The occluded voxels of all cases after the frame-th number of frames."""
    run, parts = jax.jit(predictor), []
    for first in range(0, len(cases), AT_A_TIME):
        some = cases[first : first + AT_A_TIME]
        rows = [some[i % len(some)] for i in range(AT_A_TIME)]
        grids = Grids(*(jnp.stack([jnp.float32(case.grids[i][frame]) for _, case in rows])
                        for i in (0, 1)))  # fmt: skip
        keys = jnp.concatenate([case_keys(one.name, FRAMES[frame : frame + 1]) for one, _ in rows])
        logits, spread = jax.device_get(run(prior, keys, grids))
        for i, (_, case) in enumerate(some):
            hidden = np.asarray(case.grids.occluded[frame]) > 0.5
            truth = np.asarray(case.surface[frame])[hidden]
            parts.append(Voxels(logits[i][hidden], spread[i][hidden], truth))
    return pooled(parts)


def nats(found: Voxels, calibration: Calibration) -> float:
    """Mean negative log-likelihood of a voxel."""
    p = np.clip(probability(found, calibration), 1e-7, 1 - 1e-7)
    return float(-np.log(np.where(found.occupied, p, 1 - p)).mean())


def probability(found: Voxels, calibration: Calibration) -> np.ndarray:
    return np.asarray(calibration.probability(jnp.asarray(found.logits), jnp.asarray(found.spread)))


def figures_of(found: Voxels, calibration: Calibration) -> dict[str, Any]:
    seen = reliability(probability(found, calibration), found.occupied)
    return {
        "ece": round(seen.error, 4),
        "nats": round(nats(found, calibration), 4),
        "curve": {name: np.round(x, 4).tolist() for name, x in seen._asdict().items()},
    }


def without_spread(found: Voxels) -> Voxels:
    return found._replace(spread=np.zeros_like(found.spread))


def pooled(parts: Sequence[Voxels]) -> Voxels:
    return Voxels(*map(np.concatenate, zip(*parts, strict=True)))


# ------------------------------------------------------------------ the comparison


def compared(weights: Path | None, sets: dict[str, Seen], fitted: Seen) -> dict[str, Any]:
    """Figures of a conditional network, by set, number of frames and way."""
    look = partial(voxels, partial(samples, "encoder"), load_prior(weights))
    calibrating = pooled([look(fitted, i) for i in range(len(FRAMES))])
    ways = {
        "decoder as it is": (without_spread, Calibration()),
        "decoder": (without_spread, fit(*without_spread(calibrating))),
        "conditional prior": (lambda x: x, fit(*calibrating)),
    }

    def of(cases: Seen, frame: int) -> dict[str, Any]:
        found = look(cases, frame)
        return {way: figures_of(view(found), c) for way, (view, c) in ways.items()}

    return {
        "figures": {
            name: {str(k): of(cases, i) for i, k in enumerate(FRAMES)}
            for name, cases in sets.items()
        },
        "calibrations": {way: list(c) for way, (_, c) in ways.items()},
    }


def searched(seats: Seen, chairs: Seen) -> dict[str, Any]:
    """Figures of the auto-encoder's ways after 4 frames."""
    prior, frame = load_prior("chair-autoencoder"), FRAMES.index(4)
    adam = partial(samples, "gradient:adam")
    found = {"curvature": [voxels(adam, prior, x, frame) for x in (chairs, seats)]}
    found["decoder"] = [without_spread(x) for x in found["curvature"]]
    tried = {s: voxels(partial(covariance, s), prior, chairs, frame) for s in SCALES}
    best = min(SCALES, key=lambda s: nats(tried[s], fit(*tried[s])))
    found["CMA-ES"] = [tried[best], voxels(partial(covariance, best), prior, seats, frame)]
    figures = {
        f"auto-encoder, {way}": figures_of(tested, fit(*fitted))
        for way, (fitted, tested) in found.items()
    }
    return {"frames": 4, "seats": len(seats), "scale": best, "figures": figures}


def two_kinds(config: Config, cases: Seen, path: Path) -> str:
    """Draw the object whose hypotheses differ most after one frame, with their blurred mean."""
    prior, search = load_prior(config.weights), RefineConfig(samples=SAMPLES)

    @jax.jit
    def look(keys, grids):
        found = reconstruct(keys, prior, grids.occupied, grids.occluded, None, search)
        assert found.samples is not None
        unknown = grids.occluded[0] > 0.5
        chosen, share = hypotheses(found.samples[0], unknown, 2)
        a, b = ((found.samples[0, i] > 0) & unknown for i in chosen)
        apart = 1 - jnp.sum(a & b) / jnp.maximum(jnp.sum(a | b), 1)
        return found, chosen, share, apart * 2 * jnp.min(share)

    def looked(one: tuple[Subject, Case]) -> Any:
        grids = Grids(*(jnp.float32(x[:1]) for x in one[1].grids[:2]))
        return one, jax.device_get(look(case_keys(one[0].name, FRAMES[:1]), grids))

    best = max(map(looked, cases), key=lambda one: one[1][3])
    (chair, case), (found, chosen, share, _) = best
    F = np.asarray(case.grids.occupied[0]) * (1 - np.asarray(case.grids.occluded[0])) > 0.5
    shown = {f"hypothesis {i + 1}: {s:.0%}": found.samples[0, c] > 0
             for i, (c, s) in enumerate(zip(chosen, share, strict=True))}  # fmt: skip
    shown["probability above 1/2"] = found.probability[0] > 0.5
    shown["truth"] = np.asarray(case.surface[0])
    with drawn(path, 12, 3.4, dpi=130) as figure:
        for axes, (title, grid) in zip(figure.subplots(1, 4), shown.items(), strict=True):
            labels = np.where(F, 1, np.where(grid, 2, 0))
            axes.imshow(grid_panel("", labels, "measured", "predicted").image)
            axes.set_title(title, fontsize=9)
            axes.set_axis_off()
    return chair.name


def plot(figures: dict[str, Any], path: Path) -> None:
    """Reliability curves: observed frequency against predicted probability."""
    with drawn(path, 3.4 * len(FRAMES), 3.2 * len(figures), dpi=130) as figure:
        shape = len(figures), len(FRAMES)
        panels = figure.subplots(*shape, squeeze=False, sharex=True, sharey=True)
        for row, (name, by_frames) in zip(panels, figures.items(), strict=True):
            for axes, (k, ways) in zip(row, by_frames.items(), strict=True):
                axes.plot([0, 1], [0, 1], color="0.8", lw=1)
                for i, (way, one) in enumerate(ways.items()):
                    curve = {c: np.array(values) for c, values in one["curve"].items()}
                    some = curve["share"] > 1e-3
                    style = {"marker": "o", "ms": 3, "color": f"C{i}"}
                    label = f"{way}: ECE {one['ece']:.3f}"
                    x, y = curve["predicted"][some], curve["occurred"][some]
                    axes.plot(x, y, label=label, **style)
                axes.set_title(f"{name}, {k} frame{'s' * (k != '1')}", fontsize=9)
                axes.legend(frameon=False, fontsize=6.5, loc="upper left")
                tidy(axes)
        for axes in panels[-1]:
            axes.set_xlabel("probability that was given")
        for row in panels:
            row[0].set_ylabel("share that is occupied")


def kept(family: FamilyName, config: Config) -> Seen:
    """Procedural objects to fit calibrations to."""
    return cases_of(procedural_objects(family, config.calibration, FIRST_SEED))


def main(config: Config) -> None:
    config = config.reduced(chairs=0, calibration=6, searched=2)
    chairs, few = kept("chair", config), config.searched
    sets = {"CAD seats": cases_of(listed(config.seats, 0))}
    if config.chairs:
        sets["procedural chairs"] = cases_of(listed(None, config.chairs))
    tables = {} if config.tables is None else {"CAD tables": cases_of(listed(config.tables, 0))}
    others = {f"{name}, network for chairs": cases for name, cases in tables.items()}
    found = compared(config.weights, sets | others, chairs)
    if tables:
        own = compared(config.table_weights, tables, kept("table", config))
        found["figures"] |= own["figures"]
        found["calibrations of tables"] = own["calibrations"]
    found["auto-encoder"] = searched(sets["CAD seats"][:few], chairs[:few])
    name = two_kinds(config, sets["CAD seats"], config.results / "uncertainty_hypotheses.png")
    write_json(config.results / "uncertainty.json", found | {"two kinds": name})
    plot(found["figures"], config.results / "uncertainty.png")
    for name, by_frames in found["figures"].items():
        for k, ways in by_frames.items():
            for way, one in ways.items():
                print(f"{name}, {k} frames, {way}: ECE {one['ece']:.3f}, {one['nats']:.4f} nats")


if __name__ == "__main__":
    main(tyro.cli(Config))
