"""The board: entries compared in a table, a picture and one page that needs no network. [host]"""

import base64
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from jaxshape.bench.config import BUDGETS, LADDER, SECONDS
from jaxshape.bench.problem_set import ProblemSet
from jaxshape.bench.standings import (
    ABOUT,
    COLUMNS,
    Standing,
    conditions,
    headings,
    markdown,
    table,
)
from jaxshape.files import write_text
from jaxshape.report.figures import save_figure, tidy
from jaxshape.report.page import filled_page
from jaxshape.report.palette import CYCLE, GREY
from jaxshape.report.tables import html_table

DASHES = ((), (4, 1.5), (1, 1), (6, 1.5, 1, 1.5))


def write_board(folder: Path, found: Sequence[Standing], problem_set: ProblemSet) -> None:
    """Write `board.md`, `board.png` and `board.html`.

    Args:
        folder: Folder to write into.
        found: The standings, the best first.
        problem_set: The set of problems.
    """
    count, total = len(found[0].calls), len(problem_set.keys())
    title = f"{problem_set.name}: {count} of {total} problems"
    said = "\n\n".join([ABOUT, *conditions(found)])
    write_text(folder / "board.md", f"# {title}\n\n{markdown(found)}\n\n{said}\n")
    draw(folder / "board.png", found)
    write_text(folder / "board.html", _page(title, found, folder / "board.png"))


# ------------------------------------------------------------------ the picture


def draw(path: Path, found: Sequence[Standing]) -> None:
    """Draw shares of targets against decoder calls and seconds, and IoU against the objective.

    Args:
        path: The picture, `.png` or `.svg`.
        found: The standings, the best first.
    """

    def draw(figure: Any) -> None:
        by_calls, by_seconds, by_gap = figure.subplots(1, 3)
        for i, one in enumerate(found):
            style = {
                "color": CYCLE[i % len(CYCLE)],
                "dashes": DASHES[i // len(CYCLE) % len(DASHES)],
            }
            style |= {"linewidth": 1.6}
            _shares(by_calls, one.calls, float(one.budget), label=one.name, **style)
            _shares(by_seconds, one.seconds, _end(found), **style)
            gap, gain = one.gap.mean(axis=0), (one.iou - one.iou[:, :1]).mean(axis=0)
            by_gap.plot(gap, gain, marker=".", markersize=3.5, **style)
        by_calls.set(xlabel="decoder calls", ylabel="targets reached", xlim=(3, LADDER[-1]))
        by_seconds.set(xlabel="seconds per shape")
        by_gap.set(xlabel="share of the objective's gap left", ylabel="IoU over the first code's")
        by_gap.invert_xaxis()
        for calls in BUDGETS:
            by_calls.axvline(calls, color=GREY, linewidth=0.6, dashes=(1, 2))
        by_seconds.axvline(SECONDS, color=GREY, linewidth=0.6, dashes=(1, 2))
        for axes in (by_calls, by_seconds, by_gap):
            tidy(axes)
        for axes in (by_calls, by_seconds):
            axes.set(xscale="log", ylim=(0, 1.02))
            axes.xaxis.set_major_formatter("{x:g}")
        ticks = [LADDER[1], BUDGETS[0] // 4, *BUDGETS]
        by_calls.set_xticks(ticks, [str(calls) for calls in ticks])
        by_calls.minorticks_off()
        figure.legend(loc="outside lower center", ncols=4, frameon=False)

    rows = -(-len(found) // 4)
    save_figure(path, (10.5, 3.6 + 0.2 * rows), draw, font=9.0)


def _shares(axes: Any, reached: np.ndarray, end: float, **style: Any) -> None:
    """Plot the share of targets that were reached, with a step at each time of a reached target."""
    times = np.sort(reached[np.isfinite(reached)])
    shares = np.arange(1, len(times) + 1) / reached.size
    times, shares = np.append(times, max([end, *times[-1:]])), np.append(shares, [0, *shares][-1])
    axes.step(times, shares, where="post", **style)


def _end(found: Sequence[Standing]) -> float:
    """The latest time at which any target was reached."""
    times = np.concatenate([one.seconds.ravel() for one in found])
    return float(times[np.isfinite(times)].max(initial=SECONDS))


# ------------------------------------------------------------------ the page


def _page(title: str, found: Sequence[Standing], picture: Path) -> str:
    data = base64.b64encode(picture.read_bytes()).decode()
    numbers = tuple(range(1, len(COLUMNS) - 1))
    body = [
        f"<section><h2>The board</h2>{_paragraphs([ABOUT])}",
        html_table(
            headings("<br>"), [[escape(cell) for cell in row] for row in table(found)], numbers
        ),
        "</section><section><h2>Against decoder calls, seconds and the objective</h2>"
        f'<figure><img src="data:image/png;base64,{data}" alt="Shares of targets reached against'
        ' decoder calls and against seconds, and IoU against the objective"></figure></section>',
        f"<section><h2>Where</h2>{_paragraphs(conditions(found))}</section>",
        *map(_details, found),
    ]
    best = found[0]
    figures = [
        ("entries", str(len(found)), "methods compared"),
        ("problems", str(len(best.calls)), "of which all have results"),
        ("first", best.name, f"{best.share(BUDGETS[0]):.0%} of the targets in {BUDGETS[0]} calls"),
    ]
    about = "Searches over the codes of one shape prior, on the same problems."
    return filled_page(
        kind="jaxshape bench", title=title, subtitle=about, figures=figures, body="\n".join(body)
    )


def _paragraphs(sentences: Sequence[str]) -> str:
    return "".join(f'<p class="soft">{escape(text)}</p>' for text in sentences)


def _details(one: Standing) -> str:
    """The settings of an entry, and the result of each of its problems."""
    about = one.entry.about
    settings = ", ".join(f"{k} {v}" for k, v in about["settings"].items())
    rows = [
        [escape(name), str(row["calls"]), f"{row['seconds']:.3g}", escape(str(row["stop"])),
         f"{row['objective'][0]:.5f}", f"{row['objective'][-1]:.5f}",
         f"{row['iou'][0]:.3f}", f"{row['iou'][-1]:.3f}"]
        for name, row in one.entry.rows.items()
    ]  # fmt: skip
    head = ("problem", "calls", "s", "stopped by", "first", "objective", "first", "IoU")
    results = html_table(head, rows, (1, 2, 4, 5, 6, 7))
    return (
        f"<section><details><summary>{escape(one.name)}</summary>"
        f'<p class="soft">{escape(settings)}; budget {about["budget"]}, seed {about["seed"]}</p>'
        f"{results}</details></section>"
    )
