import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from jaxshape.geometry import camera
from jaxshape.geometry.camera import Intrinsics

BATCHES = [(), (2, 3)]
random_views = jax.jit(camera.random_views, static_argnums=(1, 2))
INTRINSICS = Intrinsics(*jnp.array([50.0, 60.0, 7.0, 5.5]))


def random_array(*shape, low=-1.0, high=1.0, seed=0):
    return jnp.asarray(np.random.default_rng(seed).uniform(low, high, shape), jnp.float32)


def angles_of(T_object_camera):
    """Azimuth in [0, 360) and elevation of each camera about the origin, and its distance."""
    x, y, z = np.moveaxis(np.asarray(T_object_camera.translation(), np.float64), -1, 0)
    radius = np.sqrt(x**2 + y**2 + z**2)
    return np.rad2deg(np.arctan2(x, z)) % 360, np.rad2deg(np.arcsin(y / radius)), radius


@pytest.mark.parametrize("batch", BATCHES)
def test_projecting_what_was_unprojected_gives_pixel_centres_and_depth(batch):
    depth = random_array(*batch, 4, 6, low=0.5, high=3.0)
    points = camera.unproject(INTRINSICS, depth)
    assert points.shape == (*batch, 4, 6, 3)
    pixels, projected_depth = camera.project(INTRINSICS, points)
    np.testing.assert_allclose(projected_depth, depth)
    rows, columns = np.indices((4, 6))
    expected = np.broadcast_to(np.stack([columns + 0.5, rows + 0.5], axis=-1), pixels.shape)
    np.testing.assert_allclose(pixels, expected, atol=1e-4)


def test_projection_is_that_of_the_pinhole_matrix():
    points = random_array(20, 3) + jnp.array([0.0, 0.0, 2.0])
    K = np.array([[50.0, 0, 7.0], [0, 60.0, 5.5], [0, 0, 1]])
    homogeneous = np.asarray(points) @ K.T
    pixels, _ = camera.project(INTRINSICS, points)
    np.testing.assert_allclose(pixels, homogeneous[:, :2] / homogeneous[:, 2:], rtol=1e-5)


def test_points_at_or_behind_the_camera_project_to_finite_pixels():
    pixels, depth = camera.project(INTRINSICS, jnp.array([[0.3, 0.2, 0.0], [0.3, 0.2, -1.0]]))
    assert np.isfinite(pixels).all()
    np.testing.assert_array_equal(depth, [0.0, -1.0])


def test_the_field_of_view_reaches_from_edge_to_edge_of_the_image():
    intrinsics = camera.intrinsics_for(90.0, 64)
    pixels, _ = camera.project(intrinsics, jnp.array([[-1.0, -1.0, 1.0], [1.0, 1.0, 1.0]]))
    np.testing.assert_allclose(pixels, [[0, 0], [64, 64]], atol=1e-4)


@pytest.mark.parametrize("batch", BATCHES)
def test_transform_agrees_with_jaxlie(batch):
    parameters, points = random_array(*batch, 7), random_array(*batch, 7, 3)

    @jax.jit
    def both_ways(parameters, points):
        T = jaxlie.SE3(parameters).normalize()
        return camera.transform(T, points), jaxlie.SE3(T.wxyz_xyz[..., None, :]) @ points

    transformed, expected = both_ways(parameters, points)
    np.testing.assert_allclose(transformed, expected, atol=1e-5)


@pytest.mark.parametrize("batch", BATCHES)
def test_look_at_keeps_the_image_level_and_upright_and_its_axis_on_the_target(batch):
    eye, target = random_array(*batch, 3), random_array(*batch, 3, seed=1) + 2.0

    @jax.jit
    def look(eye, target):
        T_world_camera = camera.look_at(eye, target)
        seen = camera.transform(T_world_camera.inverse(), target[..., None, :])
        return T_world_camera.as_matrix(), seen[..., 0, :]

    T, seen = map(np.asarray, look(eye, target))
    R = T[..., :3, :3]
    np.testing.assert_allclose(np.linalg.det(R), 1, atol=1e-5)
    np.testing.assert_allclose(R[..., 1, 0], 0, atol=1e-6)  # image x is horizontal
    assert (R[..., 1, 1] < 0).all()  # image y points down
    np.testing.assert_allclose(T[..., :3, 3], eye, atol=1e-6)
    distance = np.linalg.norm(target - eye, axis=-1)
    np.testing.assert_allclose(seen[..., 2], distance, rtol=1e-5)
    np.testing.assert_allclose(seen[..., :2], 0, atol=1e-5)


def test_from_the_front_the_objects_right_hand_side_appears_on_the_right():
    """Seen from +z, world +x is image +x and world +y is image -y."""
    T_object_camera = camera.on_sphere(jnp.array(0.0), jnp.array(0.0), 2.0)
    seen = camera.transform(T_object_camera.inverse(), jnp.eye(3))
    np.testing.assert_allclose(seen, [[1, 0, 2], [0, -1, 2], [0, 0, 1]], atol=1e-6)


def test_random_views_fill_their_ranges_of_azimuth_and_elevation():
    views = random_views(jax.random.key(3), 2000, 1.7)
    azimuth, elevation, radius = angles_of(views)
    counts, _ = np.histogram(azimuth, bins=12, range=(0, 360))
    assert counts.min() > 100
    assert 30 - 1e-3 <= elevation.min() < 30.5
    assert 59.5 < elevation.max() <= 60 + 1e-3
    np.testing.assert_allclose(radius, 1.7, rtol=1e-5)
    assert abs(np.corrcoef(azimuth, elevation)[0, 1]) < 0.1


def test_random_views_are_a_function_of_the_key():
    views = [random_views(jax.random.key(k), 3, 1.0).wxyz_xyz for k in (0, 0, 1)]
    np.testing.assert_array_equal(views[0], views[1])
    assert not np.allclose(views[0], views[2])


def test_an_orbit_starts_in_front_and_turns_towards_plus_x():
    azimuth, elevation, radius = angles_of(camera.orbit(18, 2.5))
    np.testing.assert_allclose((azimuth - 20 * np.arange(18) + 180) % 360, 180, atol=1e-3)
    np.testing.assert_allclose(elevation, 30, atol=1e-3)
    np.testing.assert_allclose(radius, 2.5, rtol=1e-5)


@pytest.mark.parametrize("channels", [(), (3,)])
def test_an_image_is_looked_up_at_the_pixel_that_holds_a_point(channels):
    rng = np.random.default_rng(0)
    image = rng.normal(size=(5, 7, *channels)).astype(np.float32)
    pixels = np.float32(rng.uniform(-3, 10, (4, 200, 2)))
    pixels[0, :4] = [[0, 0], [7, 0], [6.99, 4.99], [np.nan, 1]]
    found = np.asarray(camera.look_up(jnp.asarray(image), jnp.asarray(pixels)))
    assert found.shape == (4, 200, *channels)
    for (u, v), value in zip(pixels.reshape(-1, 2), found.reshape(-1, *channels), strict=True):
        inside = 0 <= u < 7 and 0 <= v < 5
        np.testing.assert_array_equal(value, image[int(v), int(u)] if inside else 0)
    assert (found != 0).any() and (found == 0).any()


def test_a_camera_matrix_gives_the_camera_that_projects_like_it():
    K = np.array([[520.0, 0, 320.5], [0, 510, 240.25], [0, 0, 1]])
    p = np.array([0.3, -0.2, 1.7])
    pixels, _ = camera.project(camera.intrinsics_of(K), jnp.float32(p))
    np.testing.assert_allclose(pixels, (K @ p / p[2])[:2], rtol=1e-6)
