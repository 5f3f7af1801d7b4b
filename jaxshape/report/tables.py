"""The tables of a report: keyframes, frames, and all of result.json, as HTML."""

import json
from collections.abc import Iterable, Sequence
from html import escape
from itertools import groupby
from typing import Any, NamedTuple

from jaxshape.report.palette import GREY, STATUS_COLORS
from jaxshape.results.folder import KeyframeRecord, ResultFolder, entries_of_objects
from jaxshape.results.summary import entries, number


class Column(NamedTuple):
    """A column of the keyframe table.

    Attributes:
        heading: Text at its top, with the unit.
        figure: Key of the figure in keyframes.json.
        digits: Decimals to show.
        times: Factor from the unit of the file to the unit of the heading.
    """

    heading: str
    figure: str
    digits: int = 2
    times: float = 1.0


COLUMNS = (
    Column("object pixels", "object_pixels", 0),
    Column("inliers, %", "inlier_fraction", 0, times=100.0),
    Column("overlap, %", "overlap", 0, times=100.0),
    Column("rmse, mm", "rmse", 1, times=1000.0),
    Column("conditioning", "conditioning", 4),
    *(Column(f"{part}, s", f"seconds_{part}")
      for part in ("track", "cut", "fuse", "refine", "realign")),
)  # fmt: skip

ABOUT_COLUMNS = (
    "Overlap is the share of the keyframe’s points that the map should show from there; inliers "
    "are the share of these points that agree with the map, and rmse is the root mean square of "
    "their distances. Conditioning is the ratio of the smallest to the largest eigenvalue of the "
    "alignment’s normal equations; 0 means that some motion is unconstrained. The last columns are "
    "the seconds that each step took. A cell is empty if the pose was not tracked, or if the step "
    "was not run."
)


def keyframe_table(keyframes: Sequence[KeyframeRecord]) -> str:
    """A table of the figures of each keyframe; columns without any figure are left out."""
    cells = {
        column.heading: [
            number(k.figures.get(column.figure), column.digits, times=column.times)
            for k in keyframes
        ]
        for column in COLUMNS
    }
    known = {heading: values for heading, values in cells.items() if any(values)}
    names = [escape(keyframe.name) for keyframe in keyframes]
    table = html_table(("keyframe", *known), zip(names, *known.values(), strict=True))
    about = f'<p class="soft">{ABOUT_COLUMNS}</p>'
    return _folded("Figures of each keyframe", about + table)


def objects(found: ResultFolder) -> str:
    """The objects of a scene, and their history while it was filmed."""
    if "objects" not in found.result:
        return ""
    rows = map(_object_row, entries_of_objects(found.result))
    heading = ("object", "class", "sure", "width × height × depth", "verdict")
    events = "".join(
        f"<li>{escape(str(event))}</li>" for event in entries(found.result.get("events"))
    )
    about = (
        '<p class="soft">An object of no class is kept as it was measured; nothing is added to '
        "it.</p>"
    )
    story = f"<details><summary>What was found, and when</summary><ol>{events}</ol></details>"
    return f"<section><h2>Objects</h2>{about}{html_table(heading, rows)}{story}</section>"


def _object_row(one: dict[str, Any]) -> tuple[str, ...]:
    reasons = "; ".join(map(str, entries(one.get("verdict_reasons"))))
    extents = " × ".join(number(x, 2) for x in entries(one.get("size")))
    verdict = f"{one.get('verdict') or ''}{': ' if reasons else ''}{reasons}"
    cells = (
        str(one.get("name", "")),
        str(one.get("class") or "none"),
        number(one.get("sure"), times=100.0, unit=" %"),
        f"{extents} m" if extents else "",
        verdict,
    )
    return tuple(map(escape, cells))


def frame_strip(found: ResultFolder) -> str:
    """A strip with a colour for each frame, and the runs of frames with the same outcome."""
    if not found.frames:
        return ""
    fared = lambda frame: (str(frame.get("status")), str(frame.get("reason") or ""))  # noqa: E731
    runs, rows, start = [], [], 0
    for (status, reason), run in groupby(found.frames, fared):
        names = [str(frame.get("name", frame.get("index"))) for frame in run]
        color = STATUS_COLORS.get(status, GREY)
        runs.append(
            f'<rect x="{start}" y="0" width="{len(names)}" height="1" fill="{color}">'
            f"<title>{escape(names[0])}: {escape(status)}</title></rect>"
        )
        extent = names[0] if len(names) == 1 else f"{names[0]} to {names[-1]}"
        rows.append((escape(extent), str(len(names)), escape(status), escape(reason)))
        start += len(names)
    present = {status for _, _, status, _ in rows}
    legend = "".join(
        f'<span><i style="background:{color}"></i> {status}</span>'
        for status, color in STATUS_COLORS.items()
        if status in present
    )
    table = html_table(("frames", "number", "status", "reason"), rows)
    return f"""<section><h2>Frames of the recording</h2>
<svg class="strip" role="img" aria-label="Status of each frame, in the order of the recording"
viewBox="0 0 {start} 1" preserveAspectRatio="none">{"".join(runs)}</svg>
<p class="controls soft">{legend}</p>
<details><summary>All {start} frames, with reasons</summary>{table}</details></section>"""


def all_figures(found: ResultFolder) -> str:
    def flat(prefix: str, value: Any) -> Iterable[tuple[str, str]]:
        if isinstance(value, dict):
            for key, inner in value.items():
                yield from flat(f"{prefix}{key}.", inner)
        else:
            yield escape(prefix[:-1]), escape(json.dumps(value))

    rows = list(flat("", found.result))
    return _folded("All of result.json", html_table(("figure", "value"), rows)) if rows else ""


def _folded(summary: str, content: str) -> str:
    return f"<section><details><summary>{summary}</summary>{content}</details></section>"


def html_table(
    heading: Sequence[str], rows: Iterable[Sequence[str]], numbers: Sequence[int] = ()
) -> str:
    """A table of cells that are escaped already; columns of `numbers` are set flush right."""
    right = lambda i: ' class="number"' if i in numbers else ""  # noqa: E731
    head = "".join(f"<th{right(i)}>{name}</th>" for i, name in enumerate(heading))
    body = "".join(
        "<tr>" + "".join(f"<td{right(i)}>{cell}</td>" for i, cell in enumerate(row)) + "</tr>"
        for row in rows
    )
    table = f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
    return f'<div class="scroll">{table}</div>'
