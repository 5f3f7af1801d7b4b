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
import numpy as np
import tyro

import study
from figures import Sheet, save_column
from jaxshape.geometry.overlap import iou
from jaxshape.model.shapes import ShapePrior
from jaxshape.report.palette import BLUE, GREEN, GREY, INK, ORANGE, PINK, RED
from jaxshape.report.pictures import render_measurement, render_voxels
from jaxshape.results.evaluation import Case
from jaxshape.results.journal import Journal
from jaxshape.search.config import RefineConfig
from jaxshape.search.reconstruction import Reconstruction, reconstruct_jit, refiner_for
from study import SEEN, TUNED, Subject, TestSet, observed, rounded, subjects, together

CREATORS = Path(__file__).with_name("cad_seats.json")
PERCENTILES = (25, 50, 75)
CHOOSE_AT = 4
"""Number of frames at which the gain in IoU decides which chairs are shown."""
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
    iterations: int = 60
    """Iterations of CMA-ES (paper: 350)."""


class Shown(NamedTuple):
    """A chair, measured and rebuilt after each number of frames."""

    chair: Subject
    frames: Sequence[int]
    """Index of the rows of the case and of the results."""
    case: Case
    found: Reconstruction
    percentile: int = 50
    """Percentile of its gain in its group."""

    def shapes(self) -> dict[str, Any]:
        """The grids of the columns, without the truth."""
        found = self.found
        shapes = (self.case.grids.occupied, found.completed_first, found.completed, found.composed)
        return {name: np.asarray(x) for name, x in zip(COLUMNS, shapes, strict=False)}

    def scores(self) -> dict[str, np.ndarray]:
        """IoU of these grids with the truth."""
        return {name: np.asarray(iou(x, self.case.surface)) for name, x in self.shapes().items()}


def main(config: Config) -> None:
    config = config.reduced(frames=(1, 4), iterations=2)
    if shown := run(config):
        plot(shown, config.frames, config.results / "gallery")
        medians = [one for one in shown if one.percentile == 50]
        plot(medians, [k for k in (1, 4, 18) if k in config.frames], config.results / "headline")


def run(config: Config) -> list[Shown]:
    """Choose the chairs, rebuild them after each number of frames, and write the results.

    No chairs are returned if the results of these settings and their pictures already exist.
    """
    prior, journal = config.begin(
        "gallery",
        chairs=config.test.chairs,
        seats=config.test.seats,
        frames=config.frames,
        choose_at=CHOOSE_AT,
        iterations=config.iterations,
    )
    if journal.rows and (config.results / "headline.svg").is_file():
        return []
    journal.rows, journal.seconds = {}, 0.0
    began = time.perf_counter()
    search = replace(TUNED["CMA-ES"][1], iterations=config.iterations)
    chosen: list[tuple[Subject, int]] = []
    chairs = subjects(config.test)
    for group in sorted({chair.group for chair in chairs}, reverse=True):
        of_group = [chair for chair in chairs if chair.group == group]
        seen = rebuild(of_group, (CHOOSE_AT,), prior, search)
        gains = [float(s["refined"][0] - s["encoder"][0]) for s in (one.scores() for one in seen)]
        chosen += [(seen[i].chair, p) for p, i in at_percentiles(gains).items()]
    shown = rebuild([chair for chair, _ in chosen], config.frames, prior, search)
    shown = [one._replace(percentile=p) for one, (_, p) in zip(shown, chosen, strict=True)]
    journal.add({one.chair.name: row(one) for one in shown}, time.perf_counter() - began)
    journal.write({"summary": summary(journal, config)})
    return shown


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
) -> list[Shown]:
    """Each chair with its measurement and reconstruction, after each number of frames."""
    seen = list(observed(chairs, replace(SEEN, frames=tuple(frames))))
    keys, case = together(seen, frames)
    run = reconstruct_jit(refiner_for("cma", prior, search), search)
    found = jax.device_get(run(keys, prior, case.grids.occupied, case.grids.occluded))
    found = found._replace(trace=None, path=None)
    n = len(frames)
    return [
        Shown(chair, frames, case, jax.tree.map(lambda x, i=i: x[i * n : (i + 1) * n], found))
        for i, (chair, case) in enumerate(seen)
    ]


def row(one: Shown) -> dict[str, Any]:
    """The record of a chair: its makers, and the IoU of its pictures."""
    scores = one.scores()
    return {
        "group": one.chair.group,
        "percentile": one.percentile,
        "credit": credit(one.chair),
        **{
            str(k): {name: round(float(values[i]), 4) for name, values in scores.items()}
            for i, k in enumerate(one.frames)
        },
    }


def summary(journal: Journal, config: Config) -> dict[str, Any]:
    """Number of chairs whose IoU is higher after refinement, and mean gain, by number of frames."""
    rows = journal.rows.values()
    gains = {
        str(k): [row[str(k)]["refined"] - row[str(k)]["encoder"] for row in rows]
        for k in config.frames
    }
    return {
        k: {"higher": int(np.sum(np.array(x) > 0)), "gain": rounded(np.mean(x))}
        for k, x in gains.items()
    }


def credit(chair: Subject) -> str:
    """Name, maker and licence of a chair."""
    if chair.group == "procedural":
        return f"procedural {chair.name}"
    listed = {seat["name"]: seat for seat in json.loads(CREATORS.read_text(encoding="utf-8"))}
    if (seat := listed.get(chair.name)) is None:
        return chair.name
    return f"“{seat['title']}” by {seat['creator']}, {seat['licence']}"


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
        sheet = Sheet(figure)
        # procedural chairs to the left, CAD seats to the right
        for i, one in enumerate(shown):
            column, line = (i // lines, i % lines) if side > 1 else (0, i)
            _draw_block(sheet, one, frames, cell, column * block[0], line * block[1])
        style = {"ha": "right", "va": "bottom", "color": GREY, "size": 6.5}
        figure.text(0.995, 0.03 / sheet.height, KEYS, **style)

    save_column(stem, draw, height=lines * block[1] + KEY, width=WIDTH)


def _draw_block(
    sheet: Sheet, one: Shown, frames: Sequence[int], cell: float, left: float, top: float
) -> None:
    """A chair, its upper left corner at a place."""
    across = left + LABELS + cell * np.arange(len(COLUMNS))
    for x, (name, color) in zip(across, COLUMNS.items(), strict=True):
        size = TRUTH * cell if name == "truth" else cell
        sheet.text(x + size / 2, top + HEADER / 2, name, color=color, weight="bold")
    scores = one.scores()
    for j, k in enumerate(frames):
        i = one.frames.index(k)
        y = top + HEADER + j * cell
        sheet.text(left + 0.04, y + cell / 2, k, ha="left", color=INK, weight="bold", size=9)
        for x, (name, image) in zip(across, _pictures(one, i).items(), strict=False):
            sheet.show(x, y, cell, cell, image)
            score = f"{scores[name][i]:.2f}"
            sheet.text(x + 0.97 * cell, y + 0.94 * cell, score, ha="right", color=GREY, size=6)
    sheet.text(left + 0.04, top + HEADER / 2, "frames", ha="left", color=INK, size=6)
    rows, size = len(frames) * cell, TRUTH * cell
    truth = _render(1 * np.asarray(one.case.surface[-1]), [GREEN], size=480)
    sheet.show(across[-1], top + HEADER + (rows - size) / 2, size, size, truth)
    style = {"ha": "left", "color": GREY, "size": 7}
    sheet.text(left + LABELS, top + HEADER + rows + 0.1, credit(one.chair), **style)


def _pictures(one: Shown, i: int) -> dict[str, np.ndarray]:
    """The cells of a row of a block, without the truth."""
    occluded, surface = (np.asarray(x[i]) for x in (one.case.grids.occluded, one.case.surface))
    occupied, first, refined, composed = (x[i] for x in one.shapes().values())
    missed = np.where(refined & surface & ~first, 2, 1 * refined)
    pictures = (
        render_measurement(occupied, occluded, size=320, azimuth=AZIMUTH),
        _render(1 * first, [PINK]),
        _render(missed, [ORANGE, RED]),
        _render(np.where(occupied, 1, 2 * composed), [BLUE, ORANGE]),
    )
    return dict(zip(COLUMNS, pictures, strict=False))


def _render(labels: np.ndarray, colors: Sequence[str], size: int = 320) -> np.ndarray:
    return render_voxels(labels, colors, size=size, azimuth=AZIMUTH)


if __name__ == "__main__":
    main(tyro.cli(Config))
