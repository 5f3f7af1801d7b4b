"""Iterated closest points, point to plane (paper, section 3.4; Besl and McKay, 1992; Chen and
Medioni, 1992).

The oriented points of one frame are aligned with a reference. The reference is a function that
finds a match for each point (`match_view`, `surfels.match_surface`), so that the same loop serves
an earlier frame, the surface of the map, and both together (`match_all`).

    align   damped Gauss-Newton steps with robust weights until a step is below a tenth of a
            millimetre
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxshape.geometry import camera
from jaxshape.geometry.sensor import depth_deviation
from jaxshape.mapping.tracking.views import DepthView, is_oriented

CUTOFF = 4.0
"""Standard deviations beyond which a residual has no weight (Tukey's function)."""

AGREEING = 0.7
"""Least cosine between the normals of a point and its match."""

_SMALLEST_STEP = 1e-4  # metres: motion of the points' centre, or of points at rms distance from it
_DAMPING = 1e-3  # share of the largest eigenvalue: weaker directions are left alone


class Cloud(NamedTuple):
    """Oriented points to be aligned.

    Attributes:
        points: Points, in metres.
        normals: Unit normals of the points.
        deviation: Standard deviation of each point along its normal, in metres; infinite for no
            point.
    """

    points: Float[Array, "n 3"]
    normals: Float[Array, "n 3"]
    deviation: Float[Array, " n"]


class Matches(NamedTuple):
    """For each point, a place on the surface of one or several references.

    Attributes:
        points: Places on the surface, in metres.
        normals: Unit normals of the surface there.
        deviation: Standard deviation of the place along its normal, in metres; infinite for no
            match.
        in_reach: Whether the reference observed the place where the point lies, so that the point
            should have a match.
    """

    points: Float[Array, "*references n 3"]
    normals: Float[Array, "*references n 3"]
    deviation: Float[Array, "*references n"]
    in_reach: Bool[Array, "*references n"]


# Points and normals, in the frame of the references, and how far a match may lie, in metres.
Match = Callable[[Float[Array, "n 3"], Float[Array, "n 3"], Float[Array, ""] | float], Matches]


class Alignment(NamedTuple):
    """The outcome of an alignment; failure is a value of it, never an exception.

    Attributes:
        T_reference_source: Pose of the cloud in the reference frame.
        inlier_fraction: Share of points that agree with the references, among the points that the
            references should show, from 0 to 1.
        overlap: Share of all points that the references should show, from 0 to 1.
        rmse: Root mean square distance of inliers to the planes of their matches, in metres.
        information: Inverse covariance of the pose `[6 6]`, over translation and rotation about the
            reference's origin, in the reference frame; per square metre and square radian.
        conditioning: Smallest eigenvalue of the normal equations over the largest, from 0, where a
            motion is free, to 1.
        converged: Whether the last step was small.
        iterations: Steps that were taken.
    """

    T_reference_source: jaxlie.SE3
    inlier_fraction: Float[Array, ""]
    overlap: Float[Array, ""]
    rmse: Float[Array, ""]
    information: Float[Array, "6 6"]
    conditioning: Float[Array, ""]
    converged: Bool[Array, ""]
    iterations: Int[Array, ""]


def cloud_of(
    view: DepthView, segmented: Bool[Array, "h w"] | None = None, stride: int = 1
) -> Cloud:
    """The oriented points of every `stride`-th pixel; only of segmented pixels if given."""
    known = is_oriented(view) if segmented is None else is_oriented(view) & segmented
    points, normals, known = (
        x[stride // 2 :: stride, stride // 2 :: stride] for x in (view.points, view.normals, known)
    )
    deviation = jnp.where(known, depth_deviation(points[..., 2]), jnp.inf)
    return Cloud(points.reshape(-1, 3), normals.reshape(-1, 3), deviation.ravel())


def match_view(view: DepthView, T_reference_camera: jaxlie.SE3) -> Match:
    """Match points with the surface that a view shows at the pixel to which they project.

    A point in front of the view's surface, or where its rays met nothing, should have been seen;
    a point behind that surface may be hidden.
    """
    shown = jnp.concatenate([view.points, view.normals, view.depth[..., None]], axis=-1)
    R, t = T_reference_camera.rotation().as_matrix(), T_reference_camera.translation()

    def match(points, normals, distance):
        p, n = (points - t) @ R, normals @ R
        pixels, depth = camera.project(view.intrinsics, p)
        ahead = jnp.where(depth[:, None] > 0, pixels, -1.0)  # behind the camera is outside
        found = camera.look_up(shown, ahead)
        q, q_normal, measured = found[:, :3], found[:, 3:6], found[:, 6]
        agrees = jnp.sum(q_normal * n, axis=-1) > AGREEING  # 0 where no normal is known
        near = jnp.sum((p - q) ** 2, axis=-1) < distance**2
        deviation = jnp.where(agrees & near, depth_deviation(q[:, 2]), jnp.inf)
        in_reach = (measured > 0) & (depth < measured + distance)
        return Matches(q @ R.T + t, q_normal @ R.T, deviation, in_reach)

    return match


def match_all(*matches: Match) -> Match:
    """Match points with several references at once."""

    def match(points, normals, distance):
        found = [one(points, normals, distance) for one in matches]
        return jax.tree.map(lambda *x: jnp.stack(x), *found)

    return match


def align(
    cloud: Cloud,
    match: Match,
    T_reference_source: jaxlie.SE3,
    *,
    distance: float,
    tolerance: float,
    iterations: int,
) -> Alignment:
    """Move a cloud onto a reference, from a first guess of its pose.

    Args:
        cloud: The points to align.
        match: Finds a match for each point.
        T_reference_source: First guess of the pose.
        distance: Largest distance of a match, in metres.
        tolerance: Standard deviation added to those of the points, in metres: large for a rough
            guess, small to be exact.
        iterations: Steps at most.
    """

    def proceed(carry):
        _, step, i = carry
        return (i < iterations) & (step > _SMALLEST_STEP)

    def improve(carry):
        T, _, i = carry
        system = _normal_equations(cloud, match, T, distance, tolerance)
        update, step = _solve(system)
        # Rounding would let the quaternion drift off the unit sphere.
        return (update @ T).normalize(), step, i + 1

    start = (T_reference_source, jnp.asarray(jnp.inf), jnp.int32(0))
    T, step, i = lax.while_loop(proceed, improve, start)
    system = _normal_equations(cloud, match, T, distance, tolerance)
    eigenvalues = jnp.linalg.eigvalsh(system.hessian)
    largest = jnp.maximum(eigenvalues[-1], 1e-30)
    return Alignment(
        T_reference_source=T,
        inlier_fraction=system.inliers / jnp.maximum(system.in_reach, 1),
        overlap=system.in_reach / jnp.maximum(jnp.isfinite(cloud.deviation).sum(), 1),
        rmse=system.rmse,
        information=_about_origin(system),
        conditioning=jnp.maximum(eigenvalues[0], 0) / largest,
        converged=(step <= _SMALLEST_STEP) & (system.inliers >= 6),
        iterations=i,
    )


class _System(NamedTuple):
    """Normal equations of one step over translation and rotation.

    Rotation has the unit 1 / `radius`, so that all six unknowns are lengths.

    Attributes:
        hessian: Matrix of the equations `[6 6]`.
        gradient: Right side of the equations, with opposite sign `[6]`.
        center: Point about which the cloud is rotated, the weighted mean of its points, in metres.
        radius: Root mean square distance of the points from the centre, in metres.
        inliers: Number of points that agree with a match.
        in_reach: Number of points that should have a match.
        rmse: Root mean square distance of inliers to the planes of their matches, in metres.
    """

    hessian: Float[Array, "6 6"]
    gradient: Float[Array, " 6"]
    center: Float[Array, " 3"]
    radius: Float[Array, ""]
    inliers: Float[Array, ""]
    in_reach: Float[Array, ""]
    rmse: Float[Array, ""]


def _normal_equations(cloud, match, T, distance, tolerance) -> _System:
    R = T.rotation().as_matrix()
    p, normals = cloud.points @ R.T + T.translation(), cloud.normals @ R.T
    q, n, deviation, in_reach = match(p, normals, distance)
    residual = jnp.sum((p - q) * n, axis=-1)
    variance = cloud.deviation**2 + deviation**2 + tolerance**2
    weight = robust_weight(residual, variance)
    total = jnp.maximum(weight.sum(), 1e-12)
    center = jnp.einsum("...n,nd->d", weight, p) / total
    arm = p - center
    radius = jnp.sqrt(jnp.einsum("...n,nd,nd->", weight, arm, arm) / total + 1e-12)
    J = jnp.concatenate([n, jnp.cross(arm, n) / radius], axis=-1).reshape(-1, 6)
    weighted = weight.reshape(-1, 1) * J
    inlier = weight > 0
    squares = jnp.where(inlier, residual**2, 0.0).sum()
    over_references = tuple(range(inlier.ndim - 1))
    in_reach = jnp.any(in_reach | inlier, axis=over_references) & jnp.isfinite(cloud.deviation)
    return _System(
        hessian=weighted.T @ J,
        gradient=weighted.T @ residual.ravel(),
        center=center,
        radius=radius,
        inliers=jnp.any(inlier, axis=over_references).sum().astype(jnp.float32),
        in_reach=in_reach.sum().astype(jnp.float32),
        rmse=jnp.sqrt(squares / jnp.maximum(inlier.sum(), 1)),
    )


def robust_weight(
    residual: Float[Array, "*batch"], variance: Float[Array, "*batch"]
) -> Float[Array, "*batch"]:
    """Tukey's weight of residuals over their variance; 0 where that is infinite."""
    known = jnp.isfinite(variance)
    squared = jnp.where(known, residual**2 / jnp.where(known, variance, 1), jnp.inf)
    return jnp.where(squared < CUTOFF**2, (1 - squared / CUTOFF**2) ** 2, 0) / variance


def _solve(system: _System) -> tuple[jaxlie.SE3, Float[Array, ""]]:
    """The motion that solves the equations, and its length; undetermined motions are zero."""
    eigenvalues, axes = jnp.linalg.eigh(system.hessian)
    floor = _DAMPING * jnp.maximum(eigenvalues[-1], 1e-6)  # its square is not 0 without matches
    inverse = eigenvalues / (eigenvalues**2 + floor**2)
    motion = -axes @ (inverse * (axes.T @ system.gradient))
    rotation = jaxlie.SO3.exp(motion[3:] / system.radius)
    shift = system.center + motion[:3] - rotation @ system.center
    update = jaxlie.SE3.from_rotation_and_translation(rotation, shift)
    return update, jnp.linalg.norm(motion)


def _about_origin(system: _System) -> Float[Array, "6 6"]:
    """The information over translation and rotation about the origin of the reference.

    A translation t and rotation w about the origin move the centre by t + w x center.
    """
    cross = jax.vmap(jnp.cross, (0, None))(jnp.eye(3), system.center).T
    to_center = jnp.block([[jnp.eye(3), cross], [jnp.zeros((3, 3)), system.radius * jnp.eye(3)]])
    return to_center.T @ system.hessian @ to_center
