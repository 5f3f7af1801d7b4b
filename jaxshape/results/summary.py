"""A result in words and in figures with units, for the report and the viewer. [host]"""

import math
from collections import Counter
from collections.abc import Iterator
from typing import Any, NamedTuple

from jaxshape.results.folder import KeyframeRecord, ResultFolder, entries_of_objects


class Figure(NamedTuple):
    """A figure of a result, in words.

    Attributes:
        name: Name of the figure.
        value: Value of the figure, with a unit.
        meaning: Meaning of the value, in words.
    """

    name: str
    value: str
    meaning: str


def headline(found: ResultFolder) -> Iterator[Figure]:
    """The figures that matter most, as far as they are known."""
    result, counts = found.result, _counts(found)
    yield from _judgement(result)
    if found.frames:
        others = [f"{n} {status}" for status, n in counts.items() if status != "keyframe"]
        value = f"{counts['keyframe']} of {len(found.frames)}"
        yield Figure("Frames fused", value, ", ".join(others) or "all of the recording")
    elif "frames" in result:
        yield Figure("Frames fused", number(result["frames"]), "depth frames")
    if "objective_refined" in result:
        before, after = (number(result.get(f"objective_{n}"), 4) for n in ("encoder", "refined"))
        meaning = (
            "disagreement of the shape with the measurement before and after the search, in nats "
            f"per voxel of the whole grid ({_minimised(result)}); lower is better. Compare it only "
            "between searches on the same frames"
        )
        yield Figure("Objective", f"{before} → {after}", meaning)
    if "mesh_measured" in result:
        value = number(result["mesh_measured"], 0, times=100.0, unit=" %")
        left_out = number(result.get("mesh_pieces_dropped"))
        meaning = (
            "of the mesh’s area is surface that the camera measured; the prior predicts the rest. "
            f"Loose pieces left out: {left_out}"
        )
        yield Figure("Measured", value, meaning)
    if "iou_composed" in result:
        before, after = (number(result.get(f"iou_{n}"), 3) for n in ("encoder", "refined"))
        meaning = (
            f"of the composed shape (encoder {before}, refined {after}): number of surface "
            "voxels in both shapes, divided by the number in either; 1 is perfect"
        )
        yield Figure("IoU with the truth", number(result["iou_composed"], 3), meaning)
    if "seconds" in result:
        yield Figure("Time", number(result["seconds"], 1, unit=" s"), "from start to result")


def verdict_in_words(result: dict[str, Any]) -> str:
    """The verdict of a result as a sentence, with the object's size; empty without one."""
    if "verdict" not in result:
        return ""
    reasons = "; ".join(map(str, entries(result.get("verdict_reasons"))))
    because = f" because {reasons}" if reasons else ""
    return f"verdict: {result['verdict']}{because}. The object is {_size(result)}."


def objects_in_words(result: dict[str, Any]) -> Iterator[str]:
    """A line for each object of a scene: its class, how sure that is, its size, its verdict."""
    for one in entries_of_objects(result):
        if "sure" in one:
            kind = str(one.get("class") or "none of the classes")
            what = f"{kind} ({number(one['sure'], times=100.0)}% sure)"
        else:
            what = "not decided yet"
        size = " x ".join(number(side, 2) for side in entries(one.get("size")))
        reasons = "; ".join(map(str, entries(one.get("verdict_reasons"))))
        because = f" because {reasons}" if reasons else ""
        verdict = f", {one['verdict']}{because}" if one.get("verdict") else ""
        yield f"{one.get('name')}: {what}, {size} m{verdict}"


def _judgement(result: dict[str, Any]) -> Iterator[Figure]:
    """The verdict and the figures it rests on, in plain words."""
    quality = result.get("quality")
    if "verdict" not in result or not isinstance(quality, dict):
        return
    reasons = "; ".join(map(str, entries(result.get("verdict_reasons"))))
    yield Figure("Verdict", str(result["verdict"]), reasons or "no problem was found")
    yield Figure("Size", _size(result), "width, height and depth of the object")
    percent = {"times": 100.0, "unit": " %"}
    parts = [
        f"{number(quality.get(name), **percent)} {name}"
        for name in ("measured", "mirrored", "predicted")
        if quality.get(name) is not None
    ]
    meaning = (
        "of the measured points of the object lie within 1 cm of the mesh, or within the camera’s "
        f"noise. Area of the mesh: {', '.join(parts) or 'not known what was measured'}; "
        f"{number(quality.get('free_violated'), **percent)} lies in space that was measured as free"
    )
    yield Figure("Explained", number(quality.get("explained"), **percent), meaning)


def _size(result: dict[str, Any]) -> str:
    """Width, height and depth in metres."""
    sides = entries((result.get("quality") or {}).get("size"))
    return " x ".join(number(side, 2) for side in sides) + " m"


def warnings_of(found: ResultFolder) -> list[str]:
    """Warnings of a result: its own, frames that are not used, and files that are damaged."""
    given, lost = found.result.get("warnings") or [], _counts(found)["lost"]
    unused = [f"{lost} of {len(found.frames)} frames were lost, and are not fused."] if lost else []
    return [*([given] if isinstance(given, str) else map(str, given)), *unused, *found.problems]


def _minimised(result: dict[str, Any]) -> str:
    """The objective of the search, in words."""
    search = result.get("search")
    name = str(search["objective"]) if isinstance(search, dict) and "objective" in search else ""
    words = {
        "": "Eq. 7 or a variant of it",
        "paper": "Eq. 7 as printed",
        "balanced": "Eq. 7 with a third of the weight on measured free space",
        "soft": "Eq. 7 with each voxel weighted by the certainty of its measurement",
    }
    return words.get(name, f"the objective {name}")


def tracked(keyframe: KeyframeRecord) -> str:
    """Figures of the registration of a keyframe, in words."""
    inliers, rmse = keyframe.figures.get("inlier_fraction"), keyframe.figures.get("rmse")
    agree = number(inliers, 0, times=100.0, unit=" % inliers")
    return ", ".join(filter(None, (agree, number(rmse, 1, times=1000.0, unit=" mm"))))


def entries(value: Any) -> list[Any]:
    """A list, or an empty one in place of anything else, as in a damaged result."""
    return value if isinstance(value, list) else []


def number(value: Any, digits: int = 0, *, times: float = 1.0, unit: str = "") -> str:
    """A number for people; empty if it is not a number, a dash if it is not finite."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return ""
    return f"{times * value:.{digits}f}{unit}" if math.isfinite(value) else "–"


def _counts(found: ResultFolder) -> Counter[str]:
    return Counter(str(frame.get("status")) for frame in found.frames)
