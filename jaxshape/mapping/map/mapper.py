"""Incremental tracking and mapping (paper, section 3.4): pure functions over the state of one map.

    mapper = build_mapper(prior, refiner, search, MappingConfig(), TrackingConfig())
    state, step = mapper.init(prepared, box, T_world_camera)
    for prepared in frames:
        state, step = mapper.step(state, prepared)
    state, shape = mapper.finish(state)

`init` makes the first keyframe. `step` tracks a frame, against the last keyframe and against the
map's surface, and drops it where its pose is in doubt. Where it has moved enough it becomes a
keyframe: it is fused into F, M and the surface, the code is searched on from the better of the
encoder's proposal and the code found so far, and all keyframes are realigned with the new shape,
after which everything is fused anew. No function changes what it is given; a keyframe costs a fixed
amount of memory, its depth image and one cloud. [host, around jitted parts]
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jaxlie
from jaxtyping import Array, Bool, Key

from jaxshape.data.boxes import Box
from jaxshape.geometry.grids import binary
from jaxshape.mapping.config import MappingConfig, TrackingConfig
from jaxshape.mapping.map.localization import has_moved, localize, moved_to
from jaxshape.mapping.map.state import (
    MapState,
    added,
    assemble,
    grids_of,
    odometry_of,
    realigned,
    with_surface,
)
from jaxshape.mapping.tracking.icp import Alignment
from jaxshape.mapping.tracking.keyframes import (
    Cut,
    PreparedFrame,
    cut_anew,
    keyframe_of,
    place_of,
)
from jaxshape.model.shapes import ShapePrior
from jaxshape.search.config import RefineConfig
from jaxshape.search.reconstruction import Reconstruction, reconstruct_jit
from jaxshape.search.refiner import Refiner


class Step(NamedTuple):
    """Outcome of one frame.

    Attributes:
        status: "keyframe", "tracked" or "lost".
        reason: Why the frame was lost, in a few words; empty where it was not.
        T_world_camera: Pose of the frame; None where it was lost.
        alignment: Agreement of the frame with the map; None where the pose was given.
        shape: The shape as refined after a keyframe, a batch of one; None where nothing was
            refined.
        seconds: Seconds of each part: "track", "cut", "fuse", "refine", "realign".
    """

    status: str
    reason: str
    T_world_camera: jaxlie.SE3 | None
    alignment: Alignment | None
    shape: Reconstruction | None
    seconds: dict[str, float]


class Mapper(NamedTuple):
    """Functions over the state of a map, closed over a prior and settings.

    A shape is None where nothing was measured in the box.

    Attributes:
        init: `(prepared, box, T_world_camera, *, room=0.0, poses_are_given=False) -> state,
            step`: the map of a first frame, whose object lies in `box`, in the world. The object is
            cut out by a box larger by the share `room`.
        step: `(state, prepared, T_given=None, cut=None) -> state, step`: track a frame, unless its
            pose is given, and map it if it has moved enough. `cut(T_world_camera)` gives the parts
            of a new keyframe and the pixels that show the object, once its pose is known.
        moved: `(state, box, *, room=0.0, segmented=None) -> state, shape`: the same keyframes,
            mapped in another box, with other pixels of each taken for the object.
        finish: `state -> state, shape`: realign once more, and search as long as the settings
            allow.
    """

    init: Callable[..., tuple[MapState, Step]]
    step: Callable[..., tuple[MapState, Step]]
    moved: Callable[..., tuple[MapState, Reconstruction | None]]
    finish: Callable[..., tuple[MapState, Reconstruction | None]]


class _Parts(NamedTuple):
    """What the functions of a mapper share; none of it changes.

    Attributes:
        prior: The shape prior.
        key: Random key of the searches.
        run_short: The search after each keyframe.
        run_long: The search at the end.
        mapping: Settings of mapping.
        tracking: Settings of tracking.
    """

    prior: ShapePrior
    key: Key[Array, ""]
    run_short: Callable[..., Reconstruction]
    run_long: Callable[..., Reconstruction]
    mapping: MappingConfig
    tracking: TrackingConfig


def build_mapper(
    prior: ShapePrior,
    refiner: Refiner | None,
    search: RefineConfig,
    mapping: MappingConfig,
    track: TrackingConfig,
    *,
    seed: int = 0,
) -> Mapper:
    """Tracking and mapping with one prior and one search (paper, section 3.4). [host]

    Build it once, for its parts are compiled.

    Args:
        prior: The shape prior.
        refiner: The search (`refiner_for`); None takes the encoder's proposal as it is.
        search: Settings of the search at the end of a recording; after each keyframe it is shorter,
            `mapping.keyframe_iterations`.
        mapping: When a frame becomes a keyframe, and how keyframes are fused.
        track: How the pose of a frame is found, and when it is believed.
        seed: Seed of the random numbers of the search, 0 or more.

    Returns:
        The four functions over the state of a map.
    """
    parts = _Parts(
        prior,
        jax.random.key(seed),
        reconstruct_jit(
            refiner, replace(search, iterations=mapping.keyframe_iterations, samples=0)
        ),
        reconstruct_jit(refiner, search),
        mapping,
        track,
    )
    return Mapper(
        init=partial(_init, parts),
        step=partial(_step, parts),
        moved=partial(_moved, parts),
        finish=partial(_finish, parts),
    )


def _init(
    parts: _Parts,
    prepared: PreparedFrame,
    box: Box,
    T_world_camera: jaxlie.SE3,
    *,
    room: float = 0.0,
    poses_are_given: bool = False,
) -> tuple[MapState, Step]:
    """The map of a first frame."""
    place = place_of(box, parts.prior.resolution, room, isotropic=parts.mapping.isotropic)
    first = keyframe_of(prepared, place, T_world_camera, None)
    state = assemble(
        parts.prior,
        place,
        (first,),
        prepared.view,
        parts.mapping,
        poses_are_given=poses_are_given,
    )
    clock = _Clock()
    state, shape = _refined(parts, state, parts.run_short)
    clock.lap("refine", state)
    return state, Step("keyframe", "", T_world_camera, None, shape, clock.seconds)


def _step(
    parts: _Parts,
    state: MapState,
    prepared: PreparedFrame,
    T_given: jaxlie.SE3 | None = None,
    cut: Cut | None = None,
) -> tuple[MapState, Step]:
    """Track a frame, unless its pose is given, and map it if it has moved enough."""
    clock, alignment, T = _Clock(), None, T_given
    if T is None:
        alignment, reason = localize(state, prepared, parts.tracking)
        clock.lap("track", alignment)
        if reason is not None:
            still = state._replace(T_before_last=jaxlie.SE3.identity())
            return still, Step("lost", reason, None, alignment, None, clock.seconds)
        T = alignment.T_reference_source
    state = moved_to(state, T)
    if not has_moved(state, T, parts.mapping):
        return state, Step("tracked", "", T, alignment, None, clock.seconds)
    return _mapped(parts, state, prepared, alignment, cut, clock)


def _mapped(
    parts: _Parts,
    state: MapState,
    prepared: PreparedFrame,
    alignment: Alignment | None,
    cut: Cut | None,
    clock: "_Clock",
) -> tuple[MapState, Step]:
    """The map with the frame that was tracked last as one more keyframe."""
    T, segmented = state.T_world_camera, None
    if cut is not None:
        found, segmented = cut(T)
        prepared = prepared._replace(parts=found)
        clock.lap("cut", segmented)
    new = keyframe_of(prepared, state.place, T, odometry_of(state, T, alignment), segmented)
    state = state._replace(keyframes=(*state.keyframes, new), view=prepared.view)
    state = added(state, new)
    clock.lap("fuse", state)
    state, shape = _refined(parts, state, parts.run_short)
    clock.lap("refine", state)
    if _is_realigned(parts, state):
        state = realigned(state)
        clock.lap("realign", state)
    return state, Step("keyframe", "", state.T_world_camera, alignment, shape, clock.seconds)


def _refined(
    parts: _Parts, state: MapState, run: Callable[..., Reconstruction]
) -> tuple[MapState, Reconstruction | None]:
    """The shape of what is fused so far, searched on from the one before."""
    grids = grids_of(state)
    if not bool(binary(grids).occupied.any()):
        return state, None
    keys = jax.random.fold_in(parts.key, len(state.keyframes))[None]
    occupied, occluded = grids.occupied[None], grids.occluded[None]
    shape = run(keys, parts.prior, occupied, occluded, earlier=state.code[None])
    state = state._replace(code=shape.code[0], logits=shape.logits[0])
    return with_surface(state), shape


def _is_realigned(parts: _Parts, state: MapState) -> bool:
    """Whether the keyframes may move: not where their poses were given."""
    return parts.mapping.realign and not state.poses_are_given and len(state.keyframes) > 2


def _moved(
    parts: _Parts,
    state: MapState,
    box: Box,
    *,
    room: float = 0.0,
    segmented: Sequence[Bool[Array, "h w"] | None] | None = None,
) -> tuple[MapState, Reconstruction | None]:
    """The same keyframes, mapped in another box."""
    pixels = segmented or [None] * len(state.keyframes)
    place = place_of(box, parts.prior.resolution, room, isotropic=parts.mapping.isotropic)
    anew = assemble(
        parts.prior,
        place,
        tuple(cut_anew(one, place, of) for one, of in zip(state.keyframes, pixels, strict=True)),
        state.view,
        parts.mapping,
        T_world_camera=state.T_world_camera,
        T_before_last=state.T_before_last,
        poses_are_given=state.poses_are_given,
    )
    return _refined(parts, anew, parts.run_short)


def _finish(parts: _Parts, state: MapState) -> tuple[MapState, Reconstruction | None]:
    """Realign once more, and search as long as the settings allow."""
    if _is_realigned(parts, state):
        state = realigned(state)
    return _refined(parts, state, parts.run_long)


class _Clock:
    """Seconds of the parts of a step, which wait for what they computed."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._start = time.perf_counter()

    def lap(self, name: str, computed: Any) -> None:
        jax.block_until_ready([x for x in jax.tree.leaves(computed) if isinstance(x, jax.Array)])
        now = time.perf_counter()
        self.seconds[name] = round(now - self._start, 4)
        self._start = now
