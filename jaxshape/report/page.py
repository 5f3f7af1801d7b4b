"""`report.html`: a whole result on one page that needs no network and no other file. [host]

The page turns the shape with some 300 lines of WebGL of its own (page.js, 11 kB). The three.js in
trimesh's notebook viewer is 700 kB of minified script from 2022, and has no layers to switch.
"""

import base64
import hashlib
import json
import os
from collections.abc import Iterable, Sequence
from html import escape
from itertools import groupby
from pathlib import Path
from string import Template
from typing import Any

from jaxshape.files import atomic_path
from jaxshape.report import illustrations
from jaxshape.report.illustrations import Picture
from jaxshape.results.folder import LAYERS, Keyframe, ResultFolder, read_folder
from jaxshape.results.summary import headline, number, tracked, warnings_of

KEYFRAMES_TO_SHOW = 12

STATUS_COLORS = {
    "keyframe": "#0072B2",
    "tracked": "#56B4E9",
    "lost": "#D55E00",
    "unreadable": "#CC79A7",
    "skipped": "#B4BBC2",
}
"""In the palette of Okabe and Ito, as all pictures."""


def write_report(folder: str | os.PathLike[str]) -> Path:
    """Write `report.html` of a result folder into it, from what the folder holds; returns its path.

    Sections of what is missing are left out, and files that cannot be read are named among the
    warnings. All text that comes from the folder is escaped. `ValueError` for no folder.
    """
    found = read_folder(folder)
    script = _beside("page.js")
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    scene = illustrations.scene(found)
    sections = [
        _warnings(found),
        _shape(found, scene),
        _grids(found),
        _keyframes(found),
        _convergence(Path(folder)),
        _frames(found),
        _all_figures(found),
    ]
    page = Template(_beside("page.html")).substitute(
        title=escape(str(found.result.get("object", found.name))),
        subtitle=escape(_subtitle(found)),
        running=" · still running" if found.result.get("running") else "",
        figures=_headline(found),
        body="\n".join(filter(None, sections)),
        # In a script element, only this could end the data early.
        scene=json.dumps(scene).replace("<", "\\u003c"),
        script=script,
        script_hash=f"sha256-{digest}",  # nothing else may run
    )
    target = Path(folder) / "report.html"
    with atomic_path(target) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return target


def _beside(name: str) -> str:
    return Path(__file__).with_name(name).read_text(encoding="utf-8")


# ------------------------------------------------------------------ what it comes to


def _subtitle(found: ResultFolder) -> str:
    named = {"method": "searched by {}", "seed": "seed {}"}
    told = [text.format(found.result[key]) for key, text in named.items() if key in found.result]
    return " · ".join([f"folder {found.name}", *told])


def _headline(found: ResultFolder) -> str:
    return "\n".join(
        f"<div><dt>{escape(name)}</dt><dd><b>{escape(value)}</b>"
        f"<small>{escape(meaning)}</small></dd></div>"
        for name, value, meaning in headline(found)
    )


def _warnings(found: ResultFolder) -> str:
    lines = "".join(f"<li>{escape(text)}</li>" for text in warnings_of(found))
    return f'<section class="warnings"><h2>Warnings</h2><ul>{lines}</ul></section>' if lines else ""


# ------------------------------------------------------------------ pictures


def _shape(found: ResultFolder, scene: dict[str, Any]) -> str:
    """The shape to turn, with a box for each layer, over a picture for where WebGL is missing."""
    if not scene["layers"]:
        return ""
    boxes = "".join(
        f'<label><input type="checkbox" data-layer="{name}"{" checked" * layer["shown"]}> '
        f'<i style="background:{layer["color"]}"></i> {LAYERS[name].label}</label>'
        for layer in scene["layers"]
        for name in [layer["name"]]
    )
    views = {"oblique": "35 25", "front": "0 0", "side": "90 0", "back": "180 0", "top": "0 89"}
    buttons = "".join(f'<button data-view="{at}">{name}</button>' for name, at in views.items())
    picture = illustrations.still(found)
    still = _img(picture) if picture else ""
    return f"""<section><h2>The shape</h2>
<div id="shape">{still}<canvas id="turnable" tabindex="0" role="img"
aria-label="The shape in 3D; arrow keys turn it, plus and minus zoom"></canvas></div>
<div class="controls">{boxes}</div><div class="controls">{buttons}</div>
<p class="soft hands">Drag to turn, Shift-drag or two fingers to shift, wheel (once clicked) or
pinch to zoom.</p></section>"""


def _grids(found: ResultFolder) -> str:
    pictures = illustrations.grids(found)
    figures = "".join(_figure([picture], picture.title, picture.note) for picture in pictures)
    about = "F is what was measured, M what is hidden behind it; composed is F, and inside M the "
    return (
        f'<section><h2>Grids</h2><p class="soft">{about}refined shape.</p>'
        f'<div class="pictures">{figures}</div></section>'
        if pictures
        else ""
    )


def _keyframes(found: ResultFolder) -> str:
    if not found.keyframes:
        return ""
    count = len(found.keyframes)
    shown = min(count, KEYFRAMES_TO_SHOW)
    chosen = [found.keyframes[round(i * (count - 1) / max(1, shown - 1))] for i in range(shown)]
    pictured = zip(chosen, illustrations.keyframes(chosen), strict=True)
    figures = "".join(_figure(p, k.name, tracked(k)) for k, p in pictured)
    about = "Colour with the outline of what was taken for the object, and depth, near dark."
    some = f" {shown} of {count} are pictured." if shown < count else ""
    return (
        f'<section><h2>Keyframes</h2><p class="soft">{about}{some}</p>'
        f'<div class="pictures">{figures}</div></section>{_keyframe_table(found.keyframes)}'
    )


def _convergence(folder: Path) -> str:
    picture = illustrations.convergence(folder)
    plot = f'<figure class="wide">{_img(picture)}</figure>' if picture else ""
    return f"<section><h2>The last search</h2>{plot}</section>" if picture else ""


def _figure(pictures: Sequence[Picture], title: str, note: str) -> str:
    shown = "".join(map(_img, pictures))
    return f"<figure>{shown}<figcaption><b>{escape(title)}</b> {escape(note)}</figcaption></figure>"


def _img(picture: Picture) -> str:
    return f'<img src="{picture.uri}" alt="{escape(picture.description)}">'


# ------------------------------------------------------------------ tables


def _keyframe_table(keyframes: Sequence[Keyframe]) -> str:
    heading = ("keyframe", "inliers, %", "rmse, mm", "conditioning", "objective", "IoU")
    steps = ("track", "fuse", "refine")
    rows = []
    for keyframe in keyframes:
        of, seconds = keyframe.figures, keyframe.figures.get("seconds")
        seconds = seconds if isinstance(seconds, dict) else {}
        rows.append(
            (
                escape(keyframe.name),
                number(of.get("inlier_fraction"), 0, times=100.0),
                number(of.get("rmse"), 1, times=1000.0),
                number(of.get("conditioning"), 1),
                number(of.get("objective"), 4),
                number(of.get("iou"), 3),
                *(number(seconds.get(step), 2) for step in steps),
            )
        )
    table = _table((*heading, *(f"{step}, s" for step in steps)), rows)
    return (
        f"<section><details><summary>Figures of each keyframe</summary>{table}</details></section>"
    )


def _frames(found: ResultFolder) -> str:
    """A strip with a colour for each frame, and the runs of frames that fared alike."""
    if not found.frames:
        return ""
    fared = lambda frame: (str(frame.get("status")), str(frame.get("reason") or ""))  # noqa: E731
    runs, rows, start = [], [], 0
    for (status, reason), run in groupby(found.frames, fared):
        names = [str(frame.get("name", frame.get("index"))) for frame in run]
        color = STATUS_COLORS.get(status, "#999999")
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
    table = _table(("frames", "number", "status", "reason"), rows)
    return f"""<section><h2>Frames of the recording</h2>
<svg class="strip" role="img" aria-label="Status of each frame, in the order of the recording"
viewBox="0 0 {start} 1" preserveAspectRatio="none">{"".join(runs)}</svg>
<p class="controls soft">{legend}</p>
<details><summary>All {start} frames, with reasons</summary>{table}</details></section>"""


def _all_figures(found: ResultFolder) -> str:
    def flat(prefix: str, value: Any) -> Iterable[tuple[str, str]]:
        if isinstance(value, dict):
            for key, inner in value.items():
                yield from flat(f"{prefix}{key}.", inner)
        else:
            yield escape(prefix[:-1]), escape(json.dumps(value))

    rows = list(flat("", found.result))
    return _folded("All of result.json", _table(("figure", "value"), rows)) if rows else ""


def _folded(summary: str, content: str) -> str:
    return f"<section><details><summary>{summary}</summary>{content}</details></section>"


def _table(heading: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table of cells that are escaped already."""
    head = "".join(f"<th>{name}</th>" for name in heading)
    body = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
    table = f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
    return f'<div class="scroll">{table}</div>'
