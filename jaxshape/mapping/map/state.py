"""The state of a map: keyframes, the measurement fused from them, and its shape. [host]"""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float

from jaxshape.geometry.distance import DistanceField
from jaxshape.geometry.fusing import Fusion, fusion_named
from jaxshape.geometry.fusion import Measurement
from jaxshape.geometry.grids import Grids
from jaxshape.geometry.pixels import Sensor
from jaxshape.mapping.config import MappingConfig
from jaxshape.mapping.map.realign import Odometry, realign
from jaxshape.mapping.tracking import surfels
from jaxshape.mapping.tracking.icp import Alignment
from jaxshape.mapping.tracking.keyframes import Keyframe, Place, to_fuse
from jaxshape.mapping.tracking.surfels import Lattice, Sums, Surface
from jaxshape.mapping.tracking.views import DepthView
from jaxshape.model.shapes import ShapePrior

_LEAST_CAPACITY = 8  # least number of keyframes for which realigning is compiled


class Fusing(NamedTuple):
    """How keyframes become one measurement; hashable, so that it can be static under jit.

    Attributes:
        fusion: By points or by signed distances.
        sensor: How the noise of the camera's depth grows.
    """

    fusion: Fusion
    sensor: Sensor


def fusing_of(mapping: MappingConfig, resolution: int) -> Fusing:
    """The way to fuse keyframes that the settings ask for, at the resolution of a prior."""
    fusion = fusion_named(mapping.fusion, resolution, mapping.min_hits)
    return Fusing(fusion, Sensor(axial=mapping.depth_noise))


class MapState(NamedTuple):
    """All that the next step needs.

    Attributes:
        keyframes: Keyframes so far, with their present poses.
        place: Where the object's grids lie in the world.
        fusing: The way in which keyframes are fused.
        measurement: Measurement fused from all keyframes: of the kind that `fusing` makes.
        sums: Sums of measured points in each cell, from which the measured surface is made.
        code: Code of the shape as last refined `[d]`; the mean code before anything was measured.
        logits: Logits of that shape `[x y z]`; -inf before anything was measured.
        surface: The surface that frames are tracked against.
        view: View of the last keyframe.
        T_world_camera: Pose of the last frame that was tracked.
        T_before_last: Motion of the camera to that frame from the one before.
        poses_are_given: Whether the poses were given, so that keyframes are not realigned.
    """

    keyframes: tuple[Keyframe, ...]
    place: Place
    fusing: Fusing
    measurement: Measurement | DistanceField
    sums: Sums
    code: Float[Array, " d"]
    logits: Float[Array, "x y z"]
    surface: Surface
    view: DepthView
    T_world_camera: jaxlie.SE3
    T_before_last: jaxlie.SE3
    poses_are_given: bool


def assemble(
    prior: ShapePrior,
    place: Place,
    keyframes: tuple[Keyframe, ...],
    view: DepthView,
    mapping: MappingConfig,
    *,
    code: Float[Array, " d"] | None = None,
    logits: Float[Array, "x y z"] | None = None,
    T_world_camera: jaxlie.SE3 | None = None,
    T_before_last: jaxlie.SE3 | None = None,
    poses_are_given: bool = False,
) -> MapState:
    """The state of a map with these keyframes.

    Args:
        prior: The shape prior.
        place: Where the object's grids lie in the world.
        keyframes: The keyframes, one or more.
        view: View of the last keyframe.
        mapping: Settings of mapping; only the way to fuse keyframes is used.
        code: Code of the shape found so far `[d]`; None for the mean code.
        logits: Logits of that shape `[x y z]`; None before anything was measured.
        T_world_camera: Pose of the last frame that was tracked; None for that of the last keyframe.
        T_before_last: Motion of the camera to that frame from the one before; None for no motion.
        poses_are_given: Whether the poses were given.
    """
    fusing = fusing_of(mapping, prior.resolution)
    state = MapState(
        keyframes=keyframes,
        place=place,
        fusing=fusing,
        measurement=fusing.fusion.nothing(),
        sums=surfels.no_sums(),
        code=prior.code_mean if code is None else code,
        logits=jnp.full((prior.resolution,) * 3, -jnp.inf) if logits is None else logits,
        surface=no_surface(place.lattice),
        view=view,
        T_world_camera=T_world_camera or keyframes[-1].T_world_camera,
        T_before_last=T_before_last or jaxlie.SE3.identity(),
        poses_are_given=poses_are_given,
    )
    return with_surface(fused_anew(state))


def fused_anew(state: MapState) -> MapState:
    """The state with F, M and the measured surface fused from all keyframes at present poses."""
    nothing = state.fusing.fusion.nothing()
    state = state._replace(measurement=nothing, sums=surfels.no_sums())
    for keyframe in state.keyframes:
        state = added(state, keyframe)
    return state


def added(state: MapState, keyframe: Keyframe) -> MapState:
    """The state with one more keyframe fused into F, M and the measured surface."""
    T_object_world = jaxlie.SE3.from_matrix(
        jnp.float32(np.linalg.inv(state.place.box.T_world_object))
    )
    measurement, sums = _add(
        state.fusing, state.measurement, state.sums, keyframe._replace(parts=None), T_object_world,
        state.place.frame, state.place.lattice,
    )  # fmt: skip
    return state._replace(measurement=measurement, sums=sums)


@partial(jax.jit, static_argnums=0)
def _add(
    fusing: Fusing, measurement: Any, sums, keyframe: Keyframe, T_object_world, frame, lattice
):
    T_object_camera = T_object_world @ keyframe.T_world_camera
    (depth, intrinsics), segmented = to_fuse(keyframe)
    fusion, sensor = fusing
    new: Any = fusion.measure(depth, segmented, intrinsics, T_object_camera, frame, sensor)
    R = keyframe.T_world_camera.rotation().as_matrix()
    points = keyframe.cloud.points @ R.T + keyframe.T_world_camera.translation()
    more = surfels.add_up(lattice, points, keyframe.cloud.normals @ R.T, keyframe.cloud.deviation)
    return fusion.merge(measurement, new), jax.tree.map(jnp.add, sums, more)


def grids_of(state: MapState) -> Grids:
    """F and M of all keyframes: binary by points, soft by signed distances."""
    return _grids(state.fusing.fusion, state.measurement)


@partial(jax.jit, static_argnums=0)
def _grids(fusion: Fusion, measurement: Any) -> Grids:
    return fusion.grids(measurement)


def odometry_of(
    state: MapState, T: jaxlie.SE3, alignment: Alignment | None
) -> tuple[jaxlie.SE3, Float[Array, "6 6"]]:
    """Pose of a new keyframe relative to the last one, and its inverse covariance."""
    T_last = state.keyframes[-1].T_world_camera
    information = jnp.zeros((6, 6))
    if alignment is not None:
        to_world = T_last.adjoint()
        information = to_world.T @ alignment.information @ to_world
    return (T_last.inverse() @ T).normalize(), information


def carried(state: MapState, keyframe: Keyframe, view: DepthView) -> MapState:
    """The state with one more keyframe that is not fused.

    Args:
        state: The map.
        keyframe: The keyframe.
        view: Its view.
    """
    return state._replace(keyframes=(*state.keyframes, keyframe), view=view)


def realigned(states: Sequence[MapState], is_fused: Sequence[bool]) -> list[MapState]:
    """The maps after all keyframes were moved into agreement with each other and the shapes.

    Args:
        states: Maps of one or more objects with the same keyframes, with their shapes refined.
        is_fused: Whether the keyframes are fused into each map; other maps only get the new poses.

    Returns:
        The maps with new poses, fused anew; the last tracked frame moves with the last keyframe.
    """
    fused = [state for state, chosen in zip(states, is_fused, strict=True) if chosen]
    if not fused:
        return list(states)
    T = realigned_poses(fused)
    anew = [_at_poses(state, T) for state in states]
    return [
        with_surface(fused_anew(state)) if chosen else state
        for state, chosen in zip(anew, is_fused, strict=True)
    ]


def _at_poses(state: MapState, T: list[jaxlie.SE3]) -> MapState:
    """The state with its keyframes at other poses, not yet fused there."""
    moved = (T[-1] @ state.keyframes[-1].T_world_camera.inverse()).normalize()
    keyframes = tuple(
        one._replace(T_world_camera=pose) for one, pose in zip(state.keyframes, T, strict=True)
    )
    return state._replace(
        keyframes=keyframes, T_world_camera=(moved @ state.T_world_camera).normalize()
    )


def realigned_poses(states: Sequence[MapState]) -> list[jaxlie.SE3]:
    """Poses at which the keyframes agree best with each other and with the refined shapes."""
    shared = states[0].keyframes
    count = len(shared)
    capacity = capacity_for(count)
    filled = [*shared, *[shared[-1]] * (capacity - count)]
    T, T_previous, information = _stacked(
        [(k.T_world_camera, k.T_previous_keyframe, k.information) for k in filled]
    )
    is_keyframe = np.arange(capacity) < count
    information = jnp.where(jnp.asarray(is_keyframe)[:, None, None], information, 0)
    seen = [_seen_by(state, capacity) for state in states]
    # The number of objects is a power of two, too: the added ones have no points and no shape.
    rows = power_of_two(len(seen))
    clouds, lattice, probability = _stacked([*seen, *[_unseen(seen[0])] * (rows - len(seen))])
    center = jnp.float32(states[0].place.box.T_world_object[:3, 3])
    T = _realign(
        clouds, T, is_keyframe, lattice, probability,
        Odometry(T_previous, information), np.arange(capacity) == 0, center,
    )  # fmt: skip
    return [jaxlie.SE3(T.wxyz_xyz[i]) for i in range(count)]


def _seen_by(state: MapState, capacity: int) -> tuple[Any, Lattice, Array]:
    """Data that aligns the keyframes of one object: their clouds, its lattice and its shape."""
    filled = [*state.keyframes, *[state.keyframes[-1]] * (capacity - len(state.keyframes))]
    clouds = _stacked([one.cloud for one in filled])
    return clouds, state.place.lattice, jax.nn.sigmoid(state.logits)


def _unseen(seen: tuple[Any, Lattice, Array]) -> tuple[Any, Lattice, Array]:
    clouds, lattice, probability = seen
    nowhere = jnp.full_like(clouds.deviation, jnp.inf)
    return clouds._replace(deviation=nowhere), lattice, jnp.zeros_like(probability)


def _stacked(trees: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *x: jnp.stack(x), *trees)


def power_of_two(count: int) -> int:
    """The number of rows for which a program is compiled: the next power of two.

    Args:
        count: Rows that are needed, 1 or more.
    """
    return 1 << (count - 1).bit_length()


def capacity_for(count: int) -> int:
    """The number of keyframes for which realigning is compiled: the next power of two.

    Args:
        count: Number of keyframes, 1 or more.

    Returns:
        8, 16, 32, ...: each number is twice the one before, so that a growing map is compiled only
        a few times.
    """
    return max(_LEAST_CAPACITY, power_of_two(count))


@jax.jit
def _realign(clouds, T, is_keyframe, lattice, probability, odometry, is_fixed, center):
    # Relative to the object's centre, so that rotations have short arms and positions keep digits.
    near = Lattice(lattice.linear, lattice.offset + lattice.linear @ center)
    to_near = jaxlie.SE3.from_translation(-center)
    predicted = jax.vmap(surfels.predicted_surface)(near, probability)
    T = realign(clouds, to_near @ T, is_keyframe, near, predicted, odometry, is_fixed)
    return to_near.inverse() @ T


def with_surface(state: MapState) -> MapState:
    """The state with the surface that frames are tracked against: measured, else predicted."""
    surface = _composed_surface(state.place.lattice, state.sums, jax.nn.sigmoid(state.logits))
    return state._replace(surface=surface)


@jax.jit
def _composed_surface(lattice, sums, probability) -> Surface:
    measured = surfels.measured_surface(lattice, sums)
    return surfels.composed_surface(measured, surfels.predicted_surface(lattice, probability))


@jax.jit
def no_surface(lattice: Lattice) -> Surface:
    """A surface without patches."""
    return surfels.measured_surface(lattice, surfels.no_sums())
