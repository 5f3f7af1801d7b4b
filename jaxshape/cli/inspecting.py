"""`jaxshape inspect`: the content of a recording and its possible faults."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from rich.console import Console
from rich.markup import escape
from rich.table import Table
from tyro.conf import Positional

LayoutName = Literal[
    "7-scenes",
    "tum",
    "nerfstudio",
    "bop",
    "wildrgb-d",
    "stray-scanner",
    "record3d",
    "scannet",
    "replica",
    "icl-nuim",
    "realsense",
    "npz",
    "redwood",
    "bundlesdf",
    "open3d",
]
"""Names of `jaxshape.data.sequences.LAYOUTS`."""

ConventionName = Literal[
    "as-given",
    "wxyz",
    "transposed",
    "centimetres",
    "millimetres",
    "inverted",
    "opengl",
    "mirrored",
    "ray",
]
"""Names of `jaxshape.data.sequences.conventions`, and the name for our own convention."""


@dataclass(frozen=True)
class Inspect:
    """Describe a recording, and warn of possible faults, with evidence and a remedy for each.

    Example: jaxshape inspect scan/
    """

    frames: Positional[Path]
    """Folder of the recording: 7-Scenes, TUM RGB-D, ScanNet, BOP, WildRGB-D, Redwood, Replica,
    ICL-NUIM, Open3D, Stray Scanner, Record3D, nerfstudio, or rgb/ depth/ masks/ with cam_K.txt; or
    an .npz file of arrays."""
    depth_scale: float | None = None
    """Depth units per metre, above 0; by default that of the layout."""
    layout: LayoutName | None = None
    """Layout of the files; detected by default."""
    convention: tuple[ConventionName, ...] = ()
    """Conventions in which the recording is written; detected by default."""
    json: bool = False
    """Print one JSON object instead of a table."""

    def run(self) -> None:
        from jaxshape.data.sequences import open_sequence
        from jaxshape.data.sequences.inspection import inspect_sequence

        sequence = open_sequence(self.frames, depth_scale=self.depth_scale, layout=self.layout)
        stated, keep_scale = self.convention or None, self.depth_scale is not None
        found = inspect_sequence(sequence, stated, keep_scale=keep_scale)
        if self.json:
            print(json.dumps(as_json(found), indent=1))
        else:
            print_table(str(self.frames), found)


def as_json(found: Any) -> dict[str, Any]:
    """All figures of an `Inspection`; lengths in metres, times in seconds."""
    from jaxshape.data.sequences.cameras import intrinsic_numbers

    sequence, times = found.sequence, found.sequence.times
    return {
        "layout": sequence.layout,
        "frames": len(sequence),
        "first": sequence.names[0],
        "last": sequence.names[-1],
        "height": sequence.shape[0],
        "width": sequence.shape[1],
        "intrinsics": dict(
            zip(("fx", "fy", "cx", "cy"), intrinsic_numbers(sequence.intrinsics), strict=True)
        ),
        "camera": sequence.camera,
        "depth_scale": sequence.depth_scale,
        "depth": found.depths._asdict(),
        "poses": None if found.poses is None else _pose_figures(found.poses),
        "colors": found.colors,
        "masks": found.masks,
        "duration": None if times is None else float(times[-1] - times[0]),
        "rate": found.rate,
        "color_delay": _color_delay(sequence),
        "gaps": [gap._asdict() for gap in found.gaps],
        "warnings": [warning._asdict() for warning in found.warnings],
    }


def _pose_figures(poses: Any) -> dict[str, Any]:
    reading = poses.reading
    found = None
    if reading.best is not None:
        found = asdict(reading.best.convention) | {"share": reading.best.share}
        found |= {"used": poses.is_used}
    return {
        "known": poses.known,
        "length": poses.length,
        "agreement": poses.agreement,
        "agreement_as_written": reading.given,
        "pairs": reading.pairs,
        "convention": found,
        "damaged": poses.damaged,
    }


def _color_delay(sequence: Any) -> dict[str, float] | None:
    """Delay between depth images and their colour images, in seconds: median and maximum."""
    import numpy as np

    delays = () if sequence.color_delays is None else np.abs(sequence.color_delays)
    known = [delay for delay in delays if np.isfinite(delay)]
    return {"median": float(np.median(known)), "max": float(max(known))} if known else None


def print_table(title: str, found: Any) -> None:
    """The figures as a table, then each warning as a sentence with a remedy."""
    console = Console()
    table = Table(title=escape(title), show_header=False, title_justify="left")
    for row in _rows(as_json(found)):
        table.add_row(*map(escape, row))
    console.print(table)
    for warning in found.warnings:
        console.print(f"[yellow]warning[/] {escape(warning.sentence)}", soft_wrap=True)


def _rows(figures: dict[str, Any]) -> list[tuple[str, str]]:
    count, depth, pixels = figures["frames"], figures["depth"], figures["intrinsics"]
    size = f"{figures['width']} x {figures['height']}"
    return [
        ("layout", figures["layout"]),
        ("frames", f"{count}, {figures['first']} to {figures['last']}, {size} pixels"),
        ("time", _time_row(figures)),
        ("gaps", _gap_row(figures["gaps"])),
        ("camera", f"{_named(pixels)} ({figures['camera']})"),
        (
            "depth",
            f"{figures['depth_scale']:g} units a metre: median {depth['median']:.2f} m; "
            f"{depth['invalid']:.0%} invalid, {depth['saturated']:.0%} saturated "
            f"({depth['sampled']} frames read)",
        ),
        ("poses", _pose_row(figures["poses"], count)),
        ("colour", _color_row(figures, count)),
        ("masks", f"{figures['masks']} of {count} frames" if figures["masks"] else "none"),
    ]


def _named(numbers: dict[str, float]) -> str:
    return ", ".join(f"{name} {value:.1f}" for name, value in numbers.items())


def _time_row(figures: dict[str, Any]) -> str:
    if figures["duration"] is None:
        return "not given"
    rate = f", {figures['rate']:.1f} frames a second" if figures["rate"] else ""
    return f"{figures['duration']:.1f} s{rate}"


def _gap_row(gaps: list[dict[str, Any]]) -> str:
    shown = [f"{gap['missing']} after {gap['after']}" for gap in gaps[:3]]
    more = [f"and {len(gaps) - 3} more"] if len(gaps) > 3 else []
    return ", ".join(shown + more) or "none"


def _pose_row(poses: dict[str, Any] | None, count: int) -> str:
    if poses is None:
        return "none: the camera has to be tracked"
    row = f"{poses['known']} of {count} frames, a path of {poses['length']:.2f} m; "
    if not poses["pairs"]:
        return row + "too little motion to tell whether they fit"
    row += f"{poses['agreement']:.0%} of the pixels of {poses['pairs']} pairs of frames agree"
    if poses["convention"] is not None and poses["convention"]["used"]:
        row += f", {poses['agreement_as_written']:.0%} as written"
    return row


def _color_row(figures: dict[str, Any], count: int) -> str:
    if not figures["colors"]:
        return "none"
    row, delay = f"{figures['colors']} of {count} frames", figures["color_delay"]
    if delay is None:
        return row
    return f"{row}, {delay['median'] * 1e3:.0f} ms from depth, {delay['max'] * 1e3:.0f} at most"
