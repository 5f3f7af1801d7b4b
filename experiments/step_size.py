r"""Steps of gradient descent and of Adam, and sigma0 of CMA-ES (paper, Fig. gm right).

    python experiments/step_size.py --test.meshes cad_chairs/

8 procedural chairs and 4 CAD seats, each seen in 1, 4 and 8 frames. Every search starts from the
encoder's code and has 60 iterations, in the codes themselves as in the paper (where 0.14 is its
step and 2 its sigma0) or in whitened codes. The paper does not say what it averages. Here a value
is rated by the decrease of the objective, as a share of the decrease with the best value of its
method, and the default of each method is compared with the best.

Results: experiments/results/step_size.json, .png and .svg, and the searches along their way in
step_size_curves.png and .svg; finished chairs are kept. Time: 10 minutes on two cores.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Array

import study
from figures import PAGE, draw_mean, save_column
from jaxshape.geometry.overlap import iou
from jaxshape.model.shapes import ShapePrior
from jaxshape.model.weights import load_prior
from jaxshape.report.figures import tidy
from jaxshape.report.palette import BLUE, GREEN, GREY, INK, ORANGE
from jaxshape.results.evaluation import Case
from jaxshape.results.journal import Journal
from jaxshape.search.config import RefineConfig
from jaxshape.search.methods.gradient import LEARNING_RATE, STEP_SIZES
from jaxshape.search.reconstruction import reconstruct, refiner_for
from study import (
    Contestant,
    Scores,
    TestSet,
    compare,
    mean_low_high,
)

CASES_AT_A_TIME = 15
WORST = 99.0
"""Value in place of a loss that is not finite, which JSON cannot hold."""


class Trial(NamedTuple):
    """A step, or the sigma0 of CMA-ES, in the coordinates of a space."""

    space: str
    step: float


def grid(raw: set[float], whitened: set[float]) -> list[Trial]:
    steps = {"raw": raw, "whitened": whitened}
    return [Trial(space, step) for space in steps for step in sorted(steps[space])]


DESCENT = "gradient descent"
SETTINGS = {
    DESCENT: ("gradient", "step_size"),
    "Adam": ("gradient:adam", "step_size"),
    "CMA-ES": ("cma", "sigma0"),
}
"""The name of each method, and the setting that is tried."""
DEFAULTS = {
    DESCENT: Trial("whitened", STEP_SIZES["whitened"]),
    "Adam": Trial("whitened", LEARNING_RATE),
    "CMA-ES": Trial("whitened", float(RefineConfig().sigma0)),
}
PAPERS = {DESCENT: Trial("raw", 0.14), "CMA-ES": Trial("raw", 2.0)}
TRIALS = {
    DESCENT: grid({0.02, 0.14, 1.4, 5.0, 14.0, 40.0}, {2.0, 7.0, DEFAULTS[DESCENT].step, 40.0}),
    "Adam": grid(set(), {0.01, 0.03, DEFAULTS["Adam"].step, 0.3}),
    "CMA-ES": grid({0.04, 0.14, 2.0}, {0.03, DEFAULTS["CMA-ES"].step, 0.3, 1.0}),
}


@dataclass(frozen=True)
class Config(study.Config):
    """Settings of the experiment."""

    test: TestSet = TestSet(chairs=8, seats=4)
    frames: tuple[int, ...] = (1, 4, 8)
    """Numbers of frames that are fused."""
    iterations: int = 60
    """Iterations of every search."""


def main(config: Config) -> None:
    config = config.reduced(frames=(1, 4), iterations=2)
    journal = run(config)
    plot(journal, config)
    plot_curves(journal, config)


def run(config: Config) -> Journal:
    """Try every value on every chair, and write the results."""
    codes = load_prior(config.weights).code_covariance
    prior, journal = config.begin(
        "step_size",
        frames=config.frames,
        iterations=config.iterations,
        trials=TRIALS,
        # Root mean square over the coordinates of the codes' standard deviations.
        deviation_of_codes=round(float(jnp.sqrt(jnp.diag(codes).mean())), 4),
    )
    search = RefineConfig(iterations=config.iterations, tolerance=0.0)
    contestants = {method: trying(method, search) for method in TRIALS}
    compare(contestants, prior, config.test, config.frames, journal, at_a_time=CASES_AT_A_TIME)
    journal.write({"summary": summary(journal, config)})
    return journal


def trying(method: str, config: RefineConfig) -> Contestant:
    """The contestant that searches with every value of a method, all values in one program."""
    name, setting = SETTINGS[method]
    often = jnp.array(sampled(config.iterations)) - 1

    def contest(keys: Array, prior: ShapePrior, case: Case) -> Scores:
        F, M = case.grids.occupied, case.grids.occluded

        def attempt(space: str, step: Array) -> dict[str, Array]:
            settings: dict[str, Any] = {"space": space, setting: step}
            search = replace(config, **settings)
            found = reconstruct(keys, prior, F, M, refiner_for(name, prior, search), search)
            assert found.trace is not None
            drawn = jnp.nan_to_num(found.trace.loss, posinf=WORST)
            return {
                "start": found.first_objective,
                "start_iou": iou(found.completed_first, case.surface),
                "objective": found.objective,
                "iou": iou(found.completed, case.surface),
                "rises": jnp.mean(jnp.diff(drawn) > 0, axis=1),
                "last": drawn[:, -1],
                "moved": jnp.sqrt(jnp.mean((found.code - found.first_code) ** 2, axis=1)),
                "drawn": drawn[:, often],
            }

        scores = [
            jax.vmap(partial(attempt, space), out_axes=1)(jnp.array(steps))
            for space, steps in by_space(TRIALS[method]).items()
        ]
        return jax.tree.map(lambda *x: jnp.concatenate(x, axis=1), *scores)

    return contest


def by_space(trials: Sequence[Trial]) -> dict[str, list[float]]:
    """The values of a method in each space, in the order of the trials."""
    groups = itertools.groupby(trials, key=lambda trial: trial.space)
    return {space: [trial.step for trial in group] for space, group in groups}


def sampled(iterations: int) -> list[int]:
    """About ten iterations, evenly spaced in their logarithm, counted from 1."""
    return sorted(set(np.geomspace(1, iterations, 12).round().astype(int).tolist()))


def scores(journal: Journal, frames: int, method: str, score: str) -> np.ndarray:
    """A score of all values of a method on all chairs: [chair trial ...]."""
    rows = journal.rows.values()
    return np.array([row[str(frames)][method][score] for row in rows])


def fall(journal: Journal, frames: int, method: str) -> np.ndarray:
    """Mean decrease of the objective with each value, as a share of the largest."""
    fallen = (
        scores(journal, frames, method, "start") - scores(journal, frames, method, "objective")
    ).mean(axis=0)
    return fallen / max(fallen.max(), 1e-12)


def gain(journal: Journal, frames: int, method: str) -> np.ndarray:
    """Gain in IoU over the encoder with each value: [chair trial]."""
    return scores(journal, frames, method, "iou") - scores(journal, frames, method, "start_iou")


def summary(journal: Journal, config: Config) -> dict[str, Any]:
    """The figures of each value and number of frames, the best values, and the default's loss.

    The best value has the largest share of the best falls, over all numbers of frames or for each,
    in both spaces or in one. `default less best` is the IoU of the default minus that of the value
    which is best for each number of frames, over all chairs and numbers of frames.
    """

    def of(method: str, k: int) -> dict[str, Any]:
        start, last = (scores(journal, k, method, score) for score in ("start", "last"))
        means = {
            "objective": scores(journal, k, method, "objective").mean(axis=0),
            "part_of_best_fall": fall(journal, k, method),
            "iou_gained": gain(journal, k, method).mean(axis=0),
            "overshoots": (last > start).mean(axis=0),
            "rises": scores(journal, k, method, "rises").mean(axis=0),
            "moved": scores(journal, k, method, "moved").mean(axis=0),
        }
        return {
            text(trial): {name: float(f"{values[i]:.4g}") for name, values in means.items()}
            for i, trial in enumerate(TRIALS[method])
        }

    def best(method: str) -> dict[str, Any]:
        trials = TRIALS[method]
        falls = {str(k): fall(journal, k, method) for k in config.frames}
        falls["all"] = np.mean([*falls.values()], axis=0)
        default, differences = trials.index(DEFAULTS[method]), []
        for k in config.frames:
            gained = gain(journal, k, method)
            differences.append(gained[:, default] - gained[:, np.argmax(falls[str(k)])])
        inside = {
            space: [
                falls["all"][i] if trial.space == space else -1 for i, trial in enumerate(trials)
            ]
            for space in dict.fromkeys(trial.space for trial in trials)
        }
        return {
            "best": {k: text(trials[int(np.argmax(x))]) for k, x in (falls | inside).items()},
            "default less best": mean_low_high(np.concatenate(differences)),
        }

    return {
        method: best(method) | {str(k): of(method, k) for k in config.frames} for method in TRIALS
    }


def text(trial: Trial) -> str:
    return f"{trial.step:g} {'in codes' if trial.space == 'raw' else 'whitened'}"


def places(method: str, space: str) -> list[int]:
    """Places of the values of a method in one of the spaces."""
    return [i for i, trial in enumerate(TRIALS[method]) if trial.space == space]


def plot(journal: Journal, config: Config) -> None:
    """A column of panels for each method: fall of the objective above, gain in IoU below."""
    markers = dict(zip(config.frames, ("o", "s", "^"), strict=False))
    colors = dict(zip(config.frames, (ORANGE, GREEN, BLUE), strict=False))
    dashes = {"raw": (3, 1.5), "whitened": ()}

    def draw(figure: Any) -> None:
        upper, lower = figure.subplots(2, len(TRIALS), sharex="col", sharey="row")
        for method, above, below in zip(TRIALS, upper, lower, strict=True):
            for k in config.frames:
                for space, dash in dashes.items():
                    if not (chosen := places(method, space)):
                        continue
                    steps = [TRIALS[method][i].step for i in chosen]
                    start = scores(journal, k, method, "start")[:, chosen]
                    left = scores(journal, k, method, "objective")[:, chosen] / start
                    style = {"color": colors[k], "dashes": dash, "marker": markers[k], "ms": 3}
                    draw_mean(above, steps, left, **style)
                    draw_mean(below, steps, gain(journal, k, method)[:, chosen], **style)
            below.set(xscale="log", xlabel="sigma0" if method == "CMA-ES" else "step")
            above.set_title(method)
            for axes in (above, below):
                axes.axvline(DEFAULTS[method].step, color=GREY, lw=0.8, zorder=0)
                if method in PAPERS:
                    axes.axvline(PAPERS[method].step, color=GREY, lw=0.8, ls=":", zorder=0)
                tidy(axes)
            below.xaxis.set_major_formatter("{x:g}")
        upper[0].set_ylabel("objective / start")
        lower[0].set_ylabel("IoU over encoder")
        for k in config.frames:
            lower[0].plot([], [], color=colors[k], marker=markers[k], ms=3, label=f"{k} frames")
        for space, dash in dashes.items():
            name = "codes" if space == "raw" else "whitened"
            lower[0].plot([], [], color=INK, dashes=dash, label=name)
        lower[1].plot([], [], color=GREY, lw=0.8, label="default")
        lower[1].plot([], [], color=GREY, lw=0.8, ls=":", label="paper")
        figure.legend(frameon=False, loc="outside lower center", ncols=7)

    save_column(config.results / "step_size", draw, height=4.2, width=PAGE)


def plot_curves(journal: Journal, config: Config) -> None:
    """The loss along the way of gradient descent, a line for each step (paper, Fig. gm right)."""
    method, k = DESCENT, config.frames[len(config.frames) // 2]

    def draw(figure: Any) -> None:
        from matplotlib import colormaps

        relative = (
            scores(journal, k, method, "drawn") / scores(journal, k, method, "start")[..., None]
        )
        panels = figure.subplots(1, 2, sharey=True)
        for space, axes in zip(("raw", "whitened"), panels, strict=True):
            chosen = places(method, space)
            for number, i in enumerate(chosen):
                axes.plot(
                    sampled(config.iterations),
                    relative[:, i].mean(axis=0),
                    color=colormaps["viridis"](0.9 * number / (len(chosen) - 1)),
                    dashes=[(), (4, 1.5), (1, 1.2)][number % 3],
                    label=f"{TRIALS[method][i].step:g}",
                )
            axes.set(xscale="log", xlabel="iteration")
            axes.set_title("steps in codes" if space == "raw" else "steps in whitened codes")
            axes.xaxis.set_major_formatter("{x:g}")
            axes.set_ylim(0.7, 1.2)
            axes.legend(frameon=False, loc="lower left", ncols=2)
            tidy(axes)
        panels[0].set_ylabel(f"loss / start, {k} frames")

    save_column(config.results / "step_size_curves", draw, height=2.6, width=PAGE)


if __name__ == "__main__":
    main(tyro.cli(Config))
