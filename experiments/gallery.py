r"""Measured, proposed, refined and true shape by number of frames (paper, Fig. mapping).

    python experiments/gallery.py --test.meshes cad_chairs/

Six chairs after 1 to 18 frames of an orbit: F with M as a fog around it, the encoder's shape, the
shape of CMA-ES after 60 iterations, the composed shape and the truth. In the refined shapes, true
voxels that the encoder had missed are dark. The chairs are chosen by rule: among the first 16
procedural and the first 16 CAD chairs of the test set, the ones whose gain of IoU from encoder to
CMA-ES, at 4 frames, is nearest to the 25th, 50th and 75th percentile of their group.

Results in experiments/results: gallery.json (who made the CAD seats, IoU of every picture),
gallery.png and .svg, and headline.png and .svg (the two medians after 1, 4 and 18 frames).
Time: 3 minutes on two cores.
"""

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import study
from figures import save_column
from jaxshape.data.dataset import load_object
from jaxshape.data.meshes import Skipped
from jaxshape.geometry.overlap import iou
from jaxshape.model.shapes import ShapePrior
from jaxshape.model.weights import fingerprint, load_prior
from jaxshape.report.palette import BLUE, GREEN, GREY, INK, ORANGE, PINK, RED
from jaxshape.report.pictures import render_measurement, render_voxels
from jaxshape.results.evaluation import Case, case_keys, observe
from jaxshape.results.journal import Journal
from jaxshape.search.config import RefineConfig
from jaxshape.search.reconstruction import Reconstruction, reconstruct_jit, refiner_for
from study import SEEN, TUNED, Claim, Subject, TestSet, conclude, subjects

CREATORS = Path(__file__).with_name("cad_seats.json")
PERCENTILES = (25, 50, 75)
WIDTH = 8.0  # inches, 1600 pixels
AZIMUTH = -45.0  # degrees: the side that the orbit sees last, since it starts the other way round
COLUMNS = {"F and M": BLUE, "encoder": PINK, "refined": ORANGE, "composed": ORANGE, "truth": GREEN}


@dataclass(frozen=True)
class Config(study.Config):
    """Settings of the experiment."""

    test: TestSet = TestSet(chairs=16, seats=16)
    """The chairs to choose from."""
    frames: tuple[int, ...] = (1, 2, 4, 8, 18)
    """Numbers of frames that are fused: the rows."""
    choose_at: int = 4
    """Number of frames at which the gain in IoU decides which chairs are shown."""
    iterations: int = 60
    """Iterations of CMA-ES (paper: 350)."""


class Shown(NamedTuple):
    """A chair after each number of frames."""

    chair: Subject
    percentile: int
    """Percentile of its gain in its group."""
    frames: tuple[int, ...]
    """Index of the rows of the case and of the results."""
    case: Case
    found: Reconstruction


def main(config: Config) -> None:
    config = config.reduced(frames=(1, 4), iterations=2)
    shown = run(config)[1]
    if not shown:
        return
    plot(shown, config.frames, config.results / "gallery")
    medians = [one for one in shown if one.percentile == 50]
    plot(medians, [k for k in (1, 4, 18) if k in config.frames], config.results / "headline")


def run(config: Config) -> tuple[Journal, list[Shown]]:
    """Choose the chairs, rebuild them after each number of frames, and write the results.

    No chairs are returned if the results of these settings and their pictures already exist.
    """
    prior = load_prior(config.weights)
    settings = {
        "chairs": config.test.chairs,
        "seats": config.test.seats,
        "frames": config.frames,
        "choose_at": config.choose_at,
        "iterations": config.iterations,
        "weights": fingerprint(prior),
    }
    journal = Journal(config.results / "gallery.json", settings)
    if journal.rows and (config.results / "headline.svg").is_file():
        return journal, []
    journal.rows, journal.seconds = {}, 0.0
    began = time.perf_counter()
    search = replace(TUNED["CMA-ES"][1], iterations=config.iterations)
    shown = []
    for group, chairs in _by_group(config.test).items():
        seen = rebuild(chairs, (config.choose_at,), prior, search)
        gains = [float(_gains(case, found)[0]) for _, case, found in seen]
        for percentile, i in at_percentiles(gains).items():
            print(f"{group}, percentile {percentile}: {seen[i][0].name}, gain {gains[i]:+.3f}")
            shown.append((seen[i][0], percentile))
    rebuilt = rebuild([chair for chair, _ in shown], config.frames, prior, search)
    shown = [
        Shown(chair, percentile, config.frames, case, found)
        for (_, percentile), (chair, case, found) in zip(shown, rebuilt, strict=True)
    ]
    journal.add({one.chair.name: row(one) for one in shown}, time.perf_counter() - began)
    conclude(journal, claims(journal, config))
    return journal, shown


def _by_group(test: TestSet) -> dict[str, list[Subject]]:
    chairs = subjects(test)
    names = dict.fromkeys(sorted((chair.group for chair in chairs), reverse=True))
    return {name: [chair for chair in chairs if chair.group == name] for name in names}


def at_percentiles(values: Sequence[float]) -> dict[int, int]:
    """Index of the value nearest to each percentile; a value that is nearest to several percentiles
    is used for the middle one."""
    order = np.argsort(values)
    places = {p: round(p / 100 * (len(order) - 1)) for p in (50, *PERCENTILES)}
    chosen: dict[int, int] = {}
    for percentile, place in places.items():
        if order[place] not in chosen.values():
            chosen[percentile] = int(order[place])
    return dict(sorted(chosen.items()))


def rebuild(
    chairs: Sequence[Subject], frames: Sequence[int], prior: ShapePrior, search: RefineConfig
) -> list[tuple[Subject, Case, Reconstruction]]:
    """Each chair with its measurement and reconstruction, after each number of frames."""
    seen = []
    for chair in chairs:
        model = load_object(chair.item)
        if isinstance(model, Skipped):
            continue
        case = observe(model, replace(SEEN, frames=tuple(frames)))
        if case is not None:
            seen.append((chair, case))
    keys = jnp.concatenate([case_keys(chair.name, frames) for chair, _ in seen])
    case = jax.tree.map(lambda *x: jnp.concatenate(x), *[case for _, case in seen])
    run = reconstruct_jit(refiner_for("cma", prior, search), search)
    found = jax.device_get(run(keys, prior, case.grids.occupied, case.grids.occluded))
    found = found._replace(trace=None, path=None)
    return [
        (
            chair,
            jax.tree.map(np.asarray, case),
            jax.tree.map(lambda x, i=i: x[i * len(frames) :][: len(frames)], found),
        )
        for i, (chair, case) in enumerate(seen)
    ]


def _gains(case: Case, found: Reconstruction) -> np.ndarray:
    return np.asarray(iou(found.completed, case.surface) - iou(found.completed_first, case.surface))


def row(one: Shown) -> dict[str, Any]:
    """The record of a chair: its makers, and the IoU of its pictures."""
    shapes = _shapes(one)
    scores = {name: np.asarray(iou(shape, one.case.surface)) for name, shape in shapes.items()}
    return {
        "group": one.chair.group,
        "percentile": one.percentile,
        "credit": credit(one.chair),
        **{
            str(k): {name: round(float(values[i]), 4) for name, values in scores.items()}
            for i, k in enumerate(one.frames)
        },
    }


def _shapes(one: Shown) -> dict[str, Any]:
    return {
        "F and M": one.case.grids.occupied,
        "encoder": one.found.completed_first,
        "refined": one.found.completed,
        "composed": one.found.composed,
    }


def credit(chair: Subject) -> str:
    """Name, maker and licence of a chair."""
    if chair.group == "procedural":
        return f"procedural {chair.name}"
    listed = {seat["name"]: seat for seat in json.loads(CREATORS.read_text(encoding="utf-8"))}
    if (seat := listed.get(chair.name)) is None:
        return chair.name
    return f"“{seat['title']}” by {seat['creator']}, {seat['licence']}"


def claims(journal: Journal, config: Config) -> list[Claim]:
    """The paper's claims about this figure, counted over its pictures."""
    gains = np.array(
        [
            [row[str(k)]["refined"] - row[str(k)]["encoder"] for k in config.frames]
            for row in journal.rows.values()
        ]
    )
    better = (gains > 0).sum(axis=0)
    counts = ", ".join(f"{n} at {k}" for n, k in zip(better, config.frames, strict=True))
    share = better.sum() / gains.size
    return [
        Claim(
            "Fig. mapping",
            "Most refined results exceed those of the auto-encoder",
            f"Chairs out of {len(gains)} whose IoU is higher after refinement: {counts} frames."
            f" Mean gain {gains[:, 0].mean():+.3f} at {config.frames[0]} frames,"
            f" {gains[:, -1].mean():+.3f} at {config.frames[-1]}",
            "yes" if share > 0.5 else "no",
        )
    ]


# ------------------------------------------------------------------ pictures

HEADER, CAPTION, GUTTER, LABELS, KEY = 0.26, 0.3, 0.16, 0.36, 0.16  # inches
TRUTH = 1.45  # size of the picture of the truth, in cells
KEYS = (
    "numbers: IoU    grey: occluded    dark red: true, missed by the encoder    "
    "composed: blue as measured, orange as refined"
)


def plot(shown: Sequence[Shown], frames: Sequence[int], stem: Path) -> None:
    """Blocks of pictures, two in a row: rows are frames, columns as in `COLUMNS`."""
    side = 2 if len(shown) > 1 else 1
    cell = (WIDTH - side * LABELS - (side - 1) * GUTTER) / (side * (len(COLUMNS) - 1 + TRUTH))
    block = (
        LABELS + (len(COLUMNS) - 1 + TRUTH) * cell + GUTTER,
        HEADER + len(frames) * cell + CAPTION,
    )
    lines = -(-len(shown) // side)

    def draw(figure: Any) -> None:
        figure.set_layout_engine("none")
        # procedural chairs to the left, CAD seats to the right
        for i, one in enumerate(shown):
            column, line = (i // lines, i % lines) if side > 1 else (0, i)
            _draw_block(figure, one, frames, cell, column * block[0], line * block[1])
        style = {"ha": "right", "va": "bottom", "color": GREY, "size": 6.5}
        figure.text(0.995, 0.03 / figure.get_figheight(), KEYS, **style)

    save_column(stem, draw, height=lines * block[1] + KEY, width=WIDTH)


def _draw_block(
    figure: Any, one: Shown, frames: Sequence[int], cell: float, left: float, top: float
) -> None:
    """A chair; lengths in inches from the upper left corner of the figure."""
    width, height = figure.get_size_inches()

    def text(x: float, y: float, content: str, **style: Any) -> None:
        figure.text(x / width, 1 - y / height, content, va="center", **style)

    def show(x: float, y: float, size: float, image: np.ndarray) -> None:
        axes = figure.add_axes((x / width, 1 - (y + size) / height, size / width, size / height))
        axes.imshow(image, interpolation="antialiased")
        axes.axis("off")

    across = left + LABELS + cell * np.arange(len(COLUMNS))
    for x, (name, color) in zip(across, COLUMNS.items(), strict=True):
        size = TRUTH * cell if name == "truth" else cell
        text(x + size / 2, top + HEADER / 2, name, ha="center", color=color, weight="bold")
    for j, k in enumerate(frames):
        i = one.frames.index(k)
        y = top + HEADER + j * cell
        text(left + 0.04, y + cell / 2, str(k), ha="left", color=INK, weight="bold", size=9)
        for x, (name, shape) in zip(across, _shapes(one).items(), strict=False):
            show(x, y, cell, _picture(one, name, i))
            score = float(iou(shape[i], one.case.surface[i]))
            text(x + 0.97 * cell, y + 0.94 * cell, f"{score:.2f}", ha="right", color=GREY, size=6)
    text(left + 0.04, top + HEADER / 2, "frames", ha="left", color=INK, size=6)
    rows = len(frames) * cell
    show(across[-1], top + HEADER + (rows - TRUTH * cell) / 2, TRUTH * cell, _truth(one))
    text(left + LABELS, top + HEADER + rows + 0.1, credit(one.chair), ha="left", color=GREY, size=7)


def _picture(one: Shown, name: str, i: int) -> np.ndarray:
    """A cell of a block."""
    occupied, occluded, surface = (
        np.asarray(grid[i]) for grid in (*one.case.grids[:2], one.case.surface)
    )
    first, refined, composed = (
        np.asarray(grid[i])
        for grid in (one.found.completed_first, one.found.completed, one.found.composed)
    )
    if name == "F and M":
        return render_measurement(occupied, occluded, size=320, azimuth=AZIMUTH)
    labels, colors = {
        "encoder": (1 * first, [PINK]),
        "refined": (np.where(refined & surface & ~first, 2, 1 * refined), [ORANGE, RED]),
        "composed": (np.where(occupied, 1, 2 * composed), [BLUE, ORANGE]),
    }[name]
    return _render(labels, colors)


def _render(labels: np.ndarray, colors: Sequence[str], size: int = 320) -> np.ndarray:
    return render_voxels(labels, colors, size=size, azimuth=AZIMUTH)


def _truth(one: Shown) -> np.ndarray:
    return _render(1 * np.asarray(one.case.surface[-1]), [GREEN], size=480)


if __name__ == "__main__":
    main(tyro.cli(Config))
