"""A recording from its first frame to its last. [host]

    start = find_start(sequence, prior, Prompt(click=(320, 240)))
    for progress in follow(sequence, start, mapper, prior):
        ...                              # after every frame; write, draw, or stop and go on later
    state, reconstruction = mapper.finish(progress.state)

An error in one frame, such as a damaged file or a pose in doubt, costs that frame alone and is
written down in its `FrameLog`.
"""

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float

from jaxshape import checks
from jaxshape.data.sequences import Sequence, SequenceError
from jaxshape.mapping.map.cutting import cut_all, cut_new, is_outgrown, parts_in
from jaxshape.mapping.map.mapper import Mapper
from jaxshape.mapping.map.several import Member, Parts, Step, step_all
from jaxshape.mapping.map.state import MapState
from jaxshape.mapping.placement.finding import (
    Start,
    on_the_floor,
    placed_again,
    refitted,
    room,
    with_room,
)  # fmt: skip
from jaxshape.mapping.tracking.keyframes import Cut, Keyframe, PreparedFrame, as_pose, prepare
from jaxshape.model.shapes import ShapePrior
from jaxshape.search.reconstruction import Reconstruction

PLACE_AGAIN = (2, 3, 5, 9)
"""Numbers of keyframes after which the object is placed anew."""

REVISIONS, CHANGED = 2, 0.02
"""Largest number of placements after one keyframe, and the share of the object's pixels that must
change for a second placement."""


class FrameLog(NamedTuple):
    """Outcome of one frame of a recording.

    Attributes:
        index: Number of the frame in the recording, from 0.
        name: Name of the frame, from its files.
        status: "keyframe", "tracked", "lost" or "unreadable".
        reason: Why the frame was lost or could not be read, in a few words; else empty.
        keyframe: The keyframe, counted from 0, that the pose is relative to.
        T_keyframe_camera: Pose of the frame relative to that keyframe `[4 4]`; None where it has no
            pose.
        figures: Inlier fraction, overlap, rmse in metres and conditioning of the alignment; the
            metres by which a given pose was moved (`moved`); seconds of each part
            (`seconds_track`, ...).
    """

    index: int
    name: str
    status: str
    reason: str
    keyframe: int
    T_keyframe_camera: Float[np.ndarray, "4 4"] | None
    figures: dict[str, float]


class Progress(NamedTuple):
    """A map and the outcome of the frames so far.

    Attributes:
        state: The map after the last frame.
        start: The object as it was found in the first frame, with its latest box.
        logs: Outcome of each frame so far.
        shape: The shape as last refined, a batch of one; None where nothing was measured yet, or
            where the progress of an earlier run was read.
    """

    state: MapState
    start: Start
    logs: tuple[FrameLog, ...]
    shape: Reconstruction | None = None

    def of_keyframes(self) -> Iterator[tuple[FrameLog, Keyframe]]:
        """The log of each keyframe, and the keyframe as the map keeps it."""
        logs = (log for log in self.logs if log.status == "keyframe")
        return zip(logs, self.state.keyframes, strict=True)


def follow(
    sequence: Sequence,
    start: Start,
    mapper: Mapper,
    prior: ShapePrior,
    *,
    chosen: Iterable[int] | None = None,
    use_poses: bool = False,
    earlier: Progress | None = None,
) -> Iterator[Progress]:
    """Track and map the frames of a recording (paper, section 3.4). [host]

    A damaged frame or a pose in doubt costs that frame alone and is written down in its `FrameLog`.

    Args:
        sequence: The recording, from `open_sequence`.
        start: The object in the first frame, from `find_start`.
        mapper: Tracking and mapping, from `build_mapper`.
        prior: The shape prior, which estimates the object's box again as keyframes are added.
        chosen: Numbers of the frames to use, in increasing order; None for all from that of `start`
            on.
        use_poses: Whether the given poses are used; then only frames without one are tracked.
        earlier: Progress of an interrupted run, which this one continues after its last frame; None
            to begin anew.

    Yields:
        The progress after each frame.

    Raises:
        ValueError: A chosen number is not that of a frame.
    """
    chosen = chosen_frames(sequence, chosen, start.index)
    progress = earlier or _begin(sequence, start, mapper, use_poses)
    if earlier is None:
        yield progress
    done = progress.logs[-1].index
    for index in (i for i in chosen if i > done):
        followed = [Followed(progress, mapper.parts)]
        (progress,) = advance(sequence, index, followed, use_poses, _belonging)
        if progress.logs[-1].status == "keyframe":
            progress = _placed_anew(progress, mapper, prior)
        yield progress


def chosen_frames(
    sequence: Sequence, chosen: Iterable[int] | None, first: int
) -> tuple[int, ...] | range:
    """Numbers of the frames to use, each checked to be in the recording.

    Args:
        sequence: The recording.
        chosen: Numbers of the frames; None for all from the first on.
        first: Number of the first frame, from 0.

    Raises:
        ValueError: A chosen number is not that of a frame.
    """
    if chosen is None:
        return range(first, len(sequence))
    chosen = tuple(chosen)
    for index in chosen:
        why = f"the recording has {len(sequence)} frames"
        checks.whole("chosen", index, 0, len(sequence) - 1, why)
    return chosen


def _begin(sequence: Sequence, start: Start, mapper: Mapper, use_poses: bool) -> Progress:
    frame = sequence[start.index]
    prepared = prepare(frame, start.masked)
    if start.T_level_world is not None and frame.mask is None:
        prepared = prepared._replace(parts=parts_in(prepared, start.core))
    state, step = mapper.init(
        prepared,
        start.box,
        as_pose(start.T_world_camera),
        room=room(start),
        poses_are_given=use_poses,
    )
    log = FrameLog(start.index, frame.name, "keyframe", "", 0, np.eye(4), as_figures(step))
    return Progress(state, start, (log,), step.shape)


class Followed(NamedTuple):
    """An object that is followed with others.

    Attributes:
        progress: Its map and its place; all objects share the same logs.
        parts: Prior and settings of its class.
        is_fused: Whether new keyframes are fused into it.
    """

    progress: Progress
    parts: Parts
    is_fused: bool = True


Recut = Callable[[PreparedFrame, Progress], Cut | None]
"""Takes a new frame and the progress of an object; returns the function that cuts the object out of
the frame."""


def advance(
    sequence: Sequence, index: int, followed: Iterable[Followed], use_poses: bool, recut: Recut
) -> list[Progress]:
    """The progress of all objects after one more frame.

    Args:
        sequence: The recording.
        index: Number of the frame, from 0.
        followed: The objects, one or more, whose maps hold the same keyframes.
        use_poses: Whether the given poses are used.
        recut: How each object is cut out of a new keyframe.
    """
    followed = list(followed)
    before = [one.progress for one in followed]
    logs, last = before[0].logs, len(before[0].state.keyframes) - 1
    try:
        frame = sequence[index]
    except SequenceError as problem:
        name = sequence.names[index]
        log = FrameLog(index, name, "unreadable", str(problem), last, None, {})
        return [one._replace(logs=(*logs, log)) for one in before]
    given = frame.T_world_camera if use_poses else None
    prepared = prepare(frame)
    members = [
        Member(
            one.parts,
            one.progress.state,
            recut(prepared, one.progress),
            one.is_fused,
        )
        for one in followed
    ]
    states, step, shapes = step_all(members, prepared, None if given is None else as_pose(given))
    logs = (*logs, _log(index, frame.name, states[0], step))
    return [
        Progress(state, one.start, logs, shape or one.shape)
        for one, state, shape in zip(before, states, shapes, strict=True)
    ]


def _log(index: int, name: str, state: MapState, step: Step) -> FrameLog:
    """The outcome of a frame that could be read."""
    relative = None
    if step.T_world_camera is not None:
        keyframe = state.keyframes[-1].T_world_camera
        relative = np.asarray((keyframe.inverse() @ step.T_world_camera).as_matrix(), np.float64)
    return FrameLog(
        index=index,
        name=name,
        status=step.status,
        reason=step.reason,
        keyframe=len(state.keyframes) - 1,
        T_keyframe_camera=relative,
        figures=as_figures(step),
    )


def _belonging(prepared: PreparedFrame, progress: Progress) -> Cut | None:
    """How a single object is cut out: by its box, and by the parts that belong to it.

    A mask or a given box defines the object; a box that was found is uncertain.
    """
    is_masked = not np.asarray(prepared.masked).all()
    if progress.start.T_level_world is None or is_masked:
        return None
    return partial(cut_new, prepared, progress.state.keyframes, progress.state.place.cut)


def as_figures(step: Step) -> dict[str, float]:
    """Agreement and seconds of a step, as a `FrameLog` holds them.

    Args:
        step: Outcome of the frame.
    """
    figures = {f"seconds_{part}": seconds for part, seconds in step.seconds.items()}
    if step.alignment is not None:
        for name in ("inlier_fraction", "overlap", "rmse", "conditioning"):
            figures[name] = float(getattr(step.alignment, name))
    if step.moved:
        figures["moved"] = step.moved
    return figures


def _placed_anew(progress: Progress, mapper: Mapper, prior: ShapePrior) -> Progress:
    """The progress with the object's box estimated again, where that is due.

    It is due after certain keyframes, and when a keyframe shows the floor or parts of the object
    outside of the box. A new box may change the object's pixels, and then the object is placed
    again. After all other keyframes the box is only fitted to the faces that were seen.
    """
    if progress.start.T_level_world is None:
        return progress
    state, keyframes = progress.state, progress.state.keyframes
    start = on_the_floor(progress.start, keyframes)
    is_revised = start is not progress.start or is_outgrown(start.box, keyframes)
    if not is_revised and len(keyframes) not in PLACE_AGAIN:
        return _refitted(progress, mapper)
    for _ in range(REVISIONS):
        keyframes = cut_all(keyframes, with_room(start))
        start = placed_again(start, prior, keyframes)
        pixels = [one.segmented for one in cut_all(keyframes, with_room(start))]
        if _changed(pixels, keyframes) < CHANGED:
            break
    state, shape = mapper.moved(state, start.box, room=room(start), segmented=pixels)
    return progress._replace(state=state, start=start, shape=shape)


def _refitted(progress: Progress, mapper: Mapper) -> Progress:
    """The progress with the box fitted to the seen faces, without a search with the prior."""
    state, start = progress.state, refitted(progress.start, progress.state.keyframes)
    if start is progress.start:
        return progress
    pixels = [one.segmented for one in cut_all(state.keyframes, with_room(start))]
    state, shape = mapper.moved(state, start.box, room=room(start), segmented=pixels)
    return progress._replace(state=state, start=start, shape=shape)


def _changed(pixels: list[Bool[Array, "h w"]], keyframes: tuple[Keyframe, ...]) -> float:
    """Number of changed pixels, as a share of the object's earlier pixels in all keyframes."""
    before = [np.asarray(one.segmented) for one in keyframes]
    changed = sum(int((a != np.asarray(b)).sum()) for a, b in zip(before, pixels, strict=True))
    return changed / max(1, sum(int(one.sum()) for one in before))


def trajectory(progress: Progress) -> dict[int, Float[np.ndarray, "4 4"]]:
    """Poses of the frames of a recording, from the present poses of their keyframes. [host]

    Args:
        progress: Progress of a recording, from `follow`.

    Returns:
        `T_world_camera` `[4 4]` of every frame that has a pose, in metres, by the number of the
        frame.
    """
    poses = {}
    for log in progress.logs:
        if log.T_keyframe_camera is not None:
            keyframe = progress.state.keyframes[log.keyframe].T_world_camera
            T = np.asarray(keyframe.as_matrix(), np.float64)
            poses[log.index] = T @ log.T_keyframe_camera
    return poses
