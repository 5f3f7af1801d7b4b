"""Realign all keyframes with the map (paper, section 3.4), in one joint least-squares problem.

The sums go over all objects of the map, each with a grid of its own.

In every cell of the map's grid, the patches that the keyframes see there should lie on one plane.
The position of that plane is eliminated, so that the unknowns are the poses alone: moving one
keyframe also moves the planes that the others are compared with, so a loop closes in a few steps
instead of spreading keyframe by keyframe. The refined shape takes part as one more observer of each
cell, which does not move. The tracked poses relative to the previous keyframe are one more term.

    minimise over T   sum_ck rho(n_c . (T_k p_ck - m_c))  +  sum_k |log(T_(k-1)^-1 T_k E_k^-1)|^2

with p_ck the mean of the points of keyframe k in cell c, m_c the weighted mean of all, n_c their
normal, rho Tukey's function, and E_k the pose of keyframe k relative to the one before.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxshape.mapping.tracking.icp import Cloud, robust_weight
from jaxshape.mapping.tracking.surfels import CELLS, FLAT, Lattice, Surface, cell_of

OCCUPIED_CELLS = 12288
"""Largest number of cells that take part."""

CORRELATION = 1 / 200
"""Share of the points behind a tracked pose that count as independent: errors of neighbouring
points are correlated."""

SHAPE_CORRELATION = 1 / 1000
"""Share of the patches of the refined shape that count as independent: whole parts err together."""

_PATCH_DEVIATION = 0.002  # metres: least deviation of a keyframe's mean in a cell
_ITERATIONS = 8
_ROUGH = 0.01  # metres added to the deviations at first; halved in each step
_PARALLEL = 0.8  # least cosine between the normals of a cell and of the refined shape


class Odometry(NamedTuple):
    """Tracked pose of each keyframe relative to the one before it.

    Attributes:
        T_previous_keyframe: Pose of the keyframe in the frame of the one before it `[k]`.
        information: Inverse covariance of that pose `[k 6 6]`, over translation and rotation in the
            frame of the previous keyframe; 0 for none.
    """

    T_previous_keyframe: jaxlie.SE3
    information: Float[Array, "k 6 6"]


class _Observed(NamedTuple):
    """Patches that each keyframe sees in each cell that takes part.

    Attributes:
        mean: Mean of the points of the keyframe in the cell, in metres.
        variance: Variance of that mean along the normal, in square metres; infinite where the
            keyframe sees nothing.
        normal: Unit normal of the cell.
    """

    mean: Float[Array, "c k 3"]
    variance: Float[Array, "c k"]
    normal: Float[Array, "c 3"]


def realign(
    clouds: Cloud,
    T_world_camera: jaxlie.SE3,
    is_keyframe: Bool[Array, " k"],
    lattice: Lattice,
    predicted: Surface,
    odometry: Odometry,
    is_fixed: Bool[Array, " k"],
) -> jaxlie.SE3:
    """The poses of the keyframes that agree best with each other, the shape and the odometry.

    Args:
        clouds: Oriented points that each keyframe shows of each object `[object k ...]`, in its
            camera's frame, padded to equal numbers.
        T_world_camera: Poses of the keyframes before the realignment `[k]`.
        is_keyframe: False for padding `[k]`.
        lattice: Cells of each object `[object ...]`, in which keyframes are compared.
        predicted: Surface of the refined shape of each object `[object ...]`.
        odometry: Tracked poses between neighbouring keyframes.
        is_fixed: True for keyframes that keep their poses `[k]`; if there is none, the whole map
            may drift.

    Returns:
        Poses of the keyframes after the realignment `[k]`.
    """
    moves = is_keyframe & ~is_fixed

    def improve(i, T):
        tolerance = _ROUGH * 0.5**i

        def of_object(clouds, lattice, predicted):
            observed = _observe(clouds, T, is_keyframe, lattice)
            return _surface_equations(observed, predicted, tolerance)

        H, g = jax.tree.map(
            lambda x: x.sum(axis=0), jax.vmap(of_object)(clouds, lattice, predicted)
        )
        odometry_H, odometry_g = _odometry_equations(T, odometry)
        step = _solve(H + odometry_H, g + odometry_g, moves)
        return _moved(T, step)

    return lax.fori_loop(0, _ITERATIONS, improve, T_world_camera)


def _moved(T: jaxlie.SE3, step: Float[Array, "k 6"]) -> jaxlie.SE3:
    """Poses after a translation and rotation in the world frame."""
    rotation = jaxlie.SO3.exp(step[:, 3:])
    update = jaxlie.SE3.from_rotation_and_translation(rotation, step[:, :3])
    return (update @ T).normalize()


def _observe(clouds: Cloud, T: jaxlie.SE3, is_keyframe, lattice: Lattice) -> _Observed:
    k = len(is_keyframe)
    R, t = T.rotation().as_matrix(), T.translation()
    points = clouds.points @ R.mT + t[:, None]
    normals = clouds.normals @ R.mT
    known = jnp.isfinite(clouds.deviation) & is_keyframe[:, None]
    cell = jnp.where(known, cell_of(lattice, points), CELLS**3)
    # Number the cells that hold points.
    is_used = jnp.zeros(CELLS**3, bool).at[cell.ravel()].set(True, mode="drop")
    number = jnp.where(is_used, jnp.cumsum(is_used) - 1, OCCUPIED_CELLS)
    row = number.at[cell].get(mode="fill", fill_value=OCCUPIED_CELLS)
    bin_ = jnp.where(row < OCCUPIED_CELLS, row * k + jnp.arange(k)[:, None], OCCUPIED_CELLS * k)
    inverse_variance = (1 / clouds.deviation**2)[..., None]  # 0 for no point
    values = jnp.concatenate([jnp.ones_like(inverse_variance), points, normals], axis=-1)
    values = jnp.where(inverse_variance > 0, inverse_variance * values, 0)
    sums = jnp.zeros((OCCUPIED_CELLS * k, 7))
    sums = sums.at[bin_.ravel()].add(values.reshape(-1, 7), mode="drop")
    sums = sums.reshape(OCCUPIED_CELLS, k, 7)
    weight, total = sums[..., 0], sums.sum(axis=1)
    normal = total[:, 4:] / jnp.maximum(total[:, :1], 1e-6)
    length = jnp.linalg.norm(normal, axis=-1)
    seen = (weight > 0) & (length > FLAT)[:, None]
    safe = jnp.where(weight > 0, weight, 1)
    variance = jnp.where(seen, 1 / safe + _PATCH_DEVIATION**2, jnp.inf)
    mean = sums[..., 1:4] / safe[..., None]
    return _Observed(mean, variance, normal / jnp.maximum(length, 1e-6)[:, None])


def _surface_equations(observed: _Observed, predicted: Surface, tolerance):
    """Normal equations over the poses, with the level of each cell's plane eliminated."""
    mean, normal = observed.mean, observed.normal
    c, k = observed.variance.shape
    variance = observed.variance + tolerance**2
    weight = 1 / variance
    middle = jnp.einsum("ck,ckd->cd", weight, mean) / jnp.maximum(
        weight.sum(axis=1, keepdims=True), 1e-12
    )
    height = jnp.einsum("ckd,cd->ck", mean - middle[:, None], normal)
    shape_height, shape_variance = _heights_of_shape(predicted, middle, normal, tolerance)
    shape_weight = robust_weight(shape_height, shape_variance)

    def level(weight):
        total = weight.sum(axis=1) + shape_weight
        mean = jnp.sum(weight * height, axis=1) + shape_weight * shape_height
        return mean / jnp.maximum(total, 1e-12), total

    weight = robust_weight(height - level(weight)[0][:, None], variance)
    plane, total = level(weight)
    J = jnp.concatenate(
        [jnp.broadcast_to(normal[:, None], mean.shape), jnp.cross(mean, normal[:, None])], axis=-1
    )
    U = weight[..., None] * J
    H = jnp.zeros((k, 6, k, 6))
    H = H.at[jnp.arange(k), :, jnp.arange(k), :].add(jnp.einsum("cki,ckj->kij", U, J))
    shared = (U / jnp.sqrt(jnp.maximum(total, 1e-12))[:, None, None]).reshape(c, 6 * k)
    H = H.reshape(6 * k, 6 * k) - shared.T @ shared
    return H, jnp.einsum("cki,ck->ki", U, height - plane[:, None]).ravel()


def _heights_of_shape(predicted: Surface, middle, normal, tolerance):
    """Height of the refined shape over the middle of each cell, and its variance."""
    cell = cell_of(predicted.lattice, middle)
    near = predicted.nearest.at[cell].get(mode="fill", fill_value=CELLS**3)
    q = predicted.points.at[near].get(mode="fill", fill_value=0.0)
    q_normal = predicted.normals.at[near].get(mode="fill", fill_value=0.0)
    q_deviation = predicted.deviation.at[near].get(mode="fill", fill_value=jnp.inf)
    agrees = jnp.abs(jnp.sum(q_normal * normal, axis=-1)) > _PARALLEL
    variance = (q_deviation**2 + tolerance**2) / SHAPE_CORRELATION
    height = jnp.sum((q - middle) * normal, axis=-1)
    return height, jnp.where(agrees, variance, jnp.inf)


def _odometry_equations(T: jaxlie.SE3, odometry: Odometry):
    """A common motion of a keyframe and the previous one changes nothing. So in the world frame,
    the blocks of both are the information of their relative pose, with plus or minus sign."""
    k = T.wxyz_xyz.shape[0]
    now, before = jnp.arange(k), jnp.maximum(jnp.arange(k) - 1, 0)
    T_before = jax.tree.map(lambda x: x[before], T)
    left = T_before.inverse() @ T @ odometry.T_previous_keyframe.inverse()
    residual = jnp.concatenate([left.translation(), left.rotation().log()], axis=-1)
    to_previous = jax.vmap(lambda T: T.inverse().adjoint())(T_before)
    weighted = to_previous.mT @ (CORRELATION * odometry.information)
    information = weighted @ to_previous
    H = jnp.zeros((k, 6, k, 6))
    for i, j, sign in ((now, now, 1), (before, before, 1), (now, before, -1), (before, now, -1)):
        H = H.at[i, :, j, :].add(sign * information)
    slope = (weighted @ residual[..., None])[..., 0]
    g = jnp.zeros((k, 6)).at[now].add(slope).at[before].add(-slope)
    return H.reshape(6 * k, 6 * k), g.ravel()


def _solve(H, g, moves: Bool[Array, " k"]) -> Float[Array, "k 6"]:
    """One damped Gauss-Newton step of the keyframes that move."""
    free = jnp.repeat(moves, 6)
    H = jnp.where(free[:, None] & free, H, 0)
    damping = 1e-6 * jnp.max(jnp.diag(H)) + 1e-6
    H = H + jnp.diag(jnp.where(free, damping, 1.0))
    step = jnp.linalg.solve(H, -jnp.where(free, g, 0))
    return step.reshape(-1, 6)
