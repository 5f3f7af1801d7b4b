"""The pose of a new frame (paper, section 3.4): registration coarse to fine, from one guess or
from many, and when not to believe it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxshape.mapping.config import TrackingConfig
from jaxshape.mapping.tracking.icp import Alignment, Match, align, cloud_of
from jaxshape.mapping.tracking.views import DepthView


class Level(NamedTuple):
    """One level of the registration, from coarse to fine.

    Attributes:
        stride: Pixels between neighbouring points, along both axes.
        distance: Largest distance of a match, in metres.
        tolerance: Standard deviation of the pose guessed so far, in metres.
        iterations: Steps at most.
    """

    stride: int
    distance: float
    tolerance: float
    iterations: int


LEVELS = (
    Level(stride=4, distance=0.15, tolerance=0.02, iterations=20),
    Level(stride=2, distance=0.06, tolerance=0.006, iterations=15),
    Level(stride=2, distance=0.03, tolerance=0.0, iterations=25),
)


def register(
    view: DepthView, segmented: Bool[Array, "h w"], match: Match, T_reference_camera: jaxlie.SE3
) -> Alignment:
    """Align the segmented pixels of a view with a reference, coarse to fine, from one guess."""
    return _descend(view, segmented, match, T_reference_camera, LEVELS)


def agreement(
    view: DepthView, segmented: Bool[Array, "h w"], match: Match, T_reference_camera: jaxlie.SE3
) -> Alignment:
    """How well the segmented pixels of a view agree with a reference at a fixed pose."""
    finest = LEVELS[-1]._replace(iterations=0)
    return _descend(view, segmented, match, T_reference_camera, (finest,))


def register_from(
    view: DepthView, segmented: Bool[Array, "h w"], match: Match, T_reference_camera: jaxlie.SE3
) -> Alignment:
    """Align a view from many guesses, a batch of poses; the best coarse result is refined."""
    coarse = LEVELS[0]
    rough = jax.vmap(lambda T: _descend(view, segmented, match, T, (coarse,)))(T_reference_camera)
    best = jnp.argmax(score(rough))
    T = jax.tree.map(lambda x: x[best], rough.T_reference_source)
    return _descend(view, segmented, match, T, LEVELS[1:])


def score(alignment: Alignment) -> Float[Array, "*batch"]:
    """Share of points that agree, less the share that should agree but does not."""
    seen, agree = alignment.overlap, alignment.inlier_fraction
    return seen * agree - seen * (1 - agree)


def _descend(view, segmented, match, T, levels) -> Alignment:
    for level in levels:
        found = align(
            cloud_of(view, segmented, level.stride),
            match,
            T,
            distance=level.distance,
            tolerance=level.tolerance,
            iterations=level.iterations,
        )
        T = found.T_reference_source
    return found


def guesses(
    T_world_camera: jaxlie.SE3, center: Float[Array, " 3"], count: int = 24, reach: float = 40.0
) -> jaxlie.SE3:
    """A batch of poses around one: the pose itself, then the pose turned about a world point.

    Turns are up to `reach` degrees about the image's vertical axis, as by walking around the point,
    and a third of that about the horizontal axis.
    """
    angle = jnp.deg2rad(reach) * jnp.linspace(-1, 1, count // 3)
    yaw, pitch = jnp.meshgrid(angle, jnp.deg2rad(reach / 3) * jnp.array([0.0, 1.0, -1.0]))
    axes = T_world_camera.rotation().as_matrix()
    turn = pitch.reshape(-1, 1) * axes[:, 0] + yaw.reshape(-1, 1) * axes[:, 1]
    turn = jnp.concatenate([jnp.zeros((1, 3)), turn])
    rotation = jaxlie.SO3.exp(turn)
    shift = center - rotation @ jnp.broadcast_to(center, turn.shape)
    return jaxlie.SE3.from_rotation_and_translation(rotation, shift) @ T_world_camera


def doubt(
    alignment: Alignment, T_expected: jaxlie.SE3 | None, config: TrackingConfig
) -> str | None:
    """Why a pose should not be believed. [host]

    Args:
        alignment: Outcome of the registration.
        T_expected: The expected pose; None where the pose may lie anywhere.
        config: How much must be explained, and how far from the expected pose it may lie.

    Returns:
        A few words; None where the pose should be believed.
    """
    T = alignment.T_reference_source
    distance, angle = displacement(T, T if T_expected is None else T_expected)
    if not np.isfinite(distance + angle):
        return "no pose was found"
    if alignment.overlap < config.min_overlap:
        return f"only {float(alignment.overlap):.0%} of it is seen again"
    if alignment.inlier_fraction < config.min_inliers:
        return f"only {float(alignment.inlier_fraction):.0%} of what is seen again agrees"
    has_jumped = distance > config.max_distance or angle > config.max_angle
    if T_expected is not None and has_jumped:
        return f"the camera jumped by {distance:.2f} m and {angle:.0f} degrees"
    return None


def displacement(T_a: jaxlie.SE3, T_b: jaxlie.SE3) -> tuple[float, float]:
    """Distance in metres and angle in degrees between two poses. [host]"""
    A, B = np.asarray(T_a.as_matrix(), np.float64), np.asarray(T_b.as_matrix(), np.float64)
    cosine = (np.trace(A[:3, :3].T @ B[:3, :3]) - 1) / 2
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    return float(np.linalg.norm(A[:3, 3] - B[:3, 3])), float(angle)
