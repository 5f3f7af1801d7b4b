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
from jaxshape.geometry.grid import RESOLUTION
from jaxshape.geometry.overlap import iou
from jaxshape.model.shapes import ShapePrior
from jaxshape.model.weights import fingerprint, load_prior
from jaxshape.report.figures import tidy
from jaxshape.report.palette import BLUE, GREEN, GREY, INK, ORANGE
from jaxshape.results.evaluation import Case
from jaxshape.results.journal import Journal
from jaxshape.search.config import RefineConfig
from jaxshape.search.methods.gradient import LEARNING_RATE, STEP_SIZES
from jaxshape.search.reconstruction import reconstruct, refiner_for
from study import (
    Claim,
    Contestant,
    Scores,
    TestSet,
    compare,
    conclude,
    mean_interval,
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
    prior = load_prior(config.weights)
    settings = {
        "frames": config.frames,
        "iterations": config.iterations,
        "trials": TRIALS,
        "weights": fingerprint(prior),
        # Root mean square over the coordinates of the codes' standard deviations.
        "deviation_of_codes": round(float(jnp.sqrt(jnp.diag(prior.code_covariance).mean())), 4),
    }
    journal = Journal(config.results / "step_size.json", settings)
    search = RefineConfig(iterations=config.iterations, tolerance=0.0)
    contestants = {method: trying(method, search) for method in TRIALS}
    compare(contestants, prior, config.test, config.frames, journal, at_a_time=CASES_AT_A_TIME)
    conclude(journal, claims(journal, config), summary=summary(journal, config))
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


def overshoots(journal: Journal, frames: int, method: str) -> np.ndarray:
    """Share of the chairs whose last loss is above the first, with each value."""
    last, start = (scores(journal, frames, method, score) for score in ("last", "start"))
    return (last > start).mean(axis=0)


def best_of(journal: Journal, config: Config, method: str) -> dict[str, Trial]:
    """The value with the largest fall: for each number of frames, and for all in the mean."""
    falls = {str(k): fall(journal, k, method) for k in config.frames}
    falls["all"] = np.mean(list(falls.values()), axis=0)
    return {k: TRIALS[method][int(np.argmax(values))] for k, values in falls.items()}


def best_in(journal: Journal, config: Config, method: str, space: str) -> Trial:
    """The best value in one of the spaces, over all numbers of frames."""
    falls = np.mean([fall(journal, k, method) for k in config.frames], axis=0)
    trials = [(part, trial) for part, trial in zip(falls, TRIALS[method], strict=True)
              if trial.space == space]  # fmt: skip
    return max(trials)[1]


def summary(journal: Journal, config: Config) -> dict[str, Any]:
    """The best values, and the figures of each value and number of frames."""

    def of(method: str, k: int) -> dict[str, Any]:
        means = {
            "objective": scores(journal, k, method, "objective").mean(axis=0),
            "part_of_best_fall": fall(journal, k, method),
            "iou_gained": gain(journal, k, method).mean(axis=0),
            "overshoots": overshoots(journal, k, method),
            "rises": scores(journal, k, method, "rises").mean(axis=0),
            "moved": scores(journal, k, method, "moved").mean(axis=0),
        }
        return {
            text(trial): {name: float(f"{values[i]:.4g}") for name, values in means.items()}
            for i, trial in enumerate(TRIALS[method])
        }

    return {
        method: {"best": {k: text(trial) for k, trial in best_of(journal, config, method).items()}}
        | {str(k): of(method, k) for k in config.frames}
        for method in TRIALS
    }


def text(trial: Trial) -> str:
    return f"{trial.step:g} {'in codes' if trial.space == 'raw' else 'whitened'}"


def parts(journal: Journal, config: Config, method: str, trial: Trial) -> list[float]:
    """Share of the best decrease that a value attains, for each number of frames."""
    i = TRIALS[method].index(trial)
    return [float(fall(journal, k, method)[i]) for k in config.frames]


def percents(journal: Journal, config: Config, method: str, trial: Trial) -> str:
    return ", ".join(f"{part:.0%}" for part in parts(journal, config, method, trial))


def claims(journal: Journal, config: Config) -> list[Claim]:
    """The paper's claims about this figure, our findings, and their consequences."""
    return [
        papers_step(journal, config),
        papers_sigma(journal, config),
        papers_scales(journal, config),
        steady(journal, config),
        defaults(journal, config),
        spaces(journal, config),
    ]


def papers_step(journal: Journal, config: Config) -> Claim:
    method, trial = DESCENT, PAPERS[DESCENT]
    best = best_in(journal, config, method, "raw")
    longest = max(one.step for one in TRIALS[method] if one.space == "raw")
    edge = ", the longest tried," if best.step == longest else ""
    raw = [i for i, one in enumerate(TRIALS[method]) if one.space == "raw"]
    ending_above = np.max([overshoots(journal, k, method) for k in config.frames], axis=0)
    too_long = [TRIALS[method][i].step for i in raw if ending_above[i] > 0.1]
    is_fast = min(parts(journal, config, method, trial)) > 0.8
    is_kept = trial.step not in too_long

    return Claim(
        "Fig. gm right",
        "A step of 0.14 leads to fast convergence without overshooting",
        f"It achieves {percents(journal, config, method, trial)} of the best step's decrease at"
        f" {_listed(config.frames)} frames in {config.iterations} iterations; {text(best)}{edge} is"
        " the best step. Steps after which a tenth of the chairs end above the start:"
        f" {_listed(too_long) or 'none'}",
        "yes" if is_fast and is_kept else "not fast" if is_kept else "no",
    )


def papers_sigma(journal: Journal, config: Config) -> Claim:
    method, trial = "CMA-ES", PAPERS["CMA-ES"]
    deviation = journal.settings["deviation_of_codes"]
    return Claim(
        "Sec. 4",
        "sigma0 = 2 is best for CMA-ES",
        f"It achieves {percents(journal, config, method, trial)} of the best sigma0's decrease at"
        f" {_listed(config.frames)} frames: 2 is {trial.step / deviation:.1f} standard deviations"
        " of the codes. The best value in this space is"
        f" {text(best_in(journal, config, method, 'raw'))}",
        "yes" if min(parts(journal, config, method, trial)) > 0.9 else "no",
    )


def papers_scales(journal: Journal, config: Config) -> Claim:
    """Codes c times as long need c times the sigma0, and c^2 times the step."""
    sigma, step = (best_in(journal, config, method, "raw").step for method in ("CMA-ES", DESCENT))
    longer = PAPERS["CMA-ES"].step / sigma
    louder = longer**2 * step / PAPERS[DESCENT].step
    return Claim(
        "beyond",
        "The paper's two values follow from the scale of its codes and of its loss",
        f"2 would be the best sigma0 for codes {longer:.0f} times as long. For such codes, 0.14"
        f" would be the best step for a loss {louder:.1g} times as large; the loss without the"
        " factor 1 / N^3 is 3e+04 times as large",
        "plausible" if 0.1 < louder / RESOLUTION**3 < 10 else "not from these two alone",
    )


def steady(journal: Journal, config: Config) -> Claim:
    best = {method: best_of(journal, config, method) for method in TRIALS}
    return Claim(
        "beyond",
        f"One value suffices for {_listed(config.frames)} frames",
        "; ".join(
            f"{method} {text(best[method]['all'])}:"
            f" {percents(journal, config, method, best[method]['all'])} of the best decreases"
            for method in TRIALS
        ),
        _which({m: min(parts(journal, config, m, best[m]["all"])) > 0.9 for m in TRIALS}),
    )


def defaults(journal: Journal, config: Config) -> Claim:
    def against_best(method: str) -> str:
        here = TRIALS[method].index(DEFAULTS[method])
        best = best_of(journal, config, method)
        differences = [
            gain(journal, k, method)[:, here]
            - gain(journal, k, method)[:, TRIALS[method].index(best[str(k)])]
            for k in config.frames
        ]
        return (
            f"{method}, {text(DEFAULTS[method])}:"
            f" {percents(journal, config, method, DEFAULTS[method])} of the best decreases,"
            f" IoU {mean_interval(np.concatenate(differences))} relative to the best value"
        )

    return Claim(
        "beyond",
        "The defaults are as good as the best values",
        "; ".join(map(against_best, TRIALS)),
        _which({m: min(parts(journal, config, m, DEFAULTS[m])) > 0.9 for m in TRIALS}),
    )


def spaces(journal: Journal, config: Config) -> Claim:
    best = {
        method: [best_in(journal, config, method, space) for space in ("raw", "whitened")]
        for method in PAPERS
    }
    return Claim(
        "beyond",
        "The codes themselves serve as well as whitened ones",
        "; ".join(
            f"{method}: "
            + ", ".join(f"{text(t)} {percents(journal, config, method, t)}" for t in best[method])
            + " of the best decreases"
            for method in PAPERS
        ),
        _which({m: min(parts(journal, config, m, best[m][0])) > 0.9 for m in PAPERS}),
    )


def _listed(values: Sequence[Any]) -> str:
    return ", ".join(f"{x:g}" if isinstance(x, float) else str(x) for x in values)


def _which(holds: dict[str, bool]) -> str:
    names = [name for name, does in holds.items() if does]
    return (
        "yes" if len(names) == len(holds) else f"for {' and '.join(names)} only" if names else "no"
    )


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
                    chosen = [i for i, trial in enumerate(TRIALS[method]) if trial.space == space]
                    if not chosen:
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
            chosen = [i for i, trial in enumerate(TRIALS[method]) if trial.space == space]
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
