import jax.numpy as jnp
import numpy as np
import pytest

from jaxshape.geometry import grid

BATCHES = [(), (1,), (2, 3)]


def random_boxes(*batch, seed=0):
    rng = np.random.default_rng(seed)
    lower = rng.uniform(-2, 1, (*batch, 3))
    return jnp.float32(lower), jnp.float32(lower + rng.uniform(0.2, 2, (*batch, 3)))


def corners_in_voxels(frame, lower, upper):
    return grid.voxel_from_object(frame, jnp.stack([lower, upper], axis=-2))


@pytest.mark.parametrize("batch", BATCHES)
def test_voxel_and_object_coordinates_are_inverse(batch):
    frame = grid.fit_box(*random_boxes(*batch))
    points = jnp.float32(np.random.default_rng(1).normal(size=(*batch, 5, 3)))
    voxels = grid.voxel_from_object(frame, points)
    np.testing.assert_allclose(grid.object_from_voxel(frame, voxels), points, atol=1e-5)


def test_voxel_centres_lie_at_halves_in_the_order_of_a_raveled_grid():
    index = np.stack(np.unravel_index(np.arange(64), (4, 4, 4)), axis=-1)
    np.testing.assert_array_equal(grid.voxel_centers(4), index + 0.5)


@pytest.mark.parametrize("batch", BATCHES)
def test_voxels_come_back_from_metres(batch):
    frame = grid.fit_box(*random_boxes(*batch))
    voxels = jnp.broadcast_to(grid.voxel_centers(4), (*batch, 64, 3))
    points = grid.object_from_voxel(frame, voxels)
    np.testing.assert_allclose(grid.voxel_from_object(frame, points), voxels, atol=1e-4)


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("margin", [0.0, 1.0, 2.5])
def test_the_box_fills_each_axis_up_to_the_margin(batch, margin):
    lower, upper = random_boxes(*batch)
    frame = grid.fit_box(lower, upper, resolution=16, margin=margin)
    corners = corners_in_voxels(frame, lower, upper)
    np.testing.assert_allclose(corners[..., 0, :], margin, atol=1e-4)
    np.testing.assert_allclose(corners[..., 1, :], 16 - margin, atol=1e-4)


@pytest.mark.parametrize("batch", BATCHES)
def test_one_scale_for_all_axes_fills_the_longest_and_centres_the_others(batch):
    lower, upper = random_boxes(*batch)
    frame = grid.fit_box_isotropic(lower, upper, resolution=16, margin=2.0)
    size = np.asarray(frame.voxel_size)
    np.testing.assert_allclose(size, np.broadcast_to(size[..., :1], size.shape), rtol=1e-6)
    corners = np.asarray(corners_in_voxels(frame, lower, upper))
    np.testing.assert_allclose(corners.mean(axis=-2), 8, atol=1e-4)
    sides = corners[..., 1, :] - corners[..., 0, :]
    np.testing.assert_allclose(sides.max(axis=-1), 12, atol=1e-4)
    given = np.asarray(upper - lower)
    np.testing.assert_allclose(sides, 12 * given / given.max(axis=-1, keepdims=True), atol=1e-3)


def test_a_point_lies_in_the_voxel_of_its_flat_index():
    rng = np.random.default_rng(0)
    voxels = np.float32(rng.uniform(-1, 6, (300, 3)))
    voxels[:4] = [[0, 0, 0], [5, 0, 0], [4.99, 4.99, 4.99], [np.nan, 1, 1]]
    index = np.asarray(grid.flat_index(jnp.asarray(voxels.T), 5))
    for point, i in zip(voxels, index, strict=True):
        inside = bool(np.all((point >= 0) & (point < 5)))
        assert i == (np.ravel_multi_index(tuple(point.astype(int)), (5, 5, 5)) if inside else 125)
    x, y, z = jnp.arange(5)[:, None, None] + 0.5, jnp.arange(5)[:, None] + 0.5, jnp.arange(5) + 0.5
    np.testing.assert_array_equal(grid.flat_index((x, y, z), 5).ravel(), np.arange(125))
