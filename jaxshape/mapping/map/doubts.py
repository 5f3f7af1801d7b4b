"""What the keyframes of a map did not see, in sentences. [host]"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxshape.data.boxes import Box, in_object
from jaxshape.mapping.map.recording import Progress
from jaxshape.mapping.placement.faces import (
    FACES,
    Cutout,
    cutouts,
    faces_of,
    object_points,
)
from jaxshape.mapping.placement.finding import Start

LEGS = 0.15
"""Least share of the height of the box, from the bottom, that legs take up."""

UNSEEN_SHARE = 0.07
"""Share of an extent of the box, from a face inwards, that holds no point of a cloud where the end
of the object was not seen: 3 to 6 cm of a chair."""

LEFT_OUT = 0.15
"""Share of the object's pixels in the first frame that are missing in the map, from which a warning
is given."""

MOVED = 0.01
"""Distance by which a given pose was moved, in metres, from which a warning is given."""

_LOWEST = 0.5  # percent of the points that may lie below the lowest measured height


class Unseen(NamedTuple):
    """Parts of the object that no keyframe saw.

    Attributes:
        faces: Names of the faces of its box where no keyframe saw the object end.
        below: Share of the height of its box, from the bottom, in which nothing was measured, from
            0 to 1.
    """

    faces: tuple[str, ...] = ()
    below: float = 0.0


ALL_SEEN = Unseen()
"""No part is known to be unseen, for example where a user gave the box."""


def unseen_of_points(points: Float[np.ndarray, "n 3"], size: Float[np.ndarray, " 3"]) -> Unseen:
    """Parts of an object of which a point cloud shows nothing.

    Args:
        points: The points, in the object frame `[n 3]`, in metres.
        size: Extents of the object's box `[3]`, in metres.
    """
    half = np.asarray(size) / 2
    low, high = np.quantile(points, (0.002, 0.998), axis=0)
    gaps = zip(FACES, (low + half) / size, (half - high) / size, strict=True)
    unseen = [
        face
        for pair, *gap in gaps
        for face, share in zip(pair, gap, strict=True)
        if share > UNSEEN_SHARE
    ]
    return Unseen(tuple(unseen), float(np.clip((low[1] + half[1]) / size[1], 0, 1)))


def doubts_of(progress: Progress) -> tuple[str, ...]:
    """Warnings about unreadable frames, moved poses, keyframes without the object, pixels of the
    object outside of its box, and unseen faces and legs.

    Args:
        progress: Progress of a recording.

    Returns:
        A sentence for each; none about a box that was given.
    """
    return (
        *unreadable(progress),
        *_moved(progress),
        *_empty(progress),
        *_left_out(progress),
        *unseen_in_words(progress),
    )


def _moved(progress: Progress) -> tuple[str, ...]:
    """Given poses that do not fit the depth images."""
    moved = [log.figures["moved"] for log in progress.logs if "moved" in log.figures]
    if max(moved, default=0) < MOVED:
        return ()
    return (
        f"The given poses of {len(moved)} keyframes do not fit the depth images: they were moved, "
        f"by up to {100 * max(moved):.0f} cm. Add --no-correct-poses to take them as they are.",
    )


def unseen_in_words(progress: Progress) -> tuple[str, ...]:
    """Warnings about unseen faces of the object's box and about unseen legs.

    Args:
        progress: Progress of a recording.
    """
    unseen, height = unseen_of(progress), float(progress.start.box.size[1])
    return (*_of_faces(unseen), *_of_legs(unseen, height))


def unseen_of(progress: Progress) -> Unseen:
    """Find the parts of the object that no keyframe saw.

    Args:
        progress: Progress of a recording.

    Returns:
        The unseen faces and the unseen share of the height; nothing where the box was given.
    """
    if progress.start.T_level_world is None:
        return ALL_SEEN
    views, box = cutouts(progress.state.keyframes), progress.start.box
    return Unseen(_faces(progress.start, views), _below(box, views))


def unreadable(progress: Progress) -> tuple[str, ...]:
    """A warning of frames that cannot be read, if there are any.

    Args:
        progress: Progress of a recording.
    """
    logs = [log for log in progress.logs if log.status == "unreadable"]
    if not logs:
        return ()
    which = _named([log.name for log in logs])
    return (f"Frames that cannot be read are left out: {which}. {logs[0].reason}",)


def _named(names: list[str]) -> str:
    return ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")


def _empty(progress: Progress) -> tuple[str, ...]:
    names = [
        log.name
        for log, keyframe in progress.of_keyframes()
        if not np.asarray(keyframe.segmented).any()
    ]
    if not names:
        return ()
    return (
        f"No pixel was segmented as the object in {_named(names)}; these frames are not fused.",
    )


def _left_out(progress: Progress) -> tuple[str, ...]:
    """A warning if many pixels that were chosen in the first frame are not the map's object."""
    first = progress.state.keyframes[0]
    if progress.start.T_level_world is None or first.parts is None or not first.parts.sure.any():
        return ()
    share = 1 - float(np.asarray(first.segmented)[first.parts.sure].mean())
    if share < LEFT_OUT:
        return ()
    return (
        f"{share:.0%} of the points segmented as the object in the first frame lie outside its "
        "box: the object is larger than the prior expects, or something else touches it.",
    )


def _faces(start: Start, views: list[Cutout]) -> tuple[str, ...]:
    """The faces of the box whose place is a guess."""
    faces = faces_of(start.box, views)
    if faces is None:
        return ()
    is_known = faces.seen.copy()
    is_known[0, 1] |= np.isfinite(start.floor)
    return tuple(
        FACES[axis][side] for axis in range(3) for side in (0, 1) if not is_known[side, axis]
    )


def _below(box: Box, views: list[Cutout]) -> float:
    """Share of the box height below the lowest measured point; 0 where nothing was measured."""
    points = in_object(object_points(views), box)
    if not len(points):
        return 0.0
    lowest = float(np.percentile(points[:, 1], _LOWEST)) + box.size[1] / 2
    return float(np.clip(lowest / box.size[1], 0, 1))


def _of_faces(unseen: Unseen) -> tuple[str, ...]:
    if not unseen.faces:
        return ()
    return (
        f"The end of the object was not seen at its {joined(unseen.faces)}, so the prior decides "
        "its size there. Film it from there too.",
    )


def joined(names: Sequence[str]) -> str:
    """Names as a list in a sentence.

    Args:
        names: The names, one or more.
    """
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _of_legs(unseen: Unseen, height: float) -> tuple[str, ...]:
    """A warning if everything near the floor is predicted."""
    if unseen.below < LEGS:
        return ()
    return (
        f"Nothing was measured in the lowest {100 * unseen.below * height:.0f} cm of the object: "
        "this part, for example its legs, is predicted.",
    )
