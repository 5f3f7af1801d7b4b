"""Incremental tracking and mapping (paper, section 3.4): pure functions over the state of one map.

    mapper = build_mapper(prior, refiner, search, MappingConfig(), TrackingConfig())
    state, step = mapper.init(shot, box, T_world_camera)
    for shot in shots:
        state, step = mapper.step(state, shot)
    state, shape = mapper.finish(state)

`init` makes the first keyframe. `step` tracks a frame, against the last keyframe and against the
map's surface, and drops it where its pose is in doubt. Where it has moved enough it becomes a
keyframe: it is fused into F, M and the surface, the code is searched on from the better of the
encoder's proposal and the code found so far, and all keyframes are realigned with the new shape,
after which everything is fused anew. No function changes what it is given; a keyframe costs a fixed
amount of memory, its depth image and one cloud. [host, around jitted parts]
"""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool

from jaxshape.data.boxes import Box
from jaxshape.mapping.config import MappingConfig, TrackingConfig
from jaxshape.mapping.map.state import (
    State,
    added,
    assemble,
    fused_anew,
    grids_of,
    no_surface,
    odometry_of,
    realigned_poses,
    with_surface,
)
from jaxshape.mapping.tracking import icp, registration, surfels
from jaxshape.mapping.tracking.icp import Alignment
from jaxshape.mapping.tracking.keyframes import (
    Cut,
    Keyframe,
    Shot,
    cut_anew,
    keyframe_of,
    object_pixels,
    place_of,
    view_again,
)
from jaxshape.model.weights import ShapePrior
from jaxshape.search.config import RefineConfig
from jaxshape.search.reconstruction import Reconstruction, reconstruct_jit
from jaxshape.search.refiner import Refiner

_JUMP = (0.5, 15.0)  # metres and degrees: what tracking bridges without a guess of the motion


class Step(NamedTuple):
    """What became of a frame."""

    status: str
    """keyframe, tracked or lost."""
    reason: str
    """Why it was lost, in a few words."""
    T_world_camera: jaxlie.SE3 | None
    alignment: Alignment | None
    """None where the pose was given."""
    shape: Reconstruction | None
    """As refined after a keyframe, a batch of one."""
    seconds: dict[str, float]
    """What the parts took: track, cut, fuse, refine, realign."""


class Mapper(NamedTuple):
    """Functions over the state of a map, closed over a prior and settings."""

    init: Callable[..., tuple[State, Step]]
    step: Callable[..., tuple[State, Step]]
    moved: Callable[..., tuple[State, Reconstruction | None]]
    """(state, box) -> the same map with the object's box elsewhere, and its shape there."""
    finish: Callable[..., tuple[State, Reconstruction | None]]


def build_mapper(
    prior: ShapePrior,
    refiner: Refiner | None,
    search: RefineConfig,
    mapping: MappingConfig,
    track: TrackingConfig,
    *,
    seed: int = 0,
) -> Mapper:
    """Tracking and mapping with one prior and search; build it once, for its parts are compiled."""
    key = jax.random.key(seed)
    run_short = reconstruct_jit(refiner, replace(search, iterations=mapping.keyframe_iterations))
    run_long = reconstruct_jit(refiner, search)

    def init(
        shot: Shot,
        box: Box,
        T_world_camera: jaxlie.SE3,
        *,
        room: float = 0.0,
        poses_are_given: bool = False,
    ) -> tuple[State, Step]:
        """The map of a first frame."""
        place = place_of(box, room, isotropic=mapping.isotropic)
        first = keyframe_of(shot, place, T_world_camera, None)
        state = assemble(prior, place, (first,), shot.view, poses_are_given=poses_are_given)
        clock = _Clock()
        state, shape = refine(state)
        clock.lap("refine", state)
        return state, Step("keyframe", "", T_world_camera, None, shape, clock.seconds)

    def step(
        state: State, shot: Shot, T_given: jaxlie.SE3 | None = None, cut: Cut | None = None
    ) -> tuple[State, Step]:
        """Track a frame, unless its pose is given, and map it if it has moved enough.

        `cut` tells which pixels of a new keyframe may show the object, once its pose is known.
        """
        clock = _Clock()
        if T_given is None:
            alignment, reason = tracked(state, shot)
            clock.lap("track", alignment)
            if reason is not None:
                still = state._replace(T_before_last=jaxlie.SE3.identity())
                return still, Step("lost", reason, None, alignment, None, clock.seconds)
            T = alignment.T_reference_source
        else:
            alignment, T = None, T_given
        motion = (state.T_world_camera.inverse() @ T).normalize()
        moved_on = state._replace(T_world_camera=T, T_before_last=_expected_again(motion))
        if not has_moved(state, T):
            return moved_on, Step("tracked", "", T, alignment, None, clock.seconds)
        if cut is not None:
            shot = shot._replace(masked=shot.masked & cut(state.place.cut, T))
            clock.lap("cut", shot)
        new = keyframe_of(shot, state.place, T, odometry_of(state, T, alignment))
        state = moved_on._replace(keyframes=(*state.keyframes, new), view=shot.view)
        state = added(state, new)
        clock.lap("fuse", state)
        state, shape = refine(state)
        clock.lap("refine", state)
        if mapping.realign and not state.poses_are_given and len(state.keyframes) > 2:
            state = realigned(state)
            clock.lap("realign", state)
        T = state.T_world_camera
        return state, Step("keyframe", "", T, alignment, shape, clock.seconds)

    def tracked(state: State, shot: Shot) -> tuple[Alignment, str | None]:
        """The pose of a frame, and why it should not be believed."""
        T_expected = (state.T_world_camera @ state.T_before_last).normalize()
        pixels = _tracked_pixels(state, shot, T_expected)
        surface = state.surface if track.against == "map" else no_surface(state.place.lattice)
        T_keyframe = state.keyframes[-1].T_world_camera
        found = _register(shot.view, pixels, state.view, T_keyframe, surface, T_expected)
        reason = registration.doubt(found, T_expected, track)
        is_sure = found.converged and found.inlier_fraction >= track.sure_inliers
        if reason is None and is_sure:
            return found, None
        # From many guesses about the object, against the last keyframe, then against others.
        center = jnp.float32(state.place.box.T_world_object[:3, 3])
        best = found
        for keyframe in _worth_trying(state.keyframes):
            view = view_again(keyframe.depth, keyframe.intrinsics)
            is_last = keyframe is state.keyframes[-1]
            T_near = state.T_world_camera if is_last else keyframe.T_world_camera
            again = _register_from(
                shot.view, pixels, view, keyframe.T_world_camera, surface, T_near, center
            )
            if registration.score(again) > registration.score(best):
                best = again
            limits = replace(track, max_angle=np.inf, max_distance=np.inf)
            if registration.doubt(best, T_expected, limits) is None:
                return best, None
        return best, reason or registration.doubt(best, T_expected, track)

    def _tracked_pixels(state: State, shot: Shot, T_expected: jaxlie.SE3) -> Bool[Array, "h w"]:
        if track.on == "scene":
            return jnp.ones_like(shot.masked)
        return object_pixels(shot, state.place, T_expected)

    def has_moved(state: State, T: jaxlie.SE3) -> bool:
        """Whether a frame shows the object from elsewhere than the last keyframe."""
        T_last = state.keyframes[-1].T_world_camera
        distance, turned = registration.displacement(T_last, T)
        center = state.place.box.T_world_object[:3, 3]
        angle = _angle_about(center, T_last, T)
        return max(angle, turned) > mapping.keyframe_angle or distance > mapping.keyframe_distance

    def refine(state: State, run=run_short) -> tuple[State, Reconstruction | None]:
        """The shape of what is fused so far, searched on from the one before."""
        occupied, occluded = grids_of(state.measurement, mapping.min_hits)
        if not bool(occupied.any()):
            return state, None
        keys = jax.random.fold_in(key, len(state.keyframes))[None]
        shape = run(keys, prior, occupied[None], occluded[None], earlier=state.code[None])
        state = state._replace(code=shape.code[0], logits=shape.logits[0])
        return with_surface(state), shape

    def realigned(state: State) -> State:
        """All keyframes moved to where they agree with each other and with the refined shape."""
        T = realigned_poses(state)
        moved = (T[-1] @ state.keyframes[-1].T_world_camera.inverse()).normalize()
        keyframes = tuple(
            one._replace(T_world_camera=pose) for one, pose in zip(state.keyframes, T, strict=True)
        )
        state = state._replace(
            keyframes=keyframes, T_world_camera=(moved @ state.T_world_camera).normalize()
        )
        return with_surface(fused_anew(state))

    def moved(state: State, box: Box, *, room: float = 0.0) -> tuple[State, Reconstruction | None]:
        """The same keyframes, mapped in another box."""
        place = place_of(box, room, isotropic=mapping.isotropic)
        keyframes = tuple(cut_anew(one, place) for one in state.keyframes)
        anew = assemble(
            prior,
            place,
            keyframes,
            state.view,
            T_world_camera=state.T_world_camera,
            T_before_last=state.T_before_last,
            poses_are_given=state.poses_are_given,
        )
        return refine(anew)

    def finish(state: State) -> tuple[State, Reconstruction | None]:
        """Realign once more, and search as long as the settings allow; no shape where nothing was
        measured in the box."""
        if mapping.realign and not state.poses_are_given and len(state.keyframes) > 2:
            state = realigned(state)
        return refine(state, run_long)

    return Mapper(init, step, moved, finish)


# The parts ---------------------------------------------------------------------------------------


@jax.jit
def _register(view, pixels, reference, T_reference, surface, T_expected):
    match = icp.match_all(icp.match_view(reference, T_reference), surfels.match_surface(surface))
    return registration.register(view, pixels, match, T_expected)


@jax.jit
def _register_from(view, pixels, reference, T_reference, surface, T_near, center):
    match = icp.match_all(icp.match_view(reference, T_reference), surfels.match_surface(surface))
    return registration.register_from(view, pixels, match, registration.guesses(T_near, center))


def _worth_trying(keyframes: tuple[Keyframe, ...], count: int = 4) -> list[Keyframe]:
    """The last keyframe, then some from all over the map."""
    others = np.unique(np.linspace(0, len(keyframes) - 2, count).astype(int))
    return [keyframes[-1], *(keyframes[i] for i in others if 0 <= i < len(keyframes) - 1)]


def _expected_again(motion: jaxlie.SE3) -> jaxlie.SE3:
    """The motion, where the camera may go on so; none after a jump, as over missing frames."""
    distance, angle = registration.displacement(motion, jaxlie.SE3.identity())
    return motion if distance < _JUMP[0] and angle < _JUMP[1] else jaxlie.SE3.identity()


def _angle_about(center: np.ndarray, T_a: jaxlie.SE3, T_b: jaxlie.SE3) -> float:
    """Degrees between two cameras as seen from a point."""
    a, b = (np.asarray(T.translation(), np.float64) - center for T in (T_a, T_b))
    cosine = a @ b / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-9)
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


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
