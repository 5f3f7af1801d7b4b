"""The oriented box that separates the object from the room."""

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxshape import limits, reading
from jaxshape.data.sequences import SequenceError, check_rigid


class Box(NamedTuple):
    """An oriented box around the object, minus boxes that hold other things.

    Attributes:
        T_world_object: Pose of the object frame `[4 4]`: origin at the centre of the box, +y up,
            front along +z, in metres.
        size: Extents along the axes of the object `[3]`, in metres, above 0.
        exclude: Lowest and highest corners `[e 2 3]`, in the object frame, of boxes whose points do
            not belong to the object; empty if there are none.
    """

    T_world_object: Float[np.ndarray, "4 4"]
    size: Float[np.ndarray, " 3"]
    exclude: Float[np.ndarray, "e 2 3"] = np.zeros((0, 2, 3))


def points_in_box(points: Float[np.ndarray, "*batch 3"], box: Box) -> Bool[np.ndarray, "*batch"]:
    """Whether points lie in the box and in none of the boxes it excludes.

    Args:
        points: Points in the world `[*batch 3]`, in metres.
        box: The box.
    """
    p = in_object(points, box)
    inside = _within(p, -box.size / 2, box.size / 2)
    for low, high in box.exclude:
        inside = inside & ~_within(p, low, high)
    return inside


def in_object(points: Float[np.ndarray, "*batch 3"], box: Box) -> Float[np.ndarray, "*batch 3"]:
    """Points of the world in the object frame of a box.

    Args:
        points: Points in the world `[*batch 3]`, in metres.
        box: The box.
    """
    R, t = box.T_world_object[:3, :3], box.T_world_object[:3, 3]
    return (points - t) @ R  # the inverse of a rotation is its transpose, applied to rows


def _within(
    p: Float[np.ndarray, "*batch 3"], low: Float[np.ndarray, " 3"], high: Float[np.ndarray, " 3"]
) -> Bool[np.ndarray, "*batch"]:
    return np.asarray(((low <= p) & (p <= high)).all(axis=-1))


def read_box(path: str | Path) -> Box:
    """Read an object box from JSON.

    The file holds `{"T_world_object": 4x4, "size": [x, y, z]}` and may hold
    `"exclude": [{"min": [x, y, z], "max": [x, y, z]}, ...]`, as the fields of `Box`. A file with
    `world_to_level` (4x4, to a frame with z up) and `chair_box_level` (`X`, `Y` and `h`, each
    lowest and highest) is read as a box whose front points along the level X, since such a file
    does not give the front. Its `exclude_level`, comparisons of X, Y or h with numbers joined by
    `and`, describes regions that are excluded.

    Args:
        path: The JSON file.

    Raises:
        SequenceError: The file cannot be read, or has neither form.
    """
    try:
        content = reading.read_json(path)
    except (OSError, ValueError) as error:
        raise SequenceError(
            f"{path} cannot be read as JSON ({error}); expected an object box: write "
            '{"T_world_object": 4x4, "size": [x, y, z]}.'
        ) from error
    if not isinstance(content, dict):
        raise SequenceError(f"{path} holds a JSON {type(content).__name__}; expected an object.")
    box = _level_box(content, path) if "world_to_level" in content else _oriented_box(content, path)
    check_rigid(box.T_world_object, path)
    low, high = limits.BOX_SIZE
    if not ((low <= box.size) & (box.size <= high)).all():
        raise SequenceError(
            f"{path} gives the size {box.size.tolist()}; expected positive extents, {low:g} to "
            f"{high:g} m: give each axis from lowest to highest, in metres."
        )
    return box


def _oriented_box(content: dict[str, Any], path: str | Path) -> Box:
    excluded = content.get("exclude", [])
    if not (isinstance(excluded, list) and all(isinstance(one, dict) for one in excluded)):
        raise SequenceError(
            f"{path} gives {excluded} as exclude; expected a list of boxes: "
            'write [{"min": [x, y, z], "max": [x, y, z]}].'
        )
    exclude = [[_numbers(one, end, (3,), path) for end in ("min", "max")] for one in excluded]
    if any((low > high).any() for low, high in exclude):
        raise SequenceError(f"{path} excludes boxes whose min is above their max: exchange them.")
    return Box(
        T_world_object=_numbers(content, "T_world_object", (4, 4), path),
        size=_numbers(content, "size", (3,), path),
        exclude=np.array(exclude, dtype=np.float64).reshape(-1, 2, 3),
    )


def _level_box(content: dict[str, Any], path: str | Path) -> Box:
    T_level_world = _level_frame(content, path)
    level = content.get("chair_box_level")
    if not isinstance(level, dict):
        raise SequenceError(f"{path} gives {level!r:.60} as chair_box_level; write X, Y and h.")
    x, y, height = (_numbers(level, axis, (2,), path) for axis in ("X", "Y", "h"))
    front, _, up = T_level_world[:3, :3]
    T_world_object = np.eye(4)
    # A cross product, since the level frame of the known files is left-handed.
    T_world_object[:3, :3] = np.stack([np.cross(up, front), up, front], axis=1)
    center = np.array([x.mean(), y.mean(), height.mean(), 1.0])
    T_world_object[:, 3] = np.linalg.inv(T_level_world) @ center
    size = np.array([np.diff(r)[0] for r in (y, height, x)])
    if "exclude_level" not in content:
        return Box(T_world_object, size)
    excluded = _level_rule(str(content["exclude_level"]), path)
    T_object_level = np.linalg.inv(T_world_object) @ np.linalg.inv(T_level_world)
    # The axes of both frames are parallel, so a box stays a box, though its ends may be exchanged.
    # A far corner stands for no limit, because infinity times zero is not a number.
    corners = excluded @ T_object_level[:3, :3].T + T_object_level[:3, 3]
    return Box(T_world_object, size, np.sort(corners, axis=0)[None])


def _level_frame(content: dict[str, Any], path: str | Path) -> Float[np.ndarray, "4 4"]:
    """World to level: a rigid motion that may include a reflection, as in the known files."""
    T = _numbers(content, "world_to_level", (4, 4), path)
    mirrored = np.diag([1.0, 1.0, np.sign(np.linalg.det(T[:3, :3])) or 1.0, 1.0])
    check_rigid(mirrored @ T, f"world_to_level of {path}")
    return T


_FAR = 1e6
_COMPARISON = re.compile(r"\s*([XYh])\s*([<>])\s*(-?\d+(?:\.\d+)?)\s*")


def _level_rule(rule: str, path: str | Path) -> Float[np.ndarray, "2 3"]:
    """The corners, in the level frame, of the box that a rule like `X > -0.96 and h > 0.62`
    excludes."""
    if len(rule) > limits.PATH_LENGTH:
        raise SequenceError(f"{path} gives {len(rule)} characters as exclude_level; shorten it.")
    corners = np.array([[-_FAR] * 3, [_FAR] * 3])
    for part in re.sub(r"\(.*?\)", "", rule).split(" and "):
        comparison = _COMPARISON.fullmatch(part)
        if comparison is None:
            raise SequenceError(
                f"{path} gives the rule {rule!r} as exclude_level, of which {part!r} cannot be "
                "read; write comparisons of X, Y or h with numbers, joined by `and`."
            )
        axis, sign, number = comparison.groups()
        corners[0 if sign == ">" else 1, "XYh".index(axis)] = float(number)
    return corners


def _numbers(
    content: dict[str, Any], key: str, shape: tuple[int, ...], path: str | Path
) -> Float[np.ndarray, "..."]:
    try:
        given = content.get(key, [])
        numbers = reading.numbers_of(given, np.shape(given))
    except ValueError:
        numbers = np.zeros(0)
    if numbers.shape != shape or not (np.abs(numbers) <= limits.FAR).all():
        raise SequenceError(
            f"{path} gives {content.get(key)!r:.200} as {key}; expected numbers of shape {shape} "
            f"in metres, {limits.FAR:g} at most: see jaxshape.data.boxes.read_box."
        )
    return numbers
