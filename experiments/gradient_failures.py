r"""Where gradients stall and CMA-ES goes on, and the opposite cases (paper, Fig. gm_fail).

    python experiments/gradient_failures.py --test.meshes cad_chairs/

For 1, 4 and 8 frames, the script takes the chair on which CMA-ES leads plain descent most, by IoU,
and the chair on which it trails most, among all rows of iou_by_frames.py, which runs first if it
has not been run. Plain descent, Adam and CMA-ES then search the chosen chairs for the paper's 350
iterations, and each search continues for as long from the end of every other one. This tells a
local minimum from a slow search: only a search that can leave a minimum moves away from it. The
objective is also followed along the straight line between two ends: if it never rises above both,
no ridge separates them.

Extreme chairs show possible cases, not their frequency; the shares over all chairs show the
frequency.

Results: experiments/results/gradient_failures.json, and .png and .svg of the chairs on which CMA-ES
leads; gradient_failures_opposite has the chairs on which it trails. Finished chairs are kept.
Time: 6 minutes on two cores after iou_by_frames.py.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Array, Float, Key
from rich.progress import track

import iou_by_frames
from figures import PAGE, save_column
from jaxshape.geometry.overlap import iou
from jaxshape.model.shapes import ShapePrior, decode
from jaxshape.model.weights import load_prior
from jaxshape.report.panels import grid_panel, measurement_panel
from jaxshape.results.evaluation import Case, fill
from jaxshape.results.journal import Journal
from jaxshape.search.config import RefineConfig
from jaxshape.search.reconstruction import reconstruct, refiner_for
from jaxshape.search.residuals import LESS_FREE, cross_entropy, weigh
from study import SEEN, TUNED, Subject, observed, subjects, together

FRAMES = (1, 4, 8)
SHAPES = ("encoder", *TUNED)
LEADS, TRAILS = "CMA-ES leads", "CMA-ES trails"
POINTS = 21
"""Number of points on the line between two codes, including its ends."""
RIDGE = 0.01
"""Least rise above the higher end, as a share of that end, that counts as a ridge."""

Rows = Mapping[str, Any]


@dataclass(frozen=True)
class Config(iou_by_frames.Config):
    """Settings of the experiment."""

    long: int = 350
    """Iterations of the long searches (paper: 350)."""


def main(config: Config) -> None:
    config = config.reduced(frames=(4,), iterations=2, long=2)
    journal = run(config)
    plot(journal, config)


def run(config: Config) -> Journal:
    """Choose the chairs, search them for long, and write the results."""
    known = {one.name for one in subjects(config.test)}
    searched = iou_by_frames.run(config).rows
    candidates = {name: row for name, row in searched.items() if name in known}
    frames = [k for k in FRAMES if k in config.frames]
    chosen = choose(candidates, frames)
    prior, journal = config.begin(
        "gradient_failures", iterations=config.long, chosen=[one[:3] for one in chosen]
    )
    search_long(chosen, prior, config, journal)
    shares = {str(k): wins(candidates, k) for k in frames}
    journal.write({"summary": {"shares": shares} | summary(journal)})
    return journal


# ------------------------------------------------------------------ which chairs


class Example(NamedTuple):
    """A chair after some number of frames, and why it was chosen."""

    name: str
    frames: int
    kind: str
    lead: float
    """IoU of CMA-ES minus that of plain descent, after short searches."""


def choose(rows: Rows, frames: Sequence[int]) -> list[Example]:
    """The chairs with the largest lead of either sign, by number of frames."""
    chosen = []
    for k in frames:
        lead = leads(rows, k, "gradient descent")
        for kind, pick in ((LEADS, max), (TRAILS, min)):
            name = pick(lead, key=lead.__getitem__)
            chosen.append(Example(name, k, kind, round(lead[name], 4)))
    return chosen


def leads(rows: Rows, frames: int, rival: str) -> dict[str, float]:
    """IoU of CMA-ES minus that of a rival, for each chair."""
    scores = {name: row[str(frames)] for name, row in rows.items()}
    return {name: s["CMA-ES"]["iou"] - s[rival]["iou"] for name, s in scores.items()}


def wins(rows: Rows, frames: int) -> dict[str, dict[str, float]]:
    """Share of the chairs on which CMA-ES has the higher IoU, and its mean and extreme leads."""
    found = {}
    for rival in ("gradient descent", "Adam"):
        lead = np.array([*leads(rows, frames, rival).values()])
        figures = {"share": (lead > 0).mean(), "mean": lead.mean()}
        figures |= {"least": lead.min(), "most": lead.max(), "chairs": len(lead)}
        found[rival] = {name: round(float(x), 4) for name, x in figures.items()}
    return found


# ------------------------------------------------------------------ long searches


class Ends(NamedTuple):
    """End points of searches."""

    code: Float[Array, "case d"]
    objective: Float[Array, " case"]
    iou: Float[Array, " case"]


def search_long(
    chosen: Sequence[Example], prior: ShapePrior, config: Config, journal: Journal
) -> None:
    """Add missing rows of examples: all searches, and all searches from the end of each one."""
    chairs = {one.name: one for one in subjects(config.test)}
    missing = [one for one in chosen if row_name(one) not in journal.rows]
    size = min(2, len(missing))
    analyse = analysis(prior, config)
    for start in track(range(0, len(missing), 2), journal.path.stem, disable=not missing):
        began = time.perf_counter()
        batch = missing[start : start + 2]
        seen = [observe(chairs[one.name], one.frames) for one in batch]
        keys, case = jax.tree.map(lambda *x: fill(jnp.concatenate(x), size), *seen)
        found = jax.device_get(analyse(keys, case))
        rows = {
            row_name(one): one._asdict()
            | {"group": chairs[one.name].group}
            | jax.tree.map(lambda x, i=i: np.round(np.float64(x[i]), 5).tolist(), found)
            for i, one in enumerate(batch)
        }
        journal.add(rows, time.perf_counter() - began)


def row_name(one: Example) -> str:
    return f"{one.name}, {one.frames} frames, {one.kind}"


def observe(chair: Subject, frames: int) -> tuple[Key[Array, " case"], Case]:
    """The key and the case of a chair after the first frames, a batch of one."""
    return together(observed([chair], replace(SEEN, frames=(frames,))), (frames,))


def analysis(prior: ShapePrior, config: Config) -> Callable[..., dict[str, Any]]:
    """A function from the keys and cases of a batch to rows; each search is compiled once."""
    first = searcher("encoder", prior, RefineConfig())
    searches = {
        name: searcher(method, prior, replace(how, iterations=config.long, tolerance=0.0))
        for name, (method, how) in TUNED.items()
    }
    follow = jax.jit(objectives_between)

    def analyse(keys, case):
        begun = first(keys, prior, case, None)
        ended = {name: search(keys, prior, case, begun.code) for name, search in searches.items()}
        again = {
            start: {name: search(keys, prior, case, end.code) for name, search in searches.items()}
            for start, end in ended.items()
        }
        found = {"encoder": begun} | ended
        return {
            "iou": {name: end.iou for name, end in found.items()},
            "objective": {name: end.objective for name, end in found.items()},
            "again": {
                start: {name: end.objective for name, end in ends.items()}
                for start, ends in again.items()
            },
            "line": {
                name: follow(prior, case, begun.code, end.code, ended["CMA-ES"].code)
                for name, end in ended.items()
                if name != "CMA-ES"
            },
            "code": {name: end.code for name, end in found.items()},
        }

    return analyse


def searcher(method: str, prior: ShapePrior, config: RefineConfig) -> Callable[..., Ends]:
    """A compiled search that begins at given codes."""
    refiner = refiner_for(method, prior, config)

    @jax.jit
    def search(keys, prior, case, codes):
        F, M = case.grids.occupied, case.grids.occluded
        found = reconstruct(keys, prior, F, M, refiner, config, earlier=codes)
        return Ends(found.code, found.objective, iou(found.completed, case.surface))

    return search


def objectives_between(
    prior: ShapePrior,
    case: Case,
    first: Float[Array, "case d"],
    a: Float[Array, "case d"],
    b: Float[Array, "case d"],
) -> Float[Array, "case point"]:
    """The objective along the straight line from one code to another."""
    targets = weigh(case.grids, decode(prior, first), LESS_FREE)
    share = jnp.linspace(0, 1, POINTS)[:, None]
    codes = a[:, None] + share * (b - a)[:, None]
    return cross_entropy(decode(prior, codes), jax.tree.map(lambda x: x[:, None], targets))


# ------------------------------------------------------------------ evaluation of the rows


def drop(row: Rows, start: str, search: str) -> float:
    """Share by which `search` lowers the objective from the end of `start`."""
    return 1 - row["again"][start][search] / row["objective"][start]


def ridge(row: Rows, rival: str) -> float:
    """Rise on the line from the rival's end to the end of CMA-ES, as a share of the higher end."""
    line = np.array(row["line"][rival])
    return float(line.max() / max(line[0], line[-1]) - 1)


def summary(journal: Journal) -> dict[str, Any]:
    """The deciding figures of each case, without codes, and of all cases in which one leads."""
    return {
        "cases": {
            name: {
                "iou": row["iou"],
                "objective": row["objective"],
                "falls further": {
                    start: {search: round(drop(row, start, search), 4) for search in TUNED}
                    for start in TUNED
                },
                "ridge": {rival: round(ridge(row, rival), 4) for rival in row["line"]},
            }
            for name, row in journal.rows.items()
        },
        LEADS: leaves(journal, LEADS, "gradient descent", "CMA-ES"),
        TRAILS: leaves(journal, TRAILS, "CMA-ES", "gradient descent"),
    }


def leaves(journal: Journal, kind: str, loser: str, winner: str) -> dict[str, Any]:
    """Has the loser ended in a local minimum that the winner leaves, or was it only slow?

    It is trapped if the winner lowers the objective by more than 1 %, and more than ten times as
    far as the loser. The other numbers are those of the chairs after the long searches.
    """
    rows = [row for row in journal.rows.values() if row["kind"] == kind]
    falls = {name: np.array([drop(row, loser, name) for row in rows]) for name in TUNED}
    trapped = (falls[winner] > 0.01) & (falls[loser] < falls[winner] / 10)
    return {
        "chairs": len(rows),
        "higher IoU": sum(row["iou"][winner] > row["iou"][loser] for row in rows),
        "lower objective": sum(row["objective"][winner] < row["objective"][loser] for row in rows),
        "ridges": sum(ridge(row, "gradient descent") > RIDGE for row in rows),
        "trapped": int(trapped.sum()),
        "falls further": {name: round(float(fall.mean()), 4) for name, fall in falls.items()},
    }


# ------------------------------------------------------------------ figures


def plot(journal: Journal, config: Config) -> None:
    """One figure for the chairs on which CMA-ES leads, one for those on which it trails."""
    prior = load_prior(config.weights)
    for kind, suffix in ((LEADS, ""), (TRAILS, "_opposite")):
        rows = [row for row in journal.rows.values() if row["kind"] == kind]
        pictures = [list(panels(row, prior, config)) for row in rows]

        def draw(figure: Any, rows=rows, pictures=pictures) -> None:
            every = figure.subplots(len(rows), len(pictures[0]), squeeze=False)
            for place, panel in zip(every[0], pictures[0], strict=True):
                place.set_title(panel.title)
            for axes, row, images in zip(every, rows, pictures, strict=True):
                for place, panel in zip(axes, images, strict=True):
                    place.imshow(panel.image, interpolation="antialiased")
                    place.set(xticks=[], yticks=[], xlabel=panel.note)
                    place.spines[:].set_visible(False)
                frames = "1 frame" if row["frames"] == 1 else f"{row['frames']} frames"
                axes[0].set_ylabel(frames)

        stem = config.results / f"gradient_failures{suffix}"
        save_column(stem, draw, height=0.3 + 1.3 * len(rows), width=PAGE)


def panels(row: Rows, prior: ShapePrior, config: Config) -> Iterator[Any]:
    """Truth, F and every search's shape, its IoU below."""
    chair = next(one for one in subjects(config.test) if one.name == row["name"])
    _, case = observe(chair, row["frames"])
    (occupied, occluded, _), surface = jax.tree.map(lambda x: np.asarray(x[0]), case)
    codes = jnp.array([row["code"][name] for name in SHAPES])
    shapes = np.asarray(decode(prior, codes) > 0)
    yield grid_panel("truth", surface, "truth", note=row["group"])
    yield measurement_panel("F", occupied, occluded, note=" ")
    for name, shape in zip(SHAPES, shapes, strict=True):
        title = "descent" if name == "gradient descent" else name
        yield grid_panel(title, shape, "predicted", note=f"{row['iou'][name]:.3f}")


if __name__ == "__main__":
    main(tyro.cli(Config))
