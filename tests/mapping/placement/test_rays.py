"""Points of frames, against the pixels they come from."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.spatial import KDTree

from jaxshape.geometry import camera
from jaxshape.mapping.placement.rays import FREE_POINTS, RaySamples, pooled, sample_rays


@pytest.fixture(scope="module")
def frame():
    """A block of the object before a wall, beside an opening; and a corner of which nothing is
    known."""
    depth = np.full((40, 60), 2.4, np.float32)
    depth[:, :15] = np.inf
    depth[:5, 40:] = 0
    depth[12:30, 25:40] = 1.9
    segmented = np.zeros(depth.shape, bool)
    segmented[10:30, 25:40] = True  # two rows too many, on the wall
    intrinsics = camera.Intrinsics(*jnp.array([60.0, 60.0, 30.0, 20.0]))
    return jnp.asarray(depth), jnp.asarray(segmented), intrinsics


@pytest.fixture(scope="module")
def seen(frame):
    return jax.jit(sample_rays)(jax.random.key(0), *frame)


def depth_at(points, depth, intrinsics):
    pixels, z = jax.jit(camera.project)(intrinsics, points)
    column, row = np.floor(np.asarray(pixels) + 1e-4).astype(int).T
    return np.asarray(z), np.asarray(depth)[row, column], (row, column)


def test_surface_points_are_those_of_segmented_pixels(frame, seen):
    depth, segmented, intrinsics = frame
    z, measured, pixel = depth_at(seen.surface, depth, intrinsics)
    np.testing.assert_allclose(z, measured, rtol=1e-5)
    assert np.asarray(segmented)[pixel].all()
    assert len(np.unique(pixel, axis=1).T) == segmented.sum()


def test_free_points_lie_well_in_front_of_what_was_met(frame, seen):
    depth, _, intrinsics = frame
    z, measured, pixel = depth_at(seen.free, depth, intrinsics)
    assert (z < measured - 0.03).all()  # nowhere where nothing is known: there, depth is 0
    assert np.isinf(measured).any() and (measured == np.float32(1.9)).any()
    behind = z > 1.9
    assert behind.any() and (np.linalg.norm(seen.free - seen.surface.mean(0), axis=1) < 1).all()


@pytest.fixture(scope="module")
def nothing(frame):
    depth, segmented, intrinsics = frame
    return jax.jit(sample_rays)(jax.random.key(0), depth, jnp.zeros_like(segmented), intrinsics)


def test_a_frame_without_the_object_gives_nothing_finite(nothing):
    assert jnp.isnan(nothing.surface).all() and jnp.isnan(nothing.away).all()


def test_pooling_takes_as_much_of_each_frame_and_moves_it_to_the_world(seen):
    turned = jaxlie.SO3.from_y_radians(jnp.array([0.0, np.pi]))
    shift = jnp.array([[0.0, 0, 0], [0, 0.5, 0]])
    two = jax.tree.map(lambda x: jnp.stack([x, x]), seen)
    both = jax.jit(pooled)(two, jaxlie.SE3.from_rotation_and_translation(turned, shift))
    assert both.surface.shape == seen.surface.shape and both.free.shape == (FREE_POINTS, 3)
    is_second = both.surface[:, 2] < 0  # turned by half
    assert is_second.sum() == len(both.surface) // 2
    np.testing.assert_allclose(both.away[::2], 0, atol=1e-6)  # seen from two opposite sides
    for name in ("surface", "free"):
        points = np.asarray(getattr(seen, name))
        moved = np.concatenate([points, points * (-1, 1, -1) + (0, 0.5, 0)])
        distance, _ = KDTree(moved).query(getattr(both, name))
        assert distance.max() < 1e-6


def test_free_points_are_as_many_on_a_side_that_few_frames_saw():
    """A cube, free on both sides: one frame sees the right one, three see the left one."""
    rng = np.random.default_rng(0)
    cube = rng.uniform(-0.1, 0.1, (4, 8192, 3))
    beside = rng.uniform((0.12, -0.3, -0.3), (0.68, 0.3, 0.3), (4, 16384, 3))
    beside[1:, :, 0] *= -1
    frames = RaySamples(*map(jnp.float32, (cube, beside, np.ones((4, 3)))))
    x = np.asarray(jax.jit(pooled)(frames, jaxlie.SE3.identity((4,))).free[:, 0])
    assert 0.47 < np.mean(x < 0) < 0.53
    near, far = np.abs(x) < 0.3, np.abs(x) > 0.5  # of the same volume
    assert near.sum() > 4 * far.sum() > 0


def test_pooling_leaves_frames_without_the_object_out(seen, nothing):
    three = jax.tree.map(lambda x, y: jnp.stack([y, x, x]), seen, nothing)
    found = jax.jit(pooled)(three, jaxlie.SE3.identity((3,)))
    np.testing.assert_allclose(found.away, seen.away, rtol=1e-6)
    assert set(np.asarray(found.surface).ravel()) <= set(np.asarray(seen.surface).ravel())
    assert set(np.asarray(found.free).ravel()) <= set(np.asarray(seen.free).ravel())
    none = jax.jit(pooled)(jax.tree.map(lambda x: x[None], nothing), jaxlie.SE3.identity((1,)))
    assert jnp.isnan(none.surface).all()
