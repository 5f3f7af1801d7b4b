"""Incremental tracking and mapping (paper, section 3.4): pure functions over the state of one map.

    mapper = build_mapper(prior, refiner, search, MappingConfig(), TrackingConfig())
    state, step = mapper.init(prepared, box, T_world_camera)
    for prepared in frames:
        state, step = mapper.step(state, prepared)
    state, shape = mapper.finish(state)

`init` makes the first keyframe. `step` tracks a frame, against the last keyframe and against the
map's surface, and drops it where its pose is in doubt. A frame that has moved enough becomes a
keyframe: it is fused into F, M and the surface, the search of the code goes on from the better of
the encoder's proposal and the code found so far, all keyframes are realigned with the new shape,
and everything is fused anew. No function changes its arguments; a keyframe costs a fixed amount of
memory, its depth image and one cloud. [host, around jitted parts]
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jaxlie
from jaxtyping import Array, Bool

from jaxshape.data.boxes import Box
from jaxshape.mapping.config import MappingConfig, TrackingConfig
from jaxshape.mapping.map.several import (
    Clock,
    Member,
    Parts,
    Step,
    finish_all,
    refine_all,
    step_all,
)
from jaxshape.mapping.map.state import MapState, assemble
from jaxshape.mapping.tracking.keyframes import Cut, PreparedFrame, cut_anew, keyframe_of, place_of
from jaxshape.model.shapes import ShapePrior
from jaxshape.search.config import RefineConfig
from jaxshape.search.reconstruction import Reconstruction, reconstruct_jit
from jaxshape.search.refiner import Refiner


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
            mapped in another box and with other pixels of the object.
        finish: `state -> state, shape`: realign once more, and search as long as the settings
            allow.
        parts: Data shared by these functions, for a scene that maps several objects together.
    """

    init: Callable[..., tuple[MapState, Step]]
    step: Callable[..., tuple[MapState, Step]]
    moved: Callable[..., tuple[MapState, Reconstruction | None]]
    finish: Callable[..., tuple[MapState, Reconstruction | None]]
    parts: Parts


def build_mapper(
    prior: ShapePrior,
    refiner: Refiner | None,
    search: RefineConfig,
    mapping: MappingConfig,
    track: TrackingConfig,
    *,
    seed: int = 0,
    is_searched: bool = True,
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
        is_searched: Whether shapes are searched; False keeps only the measurement.

    Returns:
        The four functions over the state of a map.
    """
    # Without a refiner, short and long search are the same function, which is compiled once.
    short = search.iterations if refiner is None else mapping.keyframe_iterations
    parts = Parts(
        prior,
        jax.random.key(seed),
        reconstruct_jit(refiner, replace(search, iterations=short, samples=0)),
        reconstruct_jit(refiner, search),
        mapping,
        track,
        is_searched,
    )
    return Mapper(
        init=partial(_init, parts),
        step=partial(_step, parts),
        moved=partial(_moved, parts),
        finish=partial(_finish, parts),
        parts=parts,
    )


def _init(
    parts: Parts,
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
    clock = Clock()
    state, shape = _refined(parts, state)
    clock.lap("refine", state)
    return state, Step("keyframe", "", T_world_camera, None, shape, clock.seconds)


def _step(
    parts: Parts,
    state: MapState,
    prepared: PreparedFrame,
    T_given: jaxlie.SE3 | None = None,
    cut: Cut | None = None,
) -> tuple[MapState, Step]:
    """Track a frame, unless its pose is given, and map it if it has moved enough."""
    (state,), step, (shape,) = step_all([Member(parts, state, cut)], prepared, T_given)
    return state, step._replace(shape=shape)


def _refined(parts: Parts, state: MapState) -> tuple[MapState, Reconstruction | None]:
    """The shape that explains all fused keyframes, searched from the previous shape."""
    (state,), (shape,) = refine_all([Member(parts, state)])
    return state, shape


def _moved(
    parts: Parts,
    state: MapState,
    box: Box,
    *,
    room: float = 0.0,
    segmented: Sequence[Bool[Array, "h w"] | None] | None = None,
) -> tuple[MapState, Reconstruction | None]:
    """The same keyframes, mapped in another box."""
    return _refined(parts, placed_in(parts, state, box, room=room, segmented=segmented))


def placed_in(
    parts: Parts,
    state: MapState,
    box: Box,
    *,
    room: float = 0.0,
    segmented: Sequence[Bool[Array, "h w"] | None] | None = None,
) -> MapState:
    """The map of the same keyframes in another box, fused anew and not yet searched.

    Args:
        parts: Prior and settings of the object's class.
        state: The map.
        box: The box.
        room: Share by which the box that cuts out the object is larger.
        segmented: The object's pixels in each keyframe; None for all pixels in its box.
    """
    pixels = segmented or [None] * len(state.keyframes)
    place = place_of(box, parts.prior.resolution, room, isotropic=parts.mapping.isotropic)
    return assemble(
        parts.prior,
        place,
        tuple(cut_anew(one, place, of) for one, of in zip(state.keyframes, pixels, strict=True)),
        state.view,
        parts.mapping,
        T_world_camera=state.T_world_camera,
        T_before_last=state.T_before_last,
        poses_are_given=state.poses_are_given,
    )


def _finish(parts: Parts, state: MapState) -> tuple[MapState, Reconstruction | None]:
    """Realign once more, and search as long as the settings allow."""
    (state,), (shape,) = finish_all([Member(parts, state)])
    return state, shape
