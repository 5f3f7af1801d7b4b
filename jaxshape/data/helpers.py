"""Parts of a mesh file that are not the object: colliders, shadows, and the ground below it."""

import re
from collections.abc import Callable, Sequence

import numpy as np

from jaxshape.data.formats.parts import Part

_COLLIDER = re.compile(r"collider|collision|hitbox|^(UCX|UBX|USP|UCP)_|-(conv)?col(only)?$", re.I)
"""Names of simplified shapes for game engines: Unity's, Unreal's and Godot's."""

_SHADOW = re.compile(r"shadow(?!box)", re.I)

_GROUND = re.compile(r"^(ground|floor|backdrop)([ _-]?plane)?([ _.-]?\d+)?$", re.I)

_WIDER = 1.05
"""Factor by which a plane below the object is wider, along both sides, if it is the ground."""

_THIN = 1e-3
"""Thickness of a plane, as a share of its width."""


def without_helpers(parts: Sequence[Part], up: str = "y") -> tuple[list[Part], tuple[str, ...]]:
    """The parts that belong to the object, and a sentence on each kind of other parts.

    Args:
        parts: All parts of a file.
        up: Axis of the file that points up, as "y" or "-z".

    Returns:
        The remaining parts; all parts if none would remain. Sentences on the parts that were left
        out.
    """
    left, notes = [part for part in parts if len(part.faces)], []
    for kind, named in (("collider", _COLLIDER), ("shadow", _SHADOW), ("ground", _GROUND)):
        left = _leave_out(left, kind, lambda part, named=named: _is_named(part, named), notes)
    ground = _plane_below(left, up)
    return _leave_out(left, "ground", lambda part: part is ground, notes), tuple(notes)


def _leave_out(
    parts: list[Part], kind: str, is_helper: Callable[[Part], bool], notes: list[str]
) -> list[Part]:
    helpers, others = [], []
    for part in parts:
        (helpers if is_helper(part) else others).append(part)
    if not helpers or not others:
        return parts
    names = ", ".join(sorted({repr(part.name) for part in helpers})[:3])
    notes.append(f"{kind} left out: {names}.")
    return others


def _is_named(part: Part, named: re.Pattern[str]) -> bool:
    return any(named.search(name) for name in part.name.split("/"))


def _plane_below(parts: Sequence[Part], up: str) -> Part | None:
    """The part that is a horizontal plane below all others, and wider than they are, if any."""
    if len(parts) < 2:
        return None
    axis, sign = "xyz".index(up[-1]), -1 if up[0] == "-" else 1
    sides = [i for i in range(3) if i != axis]
    corners = [part.vertices[np.unique(part.faces)] for part in parts]
    low, high = (np.stack([f(own, axis=0) for own in corners]) for f in (np.min, np.max))
    widest = int(np.argmax((high - low)[:, sides[0]]))  # no other part can be wider than the rest
    size = high[widest] - low[widest]
    rest_low, rest_high = (np.delete(x, widest, axis=0) for x in (low, high))
    rest_low, rest_high = rest_low.min(axis=0), rest_high.max(axis=0)
    thin = size[axis] <= _THIN * size[sides].min()
    wide = (size[sides] > _WIDER * (rest_high - rest_low)[sides]).all()
    top, bottom = (high[widest], rest_low) if sign > 0 else (-low[widest], -rest_high)
    below = top[axis] <= bottom[axis] + _THIN * size[sides].max()
    return parts[widest] if thin and wide and below else None
