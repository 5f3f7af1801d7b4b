import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxshape.geometry.camera import Intrinsics
from jaxshape.geometry.pixels import Sensor, SurfacePixels, pack, surface_pixels, unpack

H, W = 60, 80
LENS = Intrinsics(*jnp.array([70.0, 75.0, 41.0, 29.0]))
CLEAN = Sensor(axial=1e-4)
fit = jax.jit(surface_pixels, static_argnums=3)


def rays():
    row, column = np.indices((H, W)) + 0.5
    fx, fy, cx, cy = map(float, LENS)
    return np.stack([(column - cx) / fx, (row - cy) / fy, np.ones((H, W))], axis=-1)


def plane(normal, offset):
    """Depth image of the plane normal . p = offset."""
    return np.float32(offset / (rays() @ np.asarray(normal)))


def shown(depth, sensor=CLEAN):
    depth = jnp.asarray(depth, jnp.float32)
    return fit(depth, depth > 0, LENS, sensor)


@pytest.mark.parametrize("tilt", [0.0, 30.0, 55.0])
def test_depth_and_slope_of_a_plane_are_exact(tilt):
    angle = np.deg2rad(tilt)
    normal = np.array([np.sin(angle) * 0.6, np.sin(angle) * 0.8, np.cos(angle)])
    depth = plane(normal, 1.3)
    found = shown(depth)
    inner = np.s_[12:-3, 12:-3]  # the first pixels look along the steepest plane
    np.testing.assert_allclose(found.depth[inner], depth[inner], rtol=1e-5)
    # One metre along the axis moves a point on the ray by the ray, and that far from the plane.
    np.testing.assert_allclose(found.slope[inner], (rays() @ normal)[inner], rtol=0.01)


def test_averaging_takes_noise_away_and_stops_at_jumps():
    rng = np.random.default_rng(0)
    depth = np.where(np.arange(W) < W // 2, 1.0, 2.0) * np.ones((H, 1))
    noisy = depth + rng.normal(0, 2e-3, depth.shape) * depth**2
    found = shown(noisy, Sensor(axial=2e-3))
    errors = np.asarray(found.depth - depth)[2:-2, 2 : W // 2 - 2]
    assert errors.std() < 0.4 * 2e-3
    assert np.abs(np.asarray(found.depth)[:, W // 2 - 1] - 1).max() < 0.01


def test_the_far_side_of_a_jump_makes_no_surface_and_frees_only_up_to_the_near_side():
    depth = np.where(np.arange(W) < W // 2, 1.0, 2.0) * np.ones((H, 1))
    found = shown(depth)
    np.testing.assert_array_equal(np.asarray(found.slope)[:, W // 2] == 0, True)
    np.testing.assert_allclose(np.asarray(found.depth)[:, W // 2], 1.0, rtol=1e-6)
    assert (np.asarray(found.slope)[:, : W // 2] > 0).all()


def test_a_flying_pixel_makes_no_surface():
    depth = np.full((H, W), 1.0)
    depth[:, W // 2 :] = 3.0
    depth[:, W // 2] = 1.7
    assert (np.asarray(shown(depth).slope)[:, W // 2] == 0).all()


def test_unknown_pixels_stay_unknown_and_empty_ones_empty():
    depth = np.full((H, W), np.inf)
    depth[:, :20] = 0
    found = shown(depth)
    assert (found.depth[:, :20] == 0).all() and np.isinf(found.depth[:, 20:]).all()
    assert (found.slope == 0).all()


def test_a_pixel_that_is_not_segmented_makes_no_surface_but_keeps_its_depth():
    depth = jnp.full((H, W), 1.5)
    found = fit(depth, jnp.zeros((H, W), bool), LENS, CLEAN)
    assert (found.slope == 0).all()
    np.testing.assert_allclose(found.depth, 1.5, rtol=1e-6)


def test_packing_keeps_depth_to_a_tenth_of_a_millimetre():
    depth = jnp.array([0.0, 0.4321, 1.0, 1.99999, 3.7, jnp.inf])
    slope = jnp.array([0.0, 0.1, 0.333, 1.0, 1.3, 0.0])
    found = unpack(pack(SurfacePixels(depth, slope)))
    np.testing.assert_allclose(found.depth, depth, atol=2e-4)
    np.testing.assert_allclose(found.slope, slope, atol=4e-3)
    assert found.depth[0] == 0 and np.isinf(found.depth[-1])


def test_sensors_check_themselves():
    with pytest.raises(ValueError, match="axial"):
        Sensor(axial=-1.0)
