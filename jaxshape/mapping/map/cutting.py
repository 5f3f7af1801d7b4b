"""The object's pixels in the keyframes of a map, decided together. [host]

cut_new       the pixels of a new frame
cut_all       the object's pixels in all keyframes, after its box has changed
is_outgrown   whether parts of the object lie outside of its box
"""

import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool

from jaxshape.data.boxes import Box, in_object
from jaxshape.mapping.placement.faces import (
    Cutout,
    cutouts,
    object_points,
    reach_of,
    world_points,
)  # fmt: skip
from jaxshape.mapping.segmentation.belonging import Seen, belonging
from jaxshape.mapping.segmentation.parts import Parts, parts_of
from jaxshape.mapping.tracking.keyframes import Keyframe, PreparedFrame, resized

RECENT = 8
"""Number of latest keyframes that a new keyframe is compared with, besides the first keyframe."""

OUTSIDE = 0.01
"""Share of the object's points outside of its box above which the box is too small."""

FURTHER = 0.03
"""Distance from the box, in metres, beyond which points are outside: noise reaches that far."""


def parts_in(
    prepared: PreparedFrame,
    core: Bool[np.ndarray, "H W"] | None = None,
    *,
    with_tables: bool = True,
) -> Parts:
    """The parts of a frame at working size.

    Args:
        prepared: The frame.
        core: Pixels that surely show the object, in full size `[H W]`; None for none.
        with_tables: Whether table tops are background; False where tables are objects.
    """
    fx, fy, cx, cy = (float(x) for x in prepared.view.intrinsics)
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    depth = np.asarray(prepared.view.depth)
    sure = None if core is None else np.asarray(resized(core, depth.shape))
    return parts_of(depth, K, sure, with_tables=with_tables)


def cut_new(
    prepared: PreparedFrame, keyframes: tuple[Keyframe, ...], box: Box, T_world_camera: jaxlie.SE3
) -> tuple[Parts, Bool[Array, "h w"]]:
    """The parts of a new frame, and its pixels that show the object.

    Args:
        prepared: The frame.
        keyframes: The keyframes before it.
        box: The box that the object is cut out with.
        T_world_camera: Pose of the frame.

    Returns:
        The parts, and True on pixels that show the object `[h w]`.
    """
    parts = parts_in(prepared)
    T = np.asarray(T_world_camera.as_matrix(), np.float64)
    nothing = jnp.zeros_like(prepared.masked)
    new = _seen(Cutout(prepared.view.depth, nothing, prepared.view.intrinsics, T), parts)
    compared = _all_seen(keyframes[:1] + keyframes[1:][-RECENT:])
    return parts, jnp.asarray(belonging([*compared, new], box, *reach_of(box))[-1])


def cut_all(keyframes: tuple[Keyframe, ...], box: Box) -> tuple[Keyframe, ...]:
    """The keyframes with the pixels that show the object, given its box.

    Args:
        keyframes: The keyframes of a map.
        box: The box that the object is cut out with.

    Returns:
        The keyframes; those in which a mask gave the object are unchanged.
    """
    found = belonging(_all_seen(keyframes), box, *reach_of(box))
    return tuple(
        one if one.parts is None else one._replace(segmented=jnp.asarray(pixels))
        for one, pixels in zip(keyframes, found, strict=True)
    )


def is_outgrown(box: Box, keyframes: tuple[Keyframe, ...]) -> bool:
    """Whether more points of the object lie outside of its box than noise explains.

    Args:
        box: The object's box.
        keyframes: The keyframes of a map.
    """
    points = in_object(object_points(cutouts(keyframes)), box)
    outside = (np.abs(points) > box.size / 2 + FURTHER).any(axis=1)
    return len(points) > 0 and bool(outside.mean() > OUTSIDE)


def _all_seen(keyframes: tuple[Keyframe, ...]) -> list[Seen]:
    return [_seen(view, one.parts) for view, one in zip(cutouts(keyframes), keyframes, strict=True)]


def _seen(view: Cutout, parts: Parts | None) -> Seen:
    """A frame in the world; without parts, all of its segmented pixels surely show the object."""
    segmented = np.asarray(view.segmented)
    if parts is None:
        return Seen(world_points(view), np.zeros(segmented.shape, int), segmented)
    return Seen(
        world_points(view), parts.labels, parts.sure, parts.corners, parts.tops, parts.pairs
    )
