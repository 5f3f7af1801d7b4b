import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from analytic_room import look_from
from scipy.spatial.transform import Rotation

from jaxshape.mapping.map import realign
from jaxshape.mapping.map.realign import Odometry
from jaxshape.mapping.tracking import surfels
from jaxshape.mapping.tracking.icp import Cloud
from jaxshape.mapping.tracking.surfels import CELLS, Lattice

COUNT = 6  # keyframes
SIDE = 1.0  # metres, of the cube about what is seen
LATTICE = Lattice(jnp.float32(CELLS / SIDE * np.eye(3)), jnp.float32(np.full(3, CELLS / 2)))


def keyframes(noise, count=COUNT):
    """Points of an ellipsoid, those that face each camera, and the true poses of the cameras."""
    rng, axes = np.random.default_rng(0), np.array([0.18, 0.45, 0.38])
    clouds, poses = [], []
    for angle in 2 * np.pi * np.arange(count) / count:
        T = look_from((1.6 * np.sin(angle), 0.9, 1.6 * np.cos(angle)), (0, 0, 0))
        p = rng.normal(size=(8000, 3))
        p *= axes / np.linalg.norm(p, axis=1, keepdims=True)
        n = p / axes**2
        n /= np.linalg.norm(n, axis=1, keepdims=True)
        seen = np.sum((T[:3, 3] - p) * n, axis=1) > 0.3
        p = p + noise * rng.normal(size=(8000, 1)) * n
        p, n = (p - T[:3, 3]) @ T[:3, :3], n @ T[:3, :3]
        deviation = np.where(seen, max(noise, 5e-4), np.inf)
        clouds.append(Cloud(*map(jnp.float32, (p, n, deviation))))
        poses.append(T)
    return jax.tree.map(lambda *x: jnp.stack(x), *clouds), np.array(poses)


NO_SHAPE = jax.jit(surfels.predicted_surface)(LATTICE, jnp.zeros((32, 32, 32)))


@jax.jit
def run(clouds, T, is_keyframe, lattice, predicted, odometry, is_fixed):
    """Of a single object."""
    clouds, lattice, predicted = jax.tree.map(lambda x: x[None], (clouds, lattice, predicted))
    return realign.realign(clouds, T, is_keyframe, lattice, predicted, odometry, is_fixed)


FIRST_FIXED = jnp.arange(COUNT) == 0
ALL = jnp.ones(COUNT, bool)


def as_poses(T):
    return jaxlie.SE3.from_matrix(jnp.float32(T))


def no_odometry(count=COUNT):
    return Odometry(jaxlie.SE3.identity((count,)), jnp.zeros((count, 6, 6)))


def perturbed(T, rng, degrees=1.0, metres=0.01):
    """Every pose but the first moved at random."""
    T = T.copy()
    for pose in T[1:]:
        turn = Rotation.from_rotvec(np.deg2rad(degrees) * rng.uniform(-1, 1, 3)).as_matrix()
        pose[:3] = turn @ pose[:3]
        pose[:3, 3] += metres * rng.uniform(-1, 1, 3)
    return T


def errors(T, truth):
    """Metres at the object, and degrees, of each pose."""
    D = np.asarray(T.as_matrix(), np.float64) @ np.linalg.inv(truth)
    angles = np.linalg.norm(Rotation.from_matrix(D[:, :3, :3]).as_rotvec(), axis=1)
    return np.linalg.norm(D[:, :3, 3], axis=1), np.degrees(angles)


# ------------------------------------------------------------------ what it finds


@pytest.mark.parametrize("noise, angle", [(0.0, 0.1), (0.002, 0.6)])
def test_moved_keyframes_come_back_to_where_they_agree(noise, angle):
    clouds, truth = keyframes(noise)
    start = perturbed(truth, np.random.default_rng(0))
    found = run(clouds, as_poses(start), ALL, LATTICE, NO_SHAPE, no_odometry(), FIRST_FIXED)
    before, after = errors(as_poses(start), truth), errors(found, truth)
    assert before[0].max() > 0.009 and before[1].max() > 0.9
    assert after[0].max() < 0.002 and after[1].max() < angle
    np.testing.assert_array_equal(found.wxyz_xyz[0], as_poses(start).wxyz_xyz[0])


def test_keyframes_that_agree_stay_where_they_are():
    clouds, truth = keyframes(0.0)
    found = run(clouds, as_poses(truth), ALL, LATTICE, NO_SHAPE, no_odometry(), FIRST_FIXED)
    metres, degrees = errors(found, truth)
    assert metres.max() < 1e-3 and degrees.max() < 0.1


def test_fixed_keyframes_and_padding_do_not_move_and_padding_changes_nothing():
    clouds, truth = keyframes(0.002)
    start = as_poses(perturbed(truth, np.random.default_rng(1)))
    is_keyframe = jnp.arange(COUNT) < COUNT - 2
    is_fixed = (jnp.arange(COUNT) == 0) | (jnp.arange(COUNT) == 2)
    garbage = clouds._replace(points=clouds.points.at[-2:].multiply(1.3))
    found, other = (
        run(one, start, is_keyframe, LATTICE, NO_SHAPE, no_odometry(), is_fixed)
        for one in (clouds, garbage)
    )
    moved = np.abs(found.wxyz_xyz - start.wxyz_xyz).max(axis=1) > 1e-6
    np.testing.assert_array_equal(moved, is_keyframe & ~is_fixed)
    np.testing.assert_array_equal(found.wxyz_xyz, other.wxyz_xyz)
    few = jax.tree.map(lambda x: x[:-2], (clouds, start, is_keyframe, is_fixed))
    alone = run(*few[:3], LATTICE, NO_SHAPE, no_odometry(COUNT - 2), few[3])
    np.testing.assert_allclose(found.wxyz_xyz[:-2], alone.wxyz_xyz, atol=1e-5)


def test_without_overlap_odometry_keeps_the_poses_and_alone_they_stay():
    clouds, truth = keyframes(0.002)
    sees_nothing = (jnp.arange(COUNT) % 2 == 1)[:, None]
    apart = clouds._replace(deviation=jnp.where(sees_nothing, jnp.inf, clouds.deviation))
    relative = np.linalg.inv(np.roll(truth, 1, axis=0)) @ truth
    information = 1e8 * jnp.where(FIRST_FIXED[:, None, None], 0, jnp.eye(6))
    odometry = Odometry(as_poses(relative), information)
    start = perturbed(truth, np.random.default_rng(2))
    found = run(apart, as_poses(start), ALL, LATTICE, NO_SHAPE, odometry, FIRST_FIXED)
    metres, degrees = errors(found, truth)
    assert metres.max() < 0.003 and degrees.max() < 0.2
    nothing = clouds._replace(deviation=jnp.full_like(clouds.deviation, jnp.inf))
    still = run(nothing, as_poses(start), ALL, LATTICE, NO_SHAPE, no_odometry(), FIRST_FIXED)
    np.testing.assert_allclose(still.wxyz_xyz, as_poses(start).wxyz_xyz, atol=1e-6)


# ------------------------------------------------------------------ its equations


def derivatives(cost, size, h=1e-3):
    """Gradient and Hessian at 0, by central differences."""
    steps = h * np.eye(size)
    gradient = np.array([(cost(a) - cost(-a)) / (2 * h) for a in steps])
    hessian = np.array([[
        (cost(a + b) - cost(a - b) - cost(b - a) + cost(-a - b)) / (4 * h**2) for b in steps
    ] for a in steps])  # fmt: skip
    return gradient, hessian


def test_the_equations_of_the_surface_are_the_derivatives_of_its_cost():
    """With the level of each cell's plane minimised over, in double precision."""
    rng = np.random.default_rng(0)
    cells, k = 30, 3
    mean = rng.uniform(-0.5, 0.5, (cells, 1, 3)) + rng.normal(0, 0.01, (cells, k, 3))
    normal = rng.normal(size=(cells, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    variance = rng.uniform(0.5, 2, (cells, k))  # so wide that no residual loses weight
    variance[rng.random((cells, k)) < 0.3] = np.inf
    observed = realign._Observed(*map(jnp.float32, (mean, variance, normal)))
    H, g = jax.jit(realign._surface_equations)(observed, NO_SHAPE, 0.0)

    def cost(x):
        step, weight = x.reshape(k, 6), 1 / variance
        moved = mean + step[:, :3] + np.cross(step[:, 3:], mean)
        height = np.einsum("ckd,cd->ck", moved, normal)
        total = np.maximum(weight.sum(axis=1, keepdims=True), 1e-12)
        level = np.sum(weight * height, axis=1, keepdims=True) / total
        return 0.5 * np.sum(weight * (height - level) ** 2)

    gradient, hessian = derivatives(cost, 6 * k)
    np.testing.assert_allclose(g, gradient, rtol=1e-3, atol=1e-3 * np.abs(gradient).max())
    np.testing.assert_allclose(H, hessian, rtol=1e-3, atol=1e-3 * hessian.max())


def test_the_equations_of_the_odometry_are_the_derivatives_of_its_cost():
    rng = np.random.default_rng(1)
    k = 3
    turns = Rotation.from_rotvec(rng.uniform(-1, 1, (k, 3))).as_matrix()
    T = np.tile(np.eye(4), (k, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = turns, rng.uniform(-1, 1, (k, 3))
    root = rng.normal(size=(k, 6, 6))
    information = root @ root.transpose(0, 2, 1) / realign.CORRELATION
    information[0] = 0  # the first has none before it
    measured = np.linalg.inv(np.roll(T, 1, axis=0)) @ T

    def moved(x):
        step = np.tile(np.eye(4), (k, 1, 1))
        step[:, :3, :3] = Rotation.from_rotvec(x.reshape(k, 6)[:, 3:]).as_matrix()
        step[:, :3, 3] = x.reshape(k, 6)[:, :3]
        return step @ T

    def cost(x):
        now = moved(x)
        total = 0.0
        for i in range(1, k):
            left = np.linalg.inv(now[i - 1]) @ now[i] @ np.linalg.inv(measured[i])
            r = np.concatenate([left[:3, 3], Rotation.from_matrix(left[:3, :3]).as_rotvec()])
            total += 0.5 * realign.CORRELATION * r @ information[i] @ r
        return total

    odometry = Odometry(as_poses(measured), jnp.float32(information))
    equations = jax.jit(realign._odometry_equations)
    H, _ = equations(as_poses(T), odometry)
    _, hessian = derivatives(cost, 6 * k)
    np.testing.assert_allclose(H, hessian, rtol=2e-3, atol=2e-3 * hessian.max())
    small = 0.004 * rng.normal(size=6 * k)
    _, g = equations(as_poses(moved(small)), odometry)
    gradient = np.array([(cost(small + a) - cost(small - a)) / 2e-4 for a in 1e-4 * np.eye(6 * k)])
    np.testing.assert_allclose(g, gradient, atol=0.05 * np.abs(gradient).max())  # to first order
