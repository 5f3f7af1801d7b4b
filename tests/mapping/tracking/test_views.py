import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxshape.data.render import add_sensor_noise
from jaxshape.geometry import camera
from jaxshape.geometry.camera import Intrinsics
from jaxshape.mapping.tracking import views

SHAPE = (60, 80)
LENS = Intrinsics(*jnp.float32([131.0, 128.0, 43.0, 28.5]))
RAYS = np.asarray(camera.unproject(LENS, jnp.ones(SHAPE)), np.float64)
TILTS = [(0.0, 0.0, -1.0), (0.5, 0.0, -1.0), (-0.3, -0.8, -1.0)]

view_of = jax.jit(views.view_of)
halved = jax.jit(views.halved)


def plane(tilt, z=1.2):
    """Unit normal of a plane that meets the optical axis at z, and its depth image."""
    normal = np.array(tilt) / np.linalg.norm(tilt)
    return normal, np.float32(z * normal[2] / (RAYS @ normal))


def degrees_between(a, b):
    return np.degrees(np.arccos(np.clip(np.sum(a * b, axis=-1), -1, 1)))


def with_gaps(depth, rng, share=0.1):
    """Some pixels that know nothing, and some whose rays met nothing."""
    depth = depth.copy()
    depth[rng.random(depth.shape) < share] = 0
    depth[rng.random(depth.shape) < share] = np.inf
    return depth


@pytest.mark.parametrize("tilt", TILTS)
def test_a_noisy_plane_has_its_normal(tilt):
    normal, depth = plane(tilt)
    cosine = -(RAYS @ normal) / np.linalg.norm(RAYS, axis=-1)
    noisy = add_sensor_noise(depth[None], cosine[None], np.random.default_rng(0))[0]
    view = view_of(noisy, LENS)
    found = np.asarray(view.normals)[np.asarray(views.is_oriented(view))]
    assert len(found) > 0.9 * depth.size
    mean = found.mean(axis=0) / np.linalg.norm(found.mean(axis=0))
    assert degrees_between(mean, normal) < 1
    assert np.quantile(degrees_between(found, normal), 0.9) < 6
    off = np.abs((np.asarray(view.points)[2:-2, 2:-2] - [0, 0, 1.2]) @ normal)
    assert np.sqrt(np.mean(off**2)) < 0.6 * 1.4e-3 * 1.2**2  # smoothing takes half of the noise


@pytest.mark.parametrize("tilt", TILTS)
def test_a_plane_without_noise_stays_as_it_is_up_to_the_border(tilt):
    normal, depth = plane(tilt)
    view = view_of(depth, LENS)
    known = np.asarray(views.is_oriented(view))
    np.testing.assert_array_equal(known[1:-1, 1:-1], True)
    angle = degrees_between(np.asarray(view.normals), normal)
    np.testing.assert_allclose(angle[1:-1, 1:-1], 0, atol=0.5)
    np.testing.assert_allclose((view.points - jnp.array([0, 0, 1.2])) @ normal, 0, atol=3e-4)
    np.testing.assert_array_equal(view.depth, depth)  # as measured


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.03))
def test_normals_are_of_unit_length_towards_the_camera_or_zero(seed, roughness):
    rng = np.random.default_rng(seed)
    depth = plane(TILTS[1])[1] * rng.uniform(1 - roughness, 1 + roughness, SHAPE)
    view = view_of(with_gaps(np.float32(depth), rng), LENS)
    length = np.linalg.norm(view.normals, axis=-1)
    known = np.asarray(views.is_oriented(view))
    np.testing.assert_array_equal(known, length > 0)
    np.testing.assert_allclose(length[known], 1, atol=1e-5)
    assert (np.sum(np.asarray(view.normals * view.points), axis=-1)[known] < 0).all()
    assert np.isfinite(view.points).all()


def test_nothing_is_known_of_a_pixel_or_its_neighbours_where_nothing_was_measured():
    depth = plane(TILTS[1])[1]
    depth[20, 30], depth[40, 50] = 0, np.inf
    known = np.asarray(views.is_oriented(view_of(depth, LENS)))
    expected = np.zeros(SHAPE, bool)
    expected[1:-1, 1:-1] = True
    for row, column in ((20, 30), (40, 50)):
        expected[row - 1 : row + 2, column] = expected[row, column - 1 : column + 2] = False
    np.testing.assert_array_equal(known, expected)


def test_two_surfaces_are_neither_mixed_nor_joined_by_a_normal():
    near, far = plane(TILTS[0], 1.0)[1], plane(TILTS[0], 1.15)[1]
    depth = np.where(np.arange(SHAPE[1]) < 40, near, far)
    view = view_of(depth, LENS)
    np.testing.assert_allclose(view.points[..., 2], depth, rtol=1e-5)
    known = np.asarray(views.is_oriented(view))
    assert not known[:, 39:41].any() and known[1:-1, 1:39].all() and known[1:-1, 41:-1].all()


def test_a_mirrored_image_has_mirrored_normals():
    rng = np.random.default_rng(1)
    depth = with_gaps(np.float32(plane(TILTS[2])[1] * rng.normal(1, 2e-3, SHAPE)), rng, 0.02)
    view = view_of(depth, LENS)
    mirrored = view_of(depth[:, ::-1].copy(), LENS._replace(cx=SHAPE[1] - LENS.cx))
    expected = view.normals[:, ::-1] * jnp.array([-1, 1, 1])
    np.testing.assert_allclose(mirrored.normals, expected, atol=1e-3)


@pytest.mark.parametrize("tilt", TILTS)
def test_half_an_image_measures_the_same_plane(tilt):
    normal, depth = plane(tilt)
    half, lens = halved(depth, LENS)
    assert half.shape == (30, 40)
    points = np.asarray(camera.unproject(lens, half), np.float64)
    np.testing.assert_allclose((points - [0, 0, 1.2]) @ normal, 0, atol=2e-4)


def test_half_an_image_takes_the_nearest_surface_of_each_block():
    """Against a loop over the blocks, with an odd row and column to spare."""
    rng = np.random.default_rng(0)
    depth = with_gaps(np.float32(rng.choice([1.0, 1.01, 1.02, 1.5], (31, 41))), rng, 0.3)
    half = np.asarray(halved(depth, LENS)[0])
    for row, column in np.ndindex(15, 20):
        block = depth[2 * row : 2 * row + 2, 2 * column : 2 * column + 2].ravel()
        measured = block[(block > 0) & (block < np.inf)]
        if len(measured):
            expected = measured[measured < 1.03 * measured.min()].mean()
        else:
            expected = np.inf if np.isinf(block).sum() > 2 else 0
        assert half[row, column] == pytest.approx(expected), block
    assert {0, np.inf} < set(half.ravel())
