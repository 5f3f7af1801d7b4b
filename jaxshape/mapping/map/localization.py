"""The pose of a new frame in a map (paper, section 3.4), and whether the camera has moved. [host]

localize    registration from the expected pose; where that fails, from many others
corrected   registration from a given pose, where the frame then agrees better
has_moved   whether a frame shows the object from another viewpoint than the last keyframe
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool

from jaxshape.mapping.config import MappingConfig, TrackingConfig
from jaxshape.mapping.map.state import MapState, no_surface, power_of_two
from jaxshape.mapping.tracking import icp, registration, surfels
from jaxshape.mapping.tracking.icp import Alignment
from jaxshape.mapping.tracking.keyframes import Keyframe, PreparedFrame, object_pixels, view_again
from jaxshape.mapping.tracking.registration import displacement, doubt
from jaxshape.mapping.tracking.surfels import Surface
from jaxshape.mapping.tracking.views import DepthView

BETTER = 0.01
"""Least increase of the inlier fraction, among the points expected to be seen again, for which a
given pose is moved."""

NEARBY = (0.15, 6.0)
"""Largest distance in metres, and largest angle in degrees, by which a given pose is moved."""

_JUMP = (0.5, 15.0)  # metres and degrees: tracking needs no predicted motion below these


def localize(
    states: Sequence[MapState], prepared: PreparedFrame, config: TrackingConfig
) -> tuple[Alignment, str | None]:
    """The pose of a frame in the world, and the reason to reject it, if there is one.

    Args:
        states: Maps of one or more objects with the same keyframes; the expected pose continues
            the motion of the last frames.
        prepared: The frame.
        config: Settings of tracking.

    Returns:
        The alignment of the frame with the map; and the reason to reject it in a few words, None
        where it is accepted.
    """
    state = states[0]
    T_expected = (state.T_world_camera @ state.T_before_last).normalize()
    pixels = _tracked_pixels(states, prepared, T_expected, config)
    surfaces = _surfaces(states, config)
    T_keyframe = state.keyframes[-1].T_world_camera
    found = _register(prepared.view, pixels, state.view, T_keyframe, surfaces, T_expected)
    reason = doubt(found, T_expected, config)
    is_sure = found.converged and found.inlier_fraction >= config.sure_inliers
    if reason is None and is_sure:
        return found, None
    best, is_believed = _relocalized(state, prepared.view, pixels, surfaces, found, config)
    if is_believed:
        return best, None
    return best, reason or doubt(best, T_expected, config)


def corrected(
    states: Sequence[MapState],
    prepared: PreparedFrame,
    T_world_camera: jaxlie.SE3,
    config: TrackingConfig,
) -> Alignment | None:
    """The alignment of a frame whose pose was given, near that pose.

    Args:
        states: Maps of one or more objects with the same keyframes.
        prepared: The frame.
        T_world_camera: The given pose.
        config: Settings of tracking.

    Returns:
        The alignment; None where no nearby pose agrees better, or where the alignment is unsure.
    """
    state = states[0]
    pixels = _tracked_pixels(states, prepared, T_world_camera, config)
    T_keyframe, surfaces = state.keyframes[-1].T_world_camera, _surfaces(states, config)
    at_given, found = _register_near(
        prepared.view, pixels, state.view, T_keyframe, surfaces, T_world_camera
    )
    distance, angle = displacement(found.T_reference_source, T_world_camera)
    is_near = distance < NEARBY[0] and angle < NEARBY[1]
    is_sure = found.converged and found.inlier_fraction >= config.sure_inliers
    is_better = found.inlier_fraction > at_given.inlier_fraction + BETTER
    believed = is_near and is_sure and is_better and doubt(found, None, config) is None
    return found if believed else None


def _surfaces(states: Sequence[MapState], config: TrackingConfig) -> tuple[Surface, ...]:
    """The surfaces that a frame is aligned with, filled up to a power of two with empty ones."""
    nothing = no_surface(states[0].place.lattice)
    if config.against == "keyframe":
        return (nothing,)
    count = power_of_two(len(states))
    return (*(one.surface for one in states), *[nothing] * (count - len(states)))


def _tracked_pixels(
    states: Sequence[MapState],
    prepared: PreparedFrame,
    T_expected: jaxlie.SE3,
    config: TrackingConfig,
) -> Bool[Array, "h w"]:
    """Pixels that are aligned: all pixels, or the pixels of the objects."""
    if config.on == "scene":
        return jnp.ones_like(prepared.masked)
    found = [object_pixels(prepared, one.place, T_expected) for one in states]
    return jnp.any(jnp.stack(found), axis=0)


def _relocalized(
    state: MapState,
    view: DepthView,
    pixels: Bool[Array, "h w"],
    surfaces: tuple[Surface, ...],
    found: Alignment,
    config: TrackingConfig,
) -> tuple[Alignment, bool]:
    """The best alignment from many guesses about the object, and whether it is believed.

    The last keyframe is tried first, then others. The camera may have jumped any distance.
    """
    center = jnp.float32(state.place.box.T_world_object[:3, 3])
    best = found
    for keyframe in _worth_trying(state.keyframes):
        reference = view_again(keyframe.depth, keyframe.intrinsics)
        is_last = keyframe is state.keyframes[-1]
        T_near = state.T_world_camera if is_last else keyframe.T_world_camera
        again = _register_from(
            view, pixels, reference, keyframe.T_world_camera, surfaces, T_near, center
        )
        if registration.score(again) > registration.score(best):
            best = again
        if doubt(best, None, config) is None:
            return best, True
    return best, False


def _worth_trying(keyframes: tuple[Keyframe, ...], count: int = 4) -> list[Keyframe]:
    """The last keyframe, then some from all over the map."""
    others = np.unique(np.linspace(0, len(keyframes) - 2, count).astype(int))
    return [keyframes[-1], *(keyframes[i] for i in others if 0 <= i < len(keyframes) - 1)]


def _match(reference, T_reference, surfaces):
    of_map = map(surfels.match_surface, surfaces)
    return icp.match_all(icp.match_view(reference, T_reference), *of_map)


@jax.jit
def _register(view, pixels, reference, T_reference, surfaces, T_expected):
    match = _match(reference, T_reference, surfaces)
    return registration.register(view, pixels, match, T_expected)


@jax.jit
def _register_near(view, pixels, reference, T_reference, surfaces, T_given):
    match = _match(reference, T_reference, surfaces)
    at_given = registration.agreement(view, pixels, match, T_given)
    return at_given, registration.register(view, pixels, match, T_given)


@jax.jit
def _register_from(view, pixels, reference, T_reference, surfaces, T_near, center):
    match = _match(reference, T_reference, surfaces)
    return registration.register_from(view, pixels, match, registration.guesses(T_near, center))


# Motion ------------------------------------------------------------------------------------------


def moved_to(state: MapState, T_world_camera: jaxlie.SE3) -> MapState:
    """The state after a frame was found at a pose, with the motion expected for the next frame.

    Args:
        state: The map before the frame.
        T_world_camera: The pose of the frame.

    Returns:
        The same map, with the pose and the motion to it. After a jump, for example over missing
        frames, no motion is expected.
    """
    motion = (state.T_world_camera.inverse() @ T_world_camera).normalize()
    distance, angle = displacement(motion, jaxlie.SE3.identity())
    goes_on = distance < _JUMP[0] and angle < _JUMP[1]
    return state._replace(
        T_world_camera=T_world_camera,
        T_before_last=motion if goes_on else jaxlie.SE3.identity(),
    )


def has_moved(state: MapState, T_world_camera: jaxlie.SE3, config: MappingConfig) -> bool:
    """Whether a frame shows the object from another viewpoint than the last keyframe.

    Args:
        state: The map.
        T_world_camera: The pose of the frame.
        config: Settings of mapping, with the distance and angle between keyframes.

    Returns:
        True where the camera turned, about itself or about the object, by more than this angle, or
        moved by more than this distance.
    """
    T_last = state.keyframes[-1].T_world_camera
    distance, turned = displacement(T_last, T_world_camera)
    center = state.place.box.T_world_object[:3, 3]
    angle = _angle_about(center, T_last, T_world_camera)
    return max(angle, turned) > config.keyframe_angle or distance > config.keyframe_distance


def _angle_about(center: np.ndarray, T_a: jaxlie.SE3, T_b: jaxlie.SE3) -> float:
    """Degrees between two cameras as seen from a point."""
    a, b = (np.asarray(T.translation(), np.float64) - center for T in (T_a, T_b))
    cosine = a @ b / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-9)
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
