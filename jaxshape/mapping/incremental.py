"""Incremental tracking and mapping (paper, section 3.4): pure functions over the state of one map.

    mapper = build_mapper(prior, search, MappingConfig(), TrackingConfig())
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
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxshape.data.boxes import Box, points_in_box
from jaxshape.geometry import fusion, grid
from jaxshape.geometry.camera import Intrinsics
from jaxshape.geometry.fusion import Measurement
from jaxshape.geometry.grid import RESOLUTION, GridFrame
from jaxshape.mapping import icp, surfels, tracking
from jaxshape.mapping.config import MappingConfig, TrackingConfig
from jaxshape.mapping.icp import Alignment, Cloud
from jaxshape.mapping.realign import Odometry, realign
from jaxshape.mapping.surfels import CELLS, Lattice, Sums, Surface
from jaxshape.mapping.views import View, view_of
from jaxshape.model.weights import ShapePrior
from jaxshape.refine.config import RefineConfig
from jaxshape.refine.reconstruction import Reconstruction, reconstruct_jit
from jaxshape.refine.refiner import Refiner

_CAPACITIES = (8, 16, 32, 64, 128, 256, 512)  # keyframes for which the realignment is compiled
_JUMP = (0.5, 15.0)  # metres and degrees: what tracking bridges without a guess of the motion
_STRIDE = 2  # pixels between the points that a keyframe keeps


class Shot(NamedTuple):
    """One frame, prepared for tracking and mapping."""

    view: View
    masked: Bool[Array, "h w"]
    """Pixels that may show the object: a given mask, or all."""


# Pixels that may show the object, from its box and the pose of the camera, both in the world.
Cut = Callable[[Box, jaxlie.SE3], Bool[Array, "h w"]]


class Keyframe(NamedTuple):
    """What the map keeps of a frame."""

    depth: Float[Array, "h w"]
    masked: Bool[Array, "h w"]
    """Pixels that may show the object: a given mask, or all."""
    segmented: Bool[Array, "h w"]
    """Those that do."""
    intrinsics: Intrinsics
    cloud: Cloud
    """Oriented points of the object, in the frame of the camera."""
    T_world_camera: jaxlie.SE3
    T_previous_keyframe: jaxlie.SE3
    """Relative to the keyframe before, as it was tracked."""
    information: Float[Array, "6 6"]
    """Of that relative pose, in the frame of the keyframe before; 0 for the first."""


class Place(NamedTuple):
    """Where the object's grids lie in the world."""

    box: Box
    cut: Box
    """What lies in it is taken for the object."""
    frame: GridFrame
    lattice: Lattice


class State(NamedTuple):
    """All that the next step needs."""

    keyframes: tuple[Keyframe, ...]
    place: Place
    measurement: Measurement
    sums: Sums
    code: Float[Array, " d"]
    """Of the shape as last refined; the mean code before anything was measured."""
    logits: Float[Array, "x y z"]
    """Its decoded shape; -inf before anything was measured."""
    surface: Surface
    """What frames are tracked against."""
    view: View
    """Of the last keyframe."""
    T_world_camera: jaxlie.SE3
    """Of the last frame that was tracked."""
    T_before_last: jaxlie.SE3
    """How the camera moved to it from the frame before."""
    poses_are_given: bool


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
        new = keyframe_of(shot, state.place, T, _odometry(state, T, alignment))
        state = moved_on._replace(keyframes=(*state.keyframes, new), view=shot.view)
        state = _added(state, new)
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
        surface = state.surface if track.against == "map" else _no_surface(state.place.lattice)
        T_keyframe = state.keyframes[-1].T_world_camera
        found = _register(shot.view, pixels, state.view, T_keyframe, surface, T_expected)
        reason = tracking.doubt(found, T_expected, track)
        if reason is None and found.converged:
            return found, None
        # From many guesses about the object, against the last keyframe, then against others.
        center = jnp.float32(state.place.box.T_world_object[:3, 3])
        best = found
        for keyframe in _worth_trying(state.keyframes):
            view = _view_of(keyframe.depth, keyframe.intrinsics)
            T_near = state.T_world_camera if keyframe is state.keyframes[-1] else None
            T_near = keyframe.T_world_camera if T_near is None else T_near
            again = _register_from(
                shot.view, pixels, view, keyframe.T_world_camera, surface, T_near, center
            )
            if tracking.score(again) > tracking.score(best):
                best = again
            limits = replace(track, max_angle=np.inf, max_distance=np.inf)
            if tracking.doubt(best, T_expected, limits) is None:
                return best, None
        return best, reason or tracking.doubt(best, T_expected, track)

    def _tracked_pixels(state: State, shot: Shot, T_expected: jaxlie.SE3) -> Bool[Array, "h w"]:
        if track.on == "scene":
            return jnp.ones_like(shot.masked)
        return _object_pixels(shot, state.place, T_expected)

    def has_moved(state: State, T: jaxlie.SE3) -> bool:
        """Whether a frame shows the object from elsewhere than the last keyframe."""
        T_last = state.keyframes[-1].T_world_camera
        distance, turned = tracking.displacement(T_last, T)
        center = state.place.box.T_world_object[:3, 3]
        angle = _angle_about(center, T_last, T)
        return max(angle, turned) > mapping.keyframe_angle or distance > mapping.keyframe_distance

    def refine(state: State, run=run_short) -> tuple[State, Reconstruction | None]:
        """The shape of what is fused so far, searched on from the one before."""
        occupied, occluded = _grids(state.measurement, mapping.min_hits)
        if not bool(occupied.any()):
            return state, None
        keys = jax.random.fold_in(key, len(state.keyframes))[None]
        shape = run(keys, prior, occupied[None], occluded[None], earlier=state.code[None])
        state = state._replace(code=shape.code[0], logits=shape.logits[0])
        return _with_surface(state), shape

    def realigned(state: State) -> State:
        """All keyframes moved to where they agree with each other and with the refined shape."""
        T = _realigned_poses(state)
        moved = (T[-1] @ state.keyframes[-1].T_world_camera.inverse()).normalize()
        keyframes = tuple(
            one._replace(T_world_camera=pose) for one, pose in zip(state.keyframes, T, strict=True)
        )
        state = state._replace(
            keyframes=keyframes, T_world_camera=(moved @ state.T_world_camera).normalize()
        )
        return _with_surface(fused_anew(state))

    def moved(state: State, box: Box, *, room: float = 0.0) -> tuple[State, Reconstruction | None]:
        """The same keyframes, mapped in another box."""
        place = place_of(box, room, isotropic=mapping.isotropic)
        keyframes = tuple(_cut_anew(one, place) for one in state.keyframes)
        state = state._replace(place=place, keyframes=keyframes, code=prior.code_mean)
        return refine(fused_anew(state))

    def finish(state: State) -> tuple[State, Reconstruction | None]:
        """Realign once more, and search as long as the settings allow; no shape where nothing was
        measured in the box."""
        if mapping.realign and not state.poses_are_given and len(state.keyframes) > 2:
            state = realigned(state)
        return refine(state, run_long)

    return Mapper(init, step, moved, finish)


# The parts ---------------------------------------------------------------------------------------


def place_of(box: Box, room: float = 0.0, *, isotropic: bool = False) -> Place:
    """The voxel frame and the lattice of the surface that fill a box.

    The object is cut out by a box that is larger by the share `room`.
    """
    fit = grid.fit_box_isotropic if isotropic else grid.fit_box
    frame = fit(jnp.float32(-box.size / 2), jnp.float32(box.size / 2))
    R, t = box.T_world_object[:3, :3], box.T_world_object[:3, 3]
    scale = CELLS / RESOLUTION / np.asarray(frame.voxel_size, np.float64)
    linear = scale[:, None] * R.T
    offset = -linear @ t - scale * np.asarray(frame.origin, np.float64)
    cut = box._replace(size=(1 + room) * box.size)
    return Place(box, cut, frame, Lattice(jnp.float32(linear), jnp.float32(offset)))


def assemble(
    prior: ShapePrior,
    place: Place,
    keyframes: tuple[Keyframe, ...],
    view: View,
    *,
    code: Float[Array, " d"] | None = None,
    logits: Float[Array, "x y z"] | None = None,
    T_world_camera: jaxlie.SE3 | None = None,
    T_before_last: jaxlie.SE3 | None = None,
    poses_are_given: bool = False,
) -> State:
    """The state of a map with these keyframes, of whose last one `view` is.

    `code` and `logits` are those of the shape found so far, `T_world_camera` the pose of the last
    frame that was tracked and `T_before_last` the motion before it, where there was one since.
    """
    state = State(
        keyframes=keyframes,
        place=place,
        measurement=fusion.nothing_measured(),
        sums=surfels.no_sums(),
        code=prior.code_mean if code is None else code,
        logits=jnp.full((RESOLUTION,) * 3, -jnp.inf) if logits is None else logits,
        surface=_no_surface(place.lattice),
        view=view,
        T_world_camera=T_world_camera or keyframes[-1].T_world_camera,
        T_before_last=T_before_last or jaxlie.SE3.identity(),
        poses_are_given=poses_are_given,
    )
    return _with_surface(fused_anew(state))


def fused_anew(state: State) -> State:
    """The state with F, M and the measured surface made from all keyframes where they are now."""
    state = state._replace(measurement=fusion.nothing_measured(), sums=surfels.no_sums())
    for keyframe in state.keyframes:
        state = _added(state, keyframe)
    return state


def _added(state: State, keyframe: Keyframe) -> State:
    """The state with one more keyframe fused into F, M and the measured surface."""
    T_object_world = jaxlie.SE3.from_matrix(
        jnp.float32(np.linalg.inv(state.place.box.T_world_object))
    )
    measurement, sums = _add(
        state.measurement, state.sums, keyframe, T_object_world, state.place.frame,
        state.place.lattice,
    )  # fmt: skip
    return state._replace(measurement=measurement, sums=sums)


@jax.jit
def _add(measurement, sums, keyframe: Keyframe, T_object_world, frame, lattice):
    T_object_camera = T_object_world @ keyframe.T_world_camera
    new = fusion.measure(
        keyframe.depth, keyframe.segmented, keyframe.intrinsics, T_object_camera, frame
    )
    R = keyframe.T_world_camera.rotation().as_matrix()
    points = keyframe.cloud.points @ R.T + keyframe.T_world_camera.translation()
    more = surfels.add_up(lattice, points, keyframe.cloud.normals @ R.T, keyframe.cloud.deviation)
    return fusion.merge(measurement, new), jax.tree.map(jnp.add, sums, more)


@partial(jax.jit, static_argnums=1)
def _grids(measurement: Measurement, min_hits: int):
    return fusion.occupied(measurement, min_hits), fusion.occluded(measurement, min_hits)


def keyframe_of(
    shot: Shot,
    place: Place,
    T_world_camera: jaxlie.SE3,
    odometry: tuple[jaxlie.SE3, Float[Array, "6 6"]] | None,
    segmented: Bool[Array, "h w"] | None = None,
) -> Keyframe:
    """What the map keeps of a shot; `odometry` is its pose relative to the keyframe before, and the
    information of that. The object's pixels are those in its box, unless they are given."""
    if segmented is None:
        segmented = _object_pixels(shot, place, T_world_camera)
    T_previous, information = odometry or (jaxlie.SE3.identity(), jnp.zeros((6, 6)))
    return Keyframe(
        depth=shot.view.depth,
        masked=shot.masked,
        segmented=segmented,
        intrinsics=shot.view.intrinsics,
        cloud=_cloud(shot.view, segmented),
        T_world_camera=T_world_camera,
        T_previous_keyframe=T_previous,
        information=information,
    )


def _cut_anew(keyframe: Keyframe, place: Place) -> Keyframe:
    """The keyframe with the object cut out of it by another box."""
    shot = Shot(_view_of(keyframe.depth, keyframe.intrinsics), keyframe.masked)
    segmented = _object_pixels(shot, place, keyframe.T_world_camera)
    return keyframe._replace(segmented=segmented, cloud=_cloud(shot.view, segmented))


def _object_pixels(shot: Shot, place: Place, T_world_camera) -> Bool[Array, "h w"]:
    """Pixels that may show the object and whose points lie in its box."""
    T = np.asarray(T_world_camera.as_matrix(), np.float64)
    points = np.asarray(shot.view.points, np.float64) @ T[:3, :3].T + T[:3, 3]
    inside = points_in_box(points, place.cut) & (np.asarray(shot.view.points[..., 2]) > 0)
    return shot.masked & inside


_cloud = jax.jit(partial(icp.cloud_of, stride=_STRIDE))
_view_of = jax.jit(view_of)


@jax.jit
def _register(view, pixels, reference, T_reference, surface, T_expected):
    match = icp.match_all(icp.match_view(reference, T_reference), surfels.match_surface(surface))
    return tracking.register(view, pixels, match, T_expected)


@jax.jit
def _register_from(view, pixels, reference, T_reference, surface, T_near, center):
    match = icp.match_all(icp.match_view(reference, T_reference), surfels.match_surface(surface))
    return tracking.register_from(view, pixels, match, tracking.guesses(T_near, center))


def _worth_trying(keyframes: tuple[Keyframe, ...], count: int = 4) -> list[Keyframe]:
    """The last keyframe, then some from all over the map."""
    others = np.unique(np.linspace(0, len(keyframes) - 2, count).astype(int))
    return [keyframes[-1], *(keyframes[i] for i in others if 0 <= i < len(keyframes) - 1)]


def _odometry(state: State, T, alignment: Alignment | None):
    """The new keyframe relative to the last, and the information of that."""
    T_last = state.keyframes[-1].T_world_camera
    information = jnp.zeros((6, 6))
    if alignment is not None:
        to_world = T_last.adjoint()
        information = to_world.T @ alignment.information @ to_world
    return (T_last.inverse() @ T).normalize(), information


def _realigned_poses(state: State) -> list[jaxlie.SE3]:
    count = len(state.keyframes)
    capacity = next(n for n in _CAPACITIES if n >= count)
    filled = [*state.keyframes, *[state.keyframes[-1]] * (capacity - count)]
    clouds, T, T_previous, information = jax.tree.map(
        lambda *x: jnp.stack(x),
        *[(k.cloud, k.T_world_camera, k.T_previous_keyframe, k.information) for k in filled],
    )
    is_keyframe = np.arange(capacity) < count
    information = jnp.where(jnp.asarray(is_keyframe)[:, None, None], information, 0)
    center = jnp.float32(state.place.box.T_world_object[:3, 3])
    T = _realign(
        clouds, T, is_keyframe, state.place.lattice, jax.nn.sigmoid(state.logits),
        Odometry(T_previous, information), np.arange(capacity) == 0, center,
    )  # fmt: skip
    return [jaxlie.SE3(T.wxyz_xyz[i]) for i in range(count)]


@jax.jit
def _realign(clouds, T, is_keyframe, lattice, probability, odometry, is_fixed, center):
    # About the object, so that rotations have short arms and positions keep their digits.
    near = Lattice(lattice.linear, lattice.offset + lattice.linear @ center)
    to_near = jaxlie.SE3.from_translation(-center)
    predicted = surfels.predicted_surface(near, probability)
    T = realign(clouds, to_near @ T, is_keyframe, near, predicted, odometry, is_fixed)
    return to_near.inverse() @ T


def _with_surface(state: State) -> State:
    surface = _composed_surface(state.place.lattice, state.sums, jax.nn.sigmoid(state.logits))
    return state._replace(surface=surface)


@jax.jit
def _composed_surface(lattice, sums, probability) -> Surface:
    measured = surfels.measured_surface(lattice, sums)
    return surfels.composed_surface(measured, surfels.predicted_surface(lattice, probability))


@jax.jit
def _no_surface(lattice) -> Surface:
    return surfels.measured_surface(lattice, surfels.no_sums())


def _expected_again(motion: jaxlie.SE3) -> jaxlie.SE3:
    """The motion, where the camera may go on so; none after a jump, as over missing frames."""
    distance, angle = tracking.displacement(motion, jaxlie.SE3.identity())
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
