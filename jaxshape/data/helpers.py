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
    return _leave_out(left, "ground", lambda part: _lies_below(part, left, up), notes), tuple(notes)


def _leave_out(
    parts: list[Part], kind: str, is_helper: Callable[[Part], bool], notes: list[str]
) -> list[Part]:
    helpers = [part for part in parts if is_helper(part)]
    if not helpers or len(helpers) == len(parts):
        return parts
    names = ", ".join(sorted({repr(part.name) for part in helpers})[:3])
    notes.append(f"{kind} left out: {names}.")
    return [part for part in parts if not any(part is helper for helper in helpers)]


def _is_named(part: Part, named: re.Pattern[str]) -> bool:
    return any(named.search(name) for name in part.name.split("/"))


def _lies_below(part: Part, parts: Sequence[Part], up: str) -> bool:
    """Whether a part is a horizontal plane below all others, and wider than they are."""
    others = [other.vertices[np.unique(other.faces)] for other in parts if other is not part]
    if not others:
        return False
    own, rest = part.vertices[np.unique(part.faces)], np.concatenate(others)
    axis, sign = "xyz".index(up[-1]), -1 if up[0] == "-" else 1
    size, rest_size = np.ptp(own, axis=0), np.ptp(rest, axis=0)
    sides = [i for i in range(3) if i != axis]
    thin = size[axis] <= _THIN * size[sides].min()
    wide = (size[sides] > _WIDER * rest_size[sides]).all()
    top = (sign * own[:, axis]).max()
    return bool(thin and wide and top <= (sign * rest[:, axis]).min() + _THIN * size[sides].max())
