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
from pathlib import Path
from string import Template
from typing import Any

from jaxshape.files import write_text
from jaxshape.report import illustrations, tables
from jaxshape.report.illustrations import Picture
from jaxshape.report.paint import paints
from jaxshape.report.palette import LAYERS
from jaxshape.results.folder import ResultFolder, read_folder
from jaxshape.results.summary import headline, tracked, warnings_of

KEYFRAMES_TO_SHOW = 12


def write_report(folder: str | os.PathLike[str]) -> Path:
    """Write `report.html` into a result folder, from the files of the folder. [host]

    Sections without files are left out, and unreadable files are named among the warnings. All text
    that comes from the folder is escaped.

    Args:
        folder: Folder of a result, from `jaxshape demo`, `jaxshape reconstruct` or `jaxshape
            scene`, finished or not.

    Returns:
        The path of the page.

    Raises:
        ValueError: The folder does not exist.
    """
    found = read_folder(folder)
    scene = illustrations.scene(found)
    sections = [
        _warnings(found),
        tables.objects(found),
        _shape(found, scene),
        _grids(found),
        _keyframes(found),
        _convergence(Path(folder)),
        tables.frame_strip(found),
        tables.all_figures(found),
    ]
    page = filled_page(
        kind="jaxshape report" + (" · still running" if found.result.get("running") else ""),
        title=str(found.result.get("object", found.name)),
        subtitle=_subtitle(found),
        figures=headline(found),
        body="\n".join(filter(None, sections)),
        scene=scene,
        script=_beside("page.js"),
    )
    target = Path(folder) / "report.html"
    write_text(target, page)
    return target


def filled_page(
    *,
    kind: str,
    title: str,
    subtitle: str,
    figures: Iterable[tuple[str, str, str]],
    body: str,
    scene: Any = None,
    script: str = "",
) -> str:
    """A page that needs no network; texts are escaped here, the body is HTML.

    Args:
        kind: Kind of the page, in small print.
        title: Title of the page.
        subtitle: A line below the title.
        figures: Name, value and meaning of each figure at the top of the page.
        body: Sections of the page, as HTML.
        scene: Data of the script, as JSON can hold it.
        script: The page's own script; no other script may run.
    """
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return Template(_beside("page.html")).substitute(
        kind=escape(kind),
        title=escape(title),
        subtitle=escape(subtitle),
        figures=_figures(figures),
        body=body,
        # In a script element, only this could end the data early.
        scene=json.dumps(scene).replace("<", "\\u003c"),
        script=script,
        script_hash=f"sha256-{digest}",
    )


def _beside(name: str) -> str:
    return Path(__file__).with_name(name).read_text(encoding="utf-8")


# ------------------------------------------------------------------ the headline


def _subtitle(found: ResultFolder) -> str:
    named = {"method": "searched by {}", "seed": "seed {}"}
    known = [text.format(found.result[key]) for key, text in named.items() if key in found.result]
    return " · ".join([f"folder {found.name}", *known])


def _figures(figures: Iterable[tuple[str, str, str]]) -> str:
    return "\n".join(
        f"<div><dt>{escape(name)}</dt><dd><b>{escape(value)}</b>"
        f"<small>{escape(meaning)}</small></dd></div>"
        for name, value, meaning in figures
    )


def _warnings(found: ResultFolder) -> str:
    lines = "".join(f"<li>{escape(text)}</li>" for text in warnings_of(found))
    return f'<section class="warnings"><h2>Warnings</h2><ul>{lines}</ul></section>' if lines else ""


# ------------------------------------------------------------------ pictures


def _shape(found: ResultFolder, scene: dict[str, Any]) -> str:
    """The shape in 3D, with a checkbox for each layer, over a picture for use without WebGL."""
    if not scene["layers"]:
        return ""
    boxes = "".join(
        f'<label><input type="checkbox" data-layer="{name}"{" checked" * layer["shown"]}> '
        f'<i style="background:{layer["color"]}"></i> {LAYERS[name].label}</label>'
        for layer in scene["layers"]
        for name in [layer["name"]]
    )
    choices = "".join(
        f'<option value="{name}">{escape(paint.label)}</option>'
        for name, paint in paints(found).items()
    )
    paint = f'<label>mesh in <select id="paint">{choices}</select></label>' if choices else ""
    views = {"oblique": "35 25", "front": "0 0", "side": "90 0", "back": "180 0", "top": "0 89"}
    buttons = "".join(f'<button data-view="{at}">{name}</button>' for name, at in views.items())
    picture = illustrations.still(found)
    still = _img(picture) if picture else ""
    return f"""<section><h2>The shape</h2>
<div id="shape">{still}<canvas id="turnable" tabindex="0" role="img"
aria-label="The shape in 3D; arrow keys turn it, plus and minus zoom"></canvas></div>
<div class="controls">{boxes}{paint}</div><div class="controls">{buttons}</div>
<p class="soft hands">Drag to turn, Shift-drag or two fingers to shift, wheel (once clicked) or
pinch to zoom.</p></section>"""


def _grids(found: ResultFolder) -> str:
    pictures = illustrations.grids(found)
    figures = "".join(_figure([picture], picture.title, picture.note) for picture in pictures)
    about = (
        "F holds the measured voxels, M the voxels hidden behind them. The composed grid is F "
        "outside M, and the refined shape inside M."
    )
    return (
        f'<section><h2>Grids</h2><p class="soft">{about}</p>'
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
    about = "Colour with the outline of the segmented object, and depth; near surfaces are dark."
    some = f" {shown} of {count} are pictured." if shown < count else ""
    return (
        f'<section><h2>Keyframes</h2><p class="soft">{about}{some}</p>'
        f'<div class="pictures">{figures}</div></section>{tables.keyframe_table(found.keyframes)}'
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
