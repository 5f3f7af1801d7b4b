"""What the keyframes of a map did not see, in sentences. [host]"""

import numpy as np

from jaxshape.data.boxes import Box
from jaxshape.mapping.map.recording import Progress
from jaxshape.mapping.placement.faces import (
    FACES,
    Cutout,
    cutouts,
    faces_of,
    in_object,
    object_points,
)
from jaxshape.mapping.placement.finding import Start

LEGS = 0.15
"""Share of the height of the box, from below, that legs take up at least."""

_LOWEST = 0.5  # percent of the points that may lie below what counts as measured


def doubts_of(progress: Progress) -> tuple[str, ...]:
    """Warnings of frames that cannot be read, and of what was not seen of the object: in keyframes,
    of its box and of its legs.

    Args:
        progress: Progress of a recording.

    Returns:
        A sentence for each; none about a box that was given.
    """
    told = (*_unreadable(progress), *_empty(progress))
    if progress.start.T_level_world is None:
        return told
    views = cutouts(progress.state.keyframes)
    return (*told, *_unseen(progress.start, views), *_legs(progress.start.box, views))


def _unreadable(progress: Progress) -> tuple[str, ...]:
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
    return (f"No pixel was taken for the object in {_named(names)}; nothing of that is fused.",)


def _unseen(start: Start, views: list[Cutout]) -> tuple[str, ...]:
    """The faces of the box whose place is a guess."""
    faces = faces_of(start.box, views)
    if faces is None:
        return ()
    is_known = faces.seen.copy()
    is_known[0, 1] |= np.isfinite(start.floor)
    names = [FACES[axis][side] for axis in range(3) for side in (0, 1) if not is_known[side, axis]]
    if not names:
        return ()
    return (
        f"Where the object ends was not seen at its {_joined(names)}: what the prior expects there "
        "decides its size. Film it from there too.",
    )


def _joined(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _legs(box: Box, views: list[Cutout]) -> tuple[str, ...]:
    """Whether everything near the floor is predicted."""
    points = in_object(object_points(views), box)
    if not len(points):
        return ()
    lowest = float(np.percentile(points[:, 1], _LOWEST)) + box.size[1] / 2
    if lowest < LEGS * box.size[1]:
        return ()
    return (
        f"Nothing was measured of its lowest {100 * lowest:.0f} cm: legs, or what else is there, "
        "are predicted.",
    )
