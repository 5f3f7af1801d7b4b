from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxshape.data.render import fit_intrinsics, render_depth
from jaxshape.geometry import camera, distance, evidence, grid
from jaxshape.geometry.pixels import Sensor, surface_pixels

N = 64  # fine voxels along each side
SIZE = 160  # pixels
CLEAN = Sensor(axial=3e-4)


@partial(jax.jit, static_argnames="sensor")
def measured(depth, intrinsics, T, frame, sensor=CLEAN):
    one = lambda depth, T: distance.measure(  # noqa: E731
        depth, jnp.isfinite(depth), intrinsics, T, frame, sensor, N
    )
    return jax.vmap(one)(depth, T)


def look(mesh, T, size=SIZE, sensor=CLEAN):
    """One field for each view of a mesh, and the frame of the fine grid."""
    intrinsics = fit_intrinsics(mesh, T, size)
    depth, _ = render_depth(mesh, T, intrinsics, size)
    frame = grid.fit_box_isotropic(*jnp.float32(mesh.bounds))
    return measured(jnp.asarray(depth), intrinsics, T, frame, sensor), frame


def around(radius=1.5):
    azimuth = jnp.repeat(jnp.arange(0.0, 360.0, 60.0), 2)
    elevation = jnp.tile(jnp.array([35.0, -35.0]), 6)
    return jax.jit(camera.on_sphere, static_argnums=2)(azimuth, elevation, radius)


@pytest.fixture(scope="module")
def ball():
    return look(trimesh.creation.icosphere(5, 0.3), around())


def centers(frame):
    points = grid.object_from_voxel(distance.fine_frame(frame, N), grid.voxel_centers(N))
    return np.asarray(points).reshape(N, N, N, 3)


def test_zero_crossings_of_a_sphere_lie_on_it(ball):
    field, frame = ball
    merged = distance.merge_all(field)
    d, trusted = np.asarray(distance.mean_distance(merged)), np.asarray(merged.weight) > 0
    points, voxel = centers(frame), float(distance.fine_frame(frame, N).voxel_size[0])
    found = []
    for axis in range(3):
        ends = [np.take(x, range(i, N - 1 + i), axis) for x in (d, points, trusted) for i in (0, 1)]
        d0, d1, p0, p1, t0, t1 = ends
        cross = t0 & t1 & ((d0 > 0) != (d1 > 0))
        share = (d0 / np.where(cross, d0 - d1, 1))[cross][:, None]
        found.append(p0[cross] + share * (p1 - p0)[cross])
    radius = np.linalg.norm(np.concatenate(found), axis=-1)
    assert len(radius) > 3000
    assert np.abs(np.median(radius) - 0.3) < 0.05 * voxel
    assert np.percentile(np.abs(radius - 0.3), 95) < 0.25 * voxel


def test_every_part_of_a_sphere_is_found_and_no_other(ball):
    field, frame = ball
    merged = distance.merge_all(field)
    radius = np.linalg.norm(centers(frame), axis=-1)
    voxel = float(distance.fine_frame(frame, N).voxel_size[0])
    crossed = np.asarray(evidence.crossings(merged))
    assert not crossed[np.abs(radius - 0.3) > voxel].any()
    assert crossed[np.abs(radius - 0.3) < 0.3 * voxel].mean() > 0.95
    assert (np.asarray(merged.free)[radius > 0.3 + 2 * voxel] > 0).mean() > 0.999
    assert not np.asarray(merged.free)[radius < 0.3 - 2 * voxel].any()


def test_the_order_of_frames_does_not_matter(ball):
    field, _ = ball
    forward, backward = (
        distance.merge_all(field),
        distance.merge_all(jax.tree.map(lambda x: x[::-1], field)),
    )
    for a, b in zip(forward, backward, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)


def test_merging_is_associative_with_nothing_as_its_identity(ball):
    a, b, c = (jax.tree.map(lambda x, i=i: x[i], ball[0]) for i in range(3))
    left = distance.merge(distance.merge(a, b), c)
    right = distance.merge(a, distance.merge(b, c))
    last = jax.tree.map(lambda x: x[2], distance.merge_cumulative(ball[0]))
    for x, y, z in zip(left, right, last, strict=True):
        np.testing.assert_allclose(x, y, atol=1e-6)
        np.testing.assert_allclose(x, z, atol=1e-6)
    for x, y in zip(distance.merge(a, distance.nothing_measured(N)), a, strict=True):
        np.testing.assert_array_equal(x, y)


def test_measuring_twice_gives_the_same_bits(ball):
    again, _ = look(trimesh.creation.icosphere(5, 0.3), around())
    for x, y in zip(again, ball[0], strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.mark.parametrize("thickness", [0.02, 0.03])
def test_a_thin_plate_seen_from_both_sides_keeps_both(thickness):
    """The grid's fine voxels measure 17 mm."""
    plate = trimesh.creation.box((1.0, thickness, 1.0))
    T = camera.on_sphere(jnp.array([0.0, 0.0]), jnp.array([50.0, -50.0]), 2.0)
    field, frame = look(plate, T)
    d = np.asarray(distance.mean_distance(distance.merge_all(field)))
    y = centers(frame)[0, :, 0, 1]
    column = d[N // 4 : -N // 4, :, N // 4 : -N // 4].mean(axis=(0, 2))
    near = np.abs(y) < 0.03
    outside = np.abs(y) > thickness / 2
    assert (column[near & outside] > 0).all() and (column[near & ~outside] < 0).all()
    signs = np.flatnonzero(np.diff(np.sign(column[np.abs(y) < 0.05])))
    assert len(signs) >= 2


def test_far_and_grazing_pixels_weigh_less():
    wall = trimesh.creation.box((1.0, 1.0, 0.1))

    def weight(azimuth, radius):
        T = camera.on_sphere(jnp.array([azimuth]), jnp.array([0.0]), radius)
        field, _ = look(wall, T, sensor=Sensor())
        return float(field.weight[0, N // 2, N // 2].max())  # in the middle of the wall

    assert weight(0.0, 3.0) < 0.5 * weight(0.0, 1.5)
    assert weight(65.0, 1.5) < 0.7 * weight(0.0, 1.5)


def test_rays_that_meet_nothing_free_what_they_pass_and_unknown_ones_nothing():
    frame = grid.fit_box_isotropic(jnp.full(3, -0.5), jnp.full(3, 0.5))
    T = camera.on_sphere(jnp.array([20.0]), jnp.array([30.0]), 3.0)
    lens = camera.intrinsics_for(60.0, SIZE)
    empty = measured(jnp.full((1, SIZE, SIZE), jnp.inf), lens, T, frame)
    unknown = measured(jnp.zeros((1, SIZE, SIZE)), lens, T, frame)
    np.testing.assert_array_equal(empty.free, 1)
    for x in (*unknown, empty.weight):
        np.testing.assert_array_equal(x, 0)


def test_a_coarse_image_makes_no_sieve():
    wall = trimesh.creation.box((1.0, 1.0, 0.1))
    T = camera.on_sphere(jnp.array([0.0]), jnp.array([0.0]), 1.5)
    field, frame = look(wall, T, size=24)  # a pixel covers three fine voxels and more
    crossed = np.asarray(evidence.crossings(distance.merge_all(field))).any(axis=2)
    assert crossed[6:-6, 6:-6].all()


def test_measuring_agrees_with_a_slow_reference():
    """Voxel by voxel, in float64, from the definition."""
    mesh = trimesh.creation.icosphere(3, 0.3)
    T = camera.on_sphere(jnp.array([25.0]), jnp.array([40.0]), 1.2)
    field, frame = look(mesh, T, sensor=Sensor())
    lens = fit_intrinsics(mesh, T, SIZE)
    depth = jnp.asarray(render_depth(mesh, T, lens, SIZE)[0][0])
    pixels = jax.device_get(jax.jit(surface_pixels)(depth, jnp.isfinite(depth), lens))
    fx, fy, cx, cy = map(float, lens)
    inverse = np.linalg.inv(np.asarray(T.as_matrix()[0], np.float64))
    size, points = float(distance.fine_frame(frame, N).voxel_size[0]), centers(frame)
    for i, j, k in np.random.default_rng(0).integers(0, N, (3000, 3)):
        x, y, z = inverse[:3, :3] @ points[i, j, k] + inverse[:3, 3]
        u, v = fx * x / z + cx, fy * y / z + cy
        if min(u % 1, v % 1, 1 - u % 1, 1 - v % 1) < 1e-3:
            continue  # rounding decides which pixel this is
        distance_sum = weight = free = 0.0
        if 0 <= u < SIZE and 0 <= v < SIZE:
            measured_depth = float(pixels.depth[int(v), int(u)])
            slope = float(pixels.slope[int(v), int(u)])
            sigma, ahead = 1.6e-3 * z * z, measured_depth - z
            d = ahead * slope if slope > 0 else ahead
            if measured_depth > 0:
                free = np.clip(d / max(size, 2 * sigma), 0, 1)
            if slope > 0 and d < 3 * max(size, sigma):
                fading = np.clip(1 + d / max(1.8 * size, 2 * sigma), 0, 1)
                weight = slope * fading / (1 + (sigma / 3e-3) ** 2)
                distance_sum = weight * d
        found = [float(x[0, i, j, k]) for x in field]
        np.testing.assert_allclose(found, [distance_sum, weight, free], atol=0.015)
