"""Boxes of the objects of a scene: around their cells, turned, and as their priors find them."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from jaxshape.data.boxes import Box
from jaxshape.mapping.placement.finding import Start, placed_again, without_floor
from jaxshape.mapping.placement.placing import Placement, turn
from jaxshape.mapping.scene.classes import SceneClass
from jaxshape.mapping.scene.things import Thing
from jaxshape.mapping.scene.world import CELL, Level, rectangle
from jaxshape.mapping.tracking.keyframes import Keyframe, as_pose

CHANGED = 0.02
"""Share of an object's pixels that may change, or of its cells that may lie outside of its box,
before it is boxed anew."""

LATER = 45.0
"""Largest angle, in degrees, by which a prior may turn an object whose front is decided."""

MISFIT = 0.5
"""Largest share by which a prior may shorten or lengthen a side of the box around the measured
cells: the prior knows the hidden parts."""


def boxed(thing: Thing, level: Level) -> Box:
    """The smallest upright box around the cells of an object.

    Args:
        thing: The object.
        level: The level frame.

    Returns:
        The box in the world, down to the floor unless the object stands on a table.
    """
    centers = (thing.index + 0.5) * CELL
    yaw, size, middle = rectangle(centers[:, [0, 2]])
    low, high = np.percentile(centers[:, 1], (0.2, 99.8))
    low = low - CELL / 2 if thing.is_on_top else level.floor
    high = high + CELL / 2
    T = np.eye(4)
    T[:3, :3] = np.asarray(turn(jnp.float32(yaw)), np.float64)
    T[:3, 3] = middle[0], (low + high) / 2, middle[1]
    size = np.array([size[0] + CELL, max(high - low, CELL), size[1] + CELL])
    box = Box(np.linalg.inv(level.T_level_world) @ T, size)
    return box if thing.is_on_top else without_floor(box, level.floor)


def fits(
    box: Box,
    thing: Thing,
    level: Level,
    pixels: Sequence[Bool[np.ndarray, "h w"]],
    before: Sequence[Bool[np.ndarray, "h w"]],
) -> bool:
    """Whether an object still fills its box and still has the same pixels.

    Args:
        box: Its box.
        thing: Its cells.
        level: The level frame.
        pixels: Its pixels in each keyframe `[h w]`.
        before: The pixels from which its map was made, in each keyframe `[h w]`.
    """
    T = level.T_level_world @ box.T_world_object
    p = ((thing.index + 0.5) * CELL - T[:3, 3]) @ T[:3, :3]
    outside = (np.abs(p) > box.size / 2 + CELL).any(axis=1).mean()
    changed = sum(int((a != b).sum()) for a, b in zip(pixels, before, strict=True))
    total = max(1, sum(int(one.sum()) for one in before))
    return bool(outside < CHANGED and changed < CHANGED * total)


def turned_box(box: Box, quarters: int) -> Box:
    """The same box with its front turned by quarters about the vertical.

    Args:
        box: The box.
        quarters: Quarters of a turn, from +z to +x.
    """
    R = np.rint(np.asarray(turn(jnp.float32(quarters * np.pi / 2)), np.float64))
    T = box.T_world_object.copy()
    T[:3, :3] = T[:3, :3] @ R
    exclude = np.sort(box.exclude @ R, axis=1)
    return Box(T, np.abs(R.T @ box.size), exclude)


def placed(start: Start, known: SceneClass, keyframes: tuple[Keyframe, ...]) -> Start:
    """The object in the box that the prior of its class finds; unchanged if that is far off.

    Args:
        start: The object in the box around its cells, its front as decided.
        known: Its class.
        keyframes: The keyframes, with its pixels.
    """
    assert start.T_level_world is not None
    mean = known.placer.code_mean
    box = start.box
    T = as_pose(start.T_level_world @ box.T_world_object)
    size, zero = jnp.float32(box.size), jnp.float32(0)
    before = start._replace(placement=Placement(T, size, mean, zero, zero))
    found = placed_again(before, known.placer, keyframes, known.sizes)
    cosine = found.box.T_world_object[:3, 2] @ box.T_world_object[:3, 2]
    ratio = np.abs(np.log(found.box.size / box.size)).max()
    is_near = cosine > np.cos(np.deg2rad(LATER)) and ratio < np.log1p(MISFIT)
    return found if is_near else before
