"""Comparison of searches on the same chairs: common code of the scripts in `experiments/`. [host]

A `Contestant` takes a batch of cases, measurements of chairs after some number of frames, and
returns its scores as arrays with a row for each case; `compare` runs some on the whole `TestSet`.
"""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key, Num
from rich.progress import Progress, TimeElapsedColumn

import runs
from figures import LINES, PAGE, draw_mean, interval, number_axis, save_column
from jaxshape.data.archives import list_meshes
from jaxshape.data.dataset import Dataset, Object, hash_seed, load_object
from jaxshape.data.families import TEST_SEEDS, procedural_objects
from jaxshape.data.meshes import Skipped
from jaxshape.geometry.overlap import iou
from jaxshape.model.config import Completion, TrainConfig
from jaxshape.model.shapes import ShapePrior
from jaxshape.model.training import finished_prior, train
from jaxshape.model.weights import fingerprint, load_prior
from jaxshape.results.evaluation import Case, EvaluateConfig, case_keys, fill, observe
from jaxshape.results.journal import Journal
from jaxshape.results.metrics import bounds
from jaxshape.search.config import RefineConfig
from jaxshape.search.reconstruction import Reconstruction, reconstruct, refiner_for

CASES_AT_A_TIME = 64
"""Number of cases searched together, unless a chair has more: they are written to the journal
together."""

SEEN = EvaluateConfig(camera="paper", noise=False, fusion="points")
"""Camera and fusion of the paper: square images without noise, their points counted in voxels."""
SEARCH = RefineConfig(symmetry=False)
"""Search and composition of the paper: nothing is mirrored."""

TUNED: dict[str, tuple[str, RefineConfig]] = {
    "gradient descent": ("gradient", replace(SEARCH, space="raw", step_size=40.0)),
    "Adam": ("gradient:adam", SEARCH),
    "CMA-ES": ("cma", replace(SEARCH, space="raw", sigma0=0.14)),
}
"""The paper's searches and Adam, with the best values of experiments/step_size.py."""

# Scores of a batch of cases, from a random key for each, the prior, and the cases themselves.
Scores = Mapping[str, Array]
Contestant = Callable[[Key[Array, " case"], ShapePrior, Case], Scores]


@dataclass(frozen=True)
class TestSet:
    """The chairs for the comparison of searches; no network was trained on them."""

    __test__ = False  # pytest would take the name for a test

    chairs: int = 288
    """Procedural chairs, from seeds kept for tests (the paper has 288 of ShapeNet)."""
    seats: int = 78
    """Largest number of CAD seats."""
    meshes: Path = Path("cad_chairs")
    """Folder of the CAD seats, as experiments/cad_seats.py writes it."""


@dataclass(frozen=True)
class Config(runs.Config):
    """Settings that the scripts of the paper share."""

    test: TestSet = TestSet()
    weights: Path = Path("chair-autoencoder")
    """Weights of the shape prior; the package's by default."""

    def reduced(self, *, chairs: int = 2, **few: Any) -> Self:
        """The settings of the run: with few procedural chairs alone in a test run."""
        return super().reduced(test=replace(self.test, chairs=chairs, seats=0), **few)

    def begin(self, name: str, **settings: Any) -> tuple[ShapePrior, Journal]:
        """The prior, and the rows that were made with its weights and these settings."""
        prior = load_prior(self.weights)
        return prior, self.journal(name, weights=fingerprint(prior), **settings)


class Subject(NamedTuple):
    """A chair of the test set."""

    name: str
    group: str
    """`procedural` or `CAD`."""
    item: Object


def subjects(test: TestSet) -> list[Subject]:
    """The chairs of a test set, mixed: a smaller set is part of a larger one.

    `FileNotFoundError` if seats are requested and there is no folder of meshes.
    """
    chairs = procedural_objects("chair", test.chairs, TEST_SEEDS)
    procedural = [Subject(chair.name, "procedural", chair) for chair in chairs]
    seats = list_meshes(test.meshes) if test.seats else []
    cad = [Subject(source.name, "CAD", source) for source in sorted(seats, key=_mix)]
    return sorted(procedural + cad[: test.seats], key=_mix)


def listed(meshes: Path | None, count: int) -> list[Object]:
    """All meshes of a folder, in its order; as many procedural chairs where none is given."""
    if meshes is None:
        return [*procedural_objects("chair", count, TEST_SEEDS)]
    return [*list_meshes(meshes)]


def _mix(subject: Any) -> int:
    return hash_seed(0, *subject.name.encode())


def by_method(method: str, prior: ShapePrior, config: RefineConfig) -> Contestant:
    """The contestant that rebuilds by a method of `jaxshape.search.methods`, or `encoder`."""
    refiner = refiner_for(method, prior, config)

    def contest(keys, prior, case):
        F, M = case.grids.occupied, case.grids.occluded
        found = reconstruct(keys, prior, F, M, refiner, config)
        return shape_and_objective(found, case)

    return contest


def tuned(prior: ShapePrior, iterations: int) -> dict[str, Contestant]:
    """The encoder and the `TUNED` searches, all with the same number of iterations."""
    searches = {"encoder": ("encoder", SEARCH)} | TUNED
    return {
        name: by_method(method, prior, replace(config, iterations=iterations))
        for name, (method, config) in searches.items()
    }


def shape_and_objective(found: Reconstruction, case: Case) -> Scores:
    """IoU of the decoded and of the composed shape, and the objective that was reached."""
    return {
        "iou": iou(found.completed, case.surface),
        "iou_composed": iou(found.composed, case.surface),
        "objective": found.objective,
    }


def measurement(keys: Key[Array, " case"], prior: ShapePrior, case: Case) -> Scores:
    """The paper's lower and upper bound: F with occluded voxels set to empty, and to full."""
    return bounds(case.grids.occupied, case.grids.occluded, case.surface)._asdict()


def compare(
    contestants: Mapping[str, Contestant],
    prior: ShapePrior,
    test: TestSet | Sequence[Subject],
    frames: Sequence[int],
    journal: Journal,
    *,
    noise: bool = False,
    at_a_time: int = CASES_AT_A_TIME,
) -> None:
    """Run every contestant on every chair, after each number of frames, unless its row exists.

    A row is `{"group": ..., frames: {contestant: scores}}`; `seconds` are added to the scores: the
    time of the batch without compilation, divided by its cases. All contestants draw the same
    random keys, which depend on the chair and the number of frames alone. `noise` adds the faults
    of a real depth sensor. Fewer cases `at_a_time` lose less of a long search when it is killed.
    """
    chairs = subjects(test) if isinstance(test, TestSet) else test
    config = replace(SEEN, frames=tuple(frames), noise=noise)
    missing = [one for one in chairs if _left(contestants, [one], journal)]
    searches = sum(len(_left(contestants, [one], journal)) for one in missing)
    group = max(1, at_a_time // len(frames))
    size = min(group, len(missing)) * len(frames)
    compiled: dict[str, Any] = {}
    with Progress(*Progress.get_default_columns(), TimeElapsedColumn()) as bar:
        task = bar.add_task(journal.path.stem, total=searches)
        for start in range(0, len(missing), group):
            began = time.perf_counter()
            batch = list(observed(missing[start : start + group], config))
            if not batch:
                continue
            left = _left(contestants, [one for one, _ in batch], journal)
            keys, case = jax.tree.map(lambda x: fill(x, size), together(batch, frames))
            found = {}
            for name in left:
                if name not in compiled:
                    compiled[name] = jax.jit(contestants[name]).lower(keys, prior, case).compile()
                found[name] = _timed(compiled[name], keys, prior, case)
                bar.advance(task, len(batch))
            rows = {
                one.name: _row(one, found, frames, i, journal) for i, (one, _) in enumerate(batch)
            }
            journal.add(rows, time.perf_counter() - began)


def _left(names: Iterable[str], chairs: Sequence[Subject], journal: Journal) -> list[str]:
    """The contestants that have not run on all of the chairs."""
    rows = [journal.rows.get(one.name, {}) for one in chairs]
    met = [{name for k in row if k != "group" for name in row[k]} for row in rows]
    return [name for name in names if not all(name in one for one in met)]


def observed(chairs: Sequence[Subject], config: EvaluateConfig) -> Iterator[tuple[Subject, Case]]:
    """The chairs and their measurements; unusable chairs are named and left out."""
    for chair in chairs:
        model = load_object(chair.item)
        case = None if isinstance(model, Skipped) else observe(model, config)
        if case is None:
            print(f"{chair.name} is left out: {model}")
        else:
            yield chair, case


def together(
    batch: Iterable[tuple[Subject, Case]], frames: Sequence[int]
) -> tuple[Key[Array, " case"], Case]:
    """The random keys and the cases of some chairs, one after the other."""
    chairs, cases = zip(*batch, strict=True)
    keys = jnp.concatenate([case_keys(chair.name, frames) for chair in chairs])
    return keys, jax.tree.map(lambda *x: jnp.concatenate(x), *cases)


def tiny(settings: TrainConfig, batch: int) -> TrainConfig:
    """Settings for a network of the same kind that is trained in seconds."""
    small = settings.architecture
    if isinstance(small, Completion):
        small = Completion((4, 4, 8), 1, 10)
    else:
        code = min(small.code, 10)
        small = replace(small, encoder=(4, 4, 8, 8), decoder=(8, 8, 4), code=code)
    return replace(settings, architecture=small, batch=batch)


def train_reporting(name: str, folder: Path, dataset: Dataset, settings: TrainConfig) -> ShapePrior:
    """Train a network in a folder, or go on with it, and return it; its losses are printed."""
    for report in train(folder, dataset, settings):
        print(f"{name}: step {report.step}, loss {report.loss:.4f}, "
              f"{report.samples_per_second:.0f} samples/s", flush=True)  # fmt: skip
    return finished_prior(folder, dataset, settings, samples=2048)


def _timed(run: Callable[..., Scores], *args: Any) -> dict[str, np.ndarray]:
    start = time.perf_counter()
    scores = jax.block_until_ready(run(*args))
    seconds = time.perf_counter() - start
    arrays = {name: np.asarray(values) for name, values in scores.items()}
    count = len(next(iter(arrays.values())))
    return arrays | {"seconds": np.full(count, seconds / count)}


def _row(
    chair: Subject, found: Mapping[str, Any], frames: Sequence[int], place: int, journal: Journal
) -> dict[str, Any]:
    """The row of a chair at this place in the batch, merged with its earlier row."""
    row = journal.rows.get(chair.name, {"group": chair.group})
    for i, k in enumerate(frames, start=place * len(frames)):
        row[str(k)] = row.get(str(k), {}) | {
            name: {score: rounded(values[i].tolist()) for score, values in scores.items()}
            for name, scores in found.items()
        }
    return row


def rounded(value: Any) -> Any:
    """Numbers for JSON, to five significant digits; lists and arrays of them, too."""
    if isinstance(value, list | tuple | np.ndarray):
        return [rounded(v) for v in value]
    return float(f"{value:.5g}") if isinstance(value, float) else value


def mean_low_high(values: Num[np.ndarray, " n"]) -> list[float]:
    """The mean and the ends of its 95 % interval, as numbers for JSON."""
    return rounded((values.mean(), *interval(values)))


def column(
    journal: Journal, group: str | None, frames: int, contestant: str, score: str
) -> np.ndarray:
    """A score of a contestant over all chairs of a group, or of all groups in turn."""
    chosen = groups(journal) if group is None else [group]
    rows = [row for name in chosen for row in journal.rows.values() if row["group"] == name]
    return np.array([row[str(frames)][contestant][score] for row in rows])


def gain(
    journal: Journal,
    group: str | None,
    frames: int,
    better: str,
    worse: str = "encoder",
    score: str = "iou",
) -> np.ndarray:
    """A score of one contestant minus the same score of another, by chair."""
    return np.subtract(*[column(journal, group, frames, name, score) for name in (better, worse)])


def curves_by_frames(
    journal: Journal, group: str, frames: Sequence[int]
) -> dict[str, list[np.ndarray]]:
    """IoU of the encoder, the `TUNED` searches, composed, and F: an array for each number."""
    curves = {name: (name, "iou") for name in ("encoder", *TUNED)} | {
        "CMA-ES, composed": ("CMA-ES", "iou_composed"),
        "F, occluded empty": ("F", "occluded_empty"),
        "F, occluded full": ("F", "occluded_full"),
    }
    return {
        name: [column(journal, group, k, *score) for k in frames] for name, score in curves.items()
    }


LEADS = [("CMA-ES", name) for name in ("encoder", "gradient descent", "Adam", "F, occluded empty")]
LEADS += [("CMA-ES, composed", "F, occluded empty")]


def summary(
    journal: Journal,
    group: str,
    frames: Sequence[int],
    more: Mapping[str, list[np.ndarray]] | None = None,
) -> dict[str, dict[str, list[float]]]:
    """Mean and interval of all curves of a group, of `LEADS` and of further curves.

    The result is `summary[curve][frames] = [mean, low, high]`.
    """
    curves = curves_by_frames(journal, group, frames)
    leads = {f"{a} less {b}": np.subtract(curves[a], curves[b]) for a, b in LEADS}
    return {
        name: {str(k): mean_low_high(x) for k, x in zip(frames, curve, strict=True)}
        for name, curve in (curves | leads | dict(more or {})).items()
    }


def plot_curves(stem: Path, journal: Journal, frames: Sequence[int], title: str) -> None:
    """Draw the curves by numbers of frames, a panel for each group of chairs.

    Args:
        stem: Path of the files, without .png and .svg.
        journal: The rows.
        frames: Numbers of frames.
        title: Title of a panel, with places for the number of chairs and the name of their group.
    """

    def draw(figure: Any) -> None:
        panels = figure.subplots(1, len(groups(journal)), sharey=True, squeeze=False)[0]
        for axes, group in zip(panels, groups(journal), strict=True):
            curves = curves_by_frames(journal, group, frames)
            for name, curve in curves.items():
                draw_mean(axes, frames, np.stack(curve, axis=1), label=name, **LINES[name])
            count = len(next(iter(curves.values()))[0])
            number_axis(axes, frames, xlabel="frames", title=title.format(count, group))
        panels[0].set_ylabel("IoU")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, frameon=False, loc="outside lower center", ncols=4)

    save_column(stem, draw, height=3.1, width=PAGE)


def groups(journal: Journal) -> list[str]:
    """The groups of chairs that have rows: procedural ones first."""
    return sorted({row["group"] for row in journal.rows.values()}, reverse=True)
