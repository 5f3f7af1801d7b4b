"""Tracking and mapping of several objects that one camera sees (paper, section 3.4). [host]

Each object has a map of its own: its box, its grids, its code. The camera is shared: all maps hold
the same keyframes at the same poses, a frame is tracked once, against the surfaces of all objects,
and the keyframes are realigned with all of them at once. All objects of one class are searched in
one call. A map of one object is a special case (`build_mapper`).
"""

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Key

from jaxshape.geometry.grids import Grids, binary
from jaxshape.mapping.config import MappingConfig, TrackingConfig
from jaxshape.mapping.map.localization import corrected, has_moved, localize, moved_to
from jaxshape.mapping.map.state import (
    MapState,
    added,
    carried,
    grids_of,
    odometry_of,
    power_of_two,
    realigned,
    with_surface,
)
from jaxshape.mapping.tracking.icp import Alignment
from jaxshape.mapping.tracking.keyframes import Cut, PreparedFrame, keyframe_of
from jaxshape.mapping.tracking.registration import displacement
from jaxshape.model.shapes import ShapePrior
from jaxshape.search.reconstruction import Reconstruction


class Step(NamedTuple):
    """Outcome of one frame.

    Attributes:
        status: "keyframe", "tracked" or "lost".
        reason: Why the frame was lost, in a few words; empty where it was not.
        T_world_camera: Pose of the frame; None where it was lost.
        alignment: Agreement of the frame with the map; None where the given pose was taken.
        shape: The shape as refined after a keyframe, a batch of one; None where nothing was
            refined.
        seconds: Seconds of each part: "track", "cut", "fuse", "refine", "realign".
        moved: Metres by which a given pose was moved.
    """

    status: str
    reason: str
    T_world_camera: jaxlie.SE3 | None
    alignment: Alignment | None
    shape: Reconstruction | None
    seconds: dict[str, float]
    moved: float = 0.0


class Parts(NamedTuple):
    """Constant data that the functions of a mapper share.

    Attributes:
        prior: The shape prior.
        key: Random key of the searches.
        run_short: The search after each keyframe.
        run_long: The search at the end.
        mapping: Settings of mapping.
        tracking: Settings of tracking.
        is_searched: Whether shapes are searched; False keeps only the measurement.
    """

    prior: ShapePrior
    key: Key[Array, ""]
    run_short: Callable[..., Reconstruction]
    run_long: Callable[..., Reconstruction]
    mapping: MappingConfig
    tracking: TrackingConfig
    is_searched: bool = True


class Member(NamedTuple):
    """An object among several.

    Attributes:
        parts: Prior and settings of its class.
        state: Its map; all objects have the same keyframes.
        cut: Function from the pose of a new keyframe to its parts and the object's pixels; None
            for all pixels in the object's box.
        is_fused: Whether new keyframes are fused into it; False for a map that only tracks the
            camera.
    """

    parts: Parts
    state: MapState
    cut: Cut | None = None
    is_fused: bool = True


Shapes = list[Reconstruction | None]
"""The shape of each object, a batch of one; None where nothing was measured or refined."""


def step_all(
    members: Sequence[Member], prepared: PreparedFrame, T_given: jaxlie.SE3 | None = None
) -> tuple[list[MapState], Step, Shapes]:
    """Track a frame, unless its pose is given, and map it if it has moved enough.

    A keyframe with a given pose is moved slightly, to where it agrees better with the map.

    Args:
        members: The objects, one or more; the settings of the first are used.
        prepared: The frame.
        T_given: Its pose; None to track it.

    Returns:
        The maps after the frame, the outcome of the frame, and the refined shapes.
    """
    tracking, mapping = members[0].parts.tracking, members[0].parts.mapping
    states = [one.state for one in members]
    fused = [one.state for one in members if one.is_fused] or states[:1]
    clock, alignment, moved = Clock(), None, 0.0
    if T_given is None:
        alignment, reason = localize(fused, prepared, tracking)
        clock.lap("track", alignment)
        if reason is not None:
            still = [one._replace(T_before_last=jaxlie.SE3.identity()) for one in states]
            lost = Step("lost", reason, None, alignment, None, clock.seconds)
            return still, lost, [None] * len(states)
        T = alignment.T_reference_source
    else:
        T = T_given
    is_keyframe = any(has_moved(one, T, mapping) for one in fused)
    if is_keyframe and T_given is not None and tracking.correct_poses:
        alignment = corrected(fused, prepared, T, tracking)
        clock.lap("track", alignment)
        if alignment is not None:
            moved, _ = displacement(T, alignment.T_reference_source)
            T = alignment.T_reference_source
    states = [moved_to(one, T) for one in states]
    if not is_keyframe:
        tracked = Step("tracked", "", T, alignment, None, clock.seconds)
        return states, tracked, [None] * len(states)
    members = [one._replace(state=state) for one, state in zip(members, states, strict=True)]
    states, step, shapes = _mapped(members, prepared, alignment, clock)
    return states, step._replace(moved=moved), shapes


def _mapped(
    members: Sequence[Member], prepared: PreparedFrame, alignment: Alignment | None, clock: "Clock"
) -> tuple[list[MapState], Step, Shapes]:
    """The maps with the frame that was tracked last as one more keyframe."""
    members = [_with_keyframe(one, prepared, alignment, clock) for one in members]
    states, shapes = refine_all(members)
    clock.lap("refine", states)
    T = states[0].T_world_camera
    if is_realigned(members[0].parts, states[0]):
        states = realigned(states, [one.is_fused for one in members])
        clock.lap("realign", states)
        T = states[0].T_world_camera
    return states, Step("keyframe", "", T, alignment, None, clock.seconds), shapes


def _with_keyframe(
    member: Member, prepared: PreparedFrame, alignment: Alignment | None, clock: "Clock"
) -> Member:
    """The object with the frame that was tracked last fused into its map."""
    state, segmented = member.state, None
    T = state.T_world_camera
    if member.cut is not None:
        found, segmented = member.cut(T)
        prepared = prepared._replace(parts=found)
        clock.lap("cut", segmented)
    if not member.is_fused:
        segmented = jnp.zeros_like(prepared.masked)
    new = keyframe_of(prepared, state.place, T, odometry_of(state, T, alignment), segmented)
    state = carried(state, new, prepared.view)
    state = added(state, new) if member.is_fused else state
    clock.lap("fuse", state)
    return member._replace(state=state)


def refine_all(
    members: Sequence[Member], *, is_long: bool = False
) -> tuple[list[MapState], Shapes]:
    """The shapes that explain all fused keyframes, searched from the previous shapes.

    All objects of a class go through one call, whose number of rows is a power of two, so that it
    is compiled for a few numbers of objects only; classes follow one after the other.

    Args:
        members: The objects.
        is_long: Whether the search is as long as the settings allow, as at the end.

    Returns:
        The maps with their new shapes, and the shapes.
    """
    states: list[MapState] = [one.state for one in members]
    shapes: Shapes = [None] * len(states)
    grids = {
        i: grids_of(one.state)
        for i, one in enumerate(members)
        if one.is_fused and one.parts.is_searched
    }
    # Classes may share a search: it is the prior that tells them apart.
    classes: dict[tuple[int, int], list[int]] = {}
    for i, one in enumerate(members):
        if i in grids and bool(binary(grids[i]).occupied.any()):
            classes.setdefault((id(one.parts.prior), id(one.parts.run_long)), []).append(i)
    for rows in classes.values():
        parts = members[rows[0]].parts
        run = parts.run_long if is_long else parts.run_short
        found = _searched(run, parts, [grids[i] for i in rows], [states[i] for i in rows])
        for k, i in enumerate(rows):
            shapes[i] = jax.tree.map(lambda x, k=k: x[k : k + 1], found)
            states[i] = with_surface(states[i]._replace(code=found.code[k], logits=found.logits[k]))
    return states, shapes


def _searched(
    run: Callable[..., Reconstruction],
    parts: Parts,
    grids: Sequence[Grids],
    states: Sequence[MapState],
) -> Reconstruction:
    """The shapes of some objects of one class, and of copies of the last that fill the batch."""
    count = power_of_two(len(states))
    rows = [min(i, len(states) - 1) for i in range(count)]
    # All objects get the same random numbers, so that no result depends on the other objects.
    key = jax.random.fold_in(parts.key, len(states[0].keyframes))
    occupied, occluded = (
        jnp.stack([getattr(grids[i], name) for i in rows]) for name in ("occupied", "occluded")
    )
    codes = jnp.stack([states[i].code for i in rows])
    keys = jnp.stack([key] * count)
    return run(keys, parts.prior, occupied, occluded, earlier=codes)


def finish_all(members: Sequence[Member]) -> tuple[list[MapState], Shapes]:
    """Realign once more, and search as long as the settings allow.

    Args:
        members: The objects.

    Returns:
        The finished maps, and their shapes.
    """
    if is_realigned(members[0].parts, members[0].state):
        states = realigned([one.state for one in members], [one.is_fused for one in members])
        members = [one._replace(state=state) for one, state in zip(members, states, strict=True)]
    return refine_all(members, is_long=True)


def is_realigned(parts: Parts, state: MapState) -> bool:
    """Whether the keyframes may move: not where their poses were given.

    Args:
        parts: Settings of the mapper.
        state: The map of any object.
    """
    return parts.mapping.realign and not state.poses_are_given and len(state.keyframes) > 2


class Clock:
    """Seconds of the parts of a step; each part includes the wait for its results."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._start = time.perf_counter()

    def lap(self, name: str, computed: Any) -> None:
        """Add the seconds since the last lap to a part, once its results are ready.

        Args:
            name: Name of the part.
            computed: Its results: any tree of arrays.
        """
        jax.block_until_ready([x for x in jax.tree.leaves(computed) if isinstance(x, jax.Array)])
        now = time.perf_counter()
        self.seconds[name] = round(self.seconds.get(name, 0.0) + now - self._start, 4)
        self._start = now
