from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxshape import orbit, random_chair
from jaxshape.data import render
from jaxshape.data.virtual_cameras import SensorNoise
from jaxshape.geometry import camera

SIZE = 48
CLEAN = SensorNoise(axial=0.0, lateral=0.0, quantization=1e-9, dropout=0.0, grazing=91.0)
VIEWS = jax.jit(camera.on_sphere, static_argnums=2)(
    jnp.array([0.0, 40.0, 200.0]), jnp.array([0.0, 35.0, -50.0]), 1.5
)
FROM_THE_FRONT = jax.tree.map(lambda x: x[:1], VIEWS)


def rays(T_object_camera, intrinsics):
    """Origin, and direction of unit depth, of every pixel's ray in the object frame."""
    rows, columns = np.indices((SIZE, SIZE))
    fx, fy, cx, cy = map(float, intrinsics)
    directions = [(columns + 0.5 - cx) / fx, (rows + 0.5 - cy) / fy, np.ones((SIZE, SIZE))]
    T = np.asarray(T_object_camera.as_matrix(), np.float64)[:, None, None]
    return T[..., :3, 3], np.einsum("...ij,...j->...i", T[..., :3, :3], np.stack(directions, -1))


def rendered(mesh, views=VIEWS):
    intrinsics = render.fit_intrinsics(mesh, views, SIZE)
    return *render.render_depth(mesh, views, intrinsics, SIZE), *rays(views, intrinsics)


def noisy(depth, noise, *, cosine=1.0, seed=0):
    depth = np.asarray(depth, np.float32)
    cosine = np.full(depth.shape, cosine, np.float32)
    return render.add_sensor_noise(depth, cosine, np.random.default_rng(seed), noise)


def plane(z, size=200):
    return np.full((1, size, size), z, np.float32)


def step_between(near, far):
    depth = plane(near, 40)
    depth[:, :, 20:] = far
    return depth


def test_a_camera_inside_a_room_sees_its_walls_everywhere():
    """The bounding box of what it sees reaches behind it."""
    room = trimesh.creation.box(extents=(4.0, 4.0, 4.0))
    depth, _ = render.render_depth(room, VIEWS, camera.intrinsics_for(60.0, SIZE), SIZE)
    assert np.isfinite(depth).all()
    np.testing.assert_allclose(depth[0], 3.5, atol=1e-5)  # 1.5 m in front of the middle


def test_depth_of_a_box_is_that_of_the_slab_method():
    mesh = trimesh.creation.box((0.6, 0.4, 0.5))
    depth, _, origins, directions = rendered(mesh)
    with np.errstate(divide="ignore"):
        crossings = (mesh.bounds[:, None, None, None] - origins) / directions
    enters, leaves = crossings.min(axis=0).max(axis=-1), crossings.max(axis=0).min(axis=-1)
    clear = np.abs(leaves - enters) > 1e-4  # rays along an edge may fall on either side
    expected = np.where(enters < leaves, enters, np.inf)
    assert np.isinf(expected).any() and np.isfinite(expected).any()
    np.testing.assert_allclose(depth[clear], expected[clear], atol=2e-6)


def test_depth_and_cosine_of_a_sphere_are_the_analytic_ones():
    radius = 0.3
    depth, cosine, origins, directions = rendered(trimesh.creation.icosphere(4, radius))
    a, b = np.sum(directions**2, -1), np.sum(directions * origins, -1)
    c = np.sum(origins**2, -1) - radius**2
    discriminant = b**2 - a * c
    inside = discriminant > 0.05 * a * radius**2
    expected = ((-b - np.sqrt(np.where(inside, discriminant, 0))) / a)[inside]
    np.testing.assert_allclose(depth[inside], expected, atol=2e-3)
    assert np.isinf(depth[discriminant < 0]).all()  # the mesh lies inside the sphere
    assert (cosine[discriminant < 0] == 1).all()
    normal = (np.broadcast_to(origins, directions.shape)[inside]
              + expected[:, None] * directions[inside]) / radius  # fmt: skip
    facing = -np.sum(normal * directions[inside], -1) / np.sqrt(a[inside])
    np.testing.assert_allclose(cosine[inside], facing, atol=0.05)


@pytest.mark.parametrize("order", [1, -1])
def test_the_nearer_of_two_plates_hides_the_other(order):
    plates = [trimesh.creation.box((side, side, 0.02)) for side in (0.4, 1.0)]
    plates[0].apply_translation([0, 0, 0.2])
    plates[1].apply_translation([0, 0, -0.2])
    mesh = trimesh.util.concatenate(plates[::order])
    depth, _, origins, directions = rendered(mesh, FROM_THE_FRONT)
    near = origins + directions * (1.5 - 0.21)
    on_near = np.abs(near[..., :2]).max(-1) < 0.199
    beside = np.abs(near[..., :2]).max(-1) > 0.201
    np.testing.assert_allclose(depth[on_near], 1.5 - 0.21, atol=1e-5)
    seen_beside = depth[beside & np.isfinite(depth)]
    assert on_near.sum() > 100 and seen_beside.size > 100
    np.testing.assert_allclose(seen_beside, 1.5 + 0.19, atol=1e-5)


@pytest.mark.parametrize("distance", [2.0, 0.3])
def test_without_embree_the_same_surface_is_seen(distance, monkeypatch):
    """From outside, and from so near that parts of the chair lie behind the camera."""
    views = orbit(2, distance)
    intrinsics = camera.intrinsics_for(60.0, 64)
    depth, cosine = render.render_depth(random_chair(7), views, intrinsics, 64)
    monkeypatch.setattr(render, "has_embree", False)
    monkeypatch.setattr("jaxshape.data.rays.PAIRS", 10_000)
    other_depth, other_cosine = render.render_depth(random_chair(7), views, intrinsics, 64)
    same = np.isclose(other_depth, depth, atol=1e-4) & np.isclose(other_cosine, cosine, atol=1e-3)
    assert 0.02 < np.isfinite(depth).mean() < 1
    assert same.mean() > 0.995  # rays that graze an edge may hit either side


def test_the_lens_just_holds_the_bounding_box_in_every_view():
    mesh = trimesh.creation.box((0.9, 0.5, 0.3))
    intrinsics = render.fit_intrinsics(mesh, VIEWS, SIZE)
    corners = jnp.float32(trimesh.bounds.corners(mesh.bounds))
    seen = camera.transform(VIEWS.inverse(), jnp.stack([corners] * 3))
    pixels, _ = camera.project(intrinsics, seen)
    reach = np.abs(pixels - SIZE / 2)
    np.testing.assert_allclose(reach.max(), SIZE / 2 - 1, atol=1e-3)
    assert reach.max(axis=(1, 2)).min() < SIZE / 2 - 2  # one lens for all views


def test_axial_noise_grows_with_the_square_of_depth():
    noise = replace(CLEAN, axial=1.4e-3)
    for z in (1.0, 3.0):
        errors = noisy(plane(z), noise) - z
        np.testing.assert_allclose(errors.std(), 1.4e-3 * z**2, rtol=0.03)
        assert abs(errors.mean()) < 1e-4 * z**2


@pytest.mark.parametrize("z", [1.0, 3.0])
def test_depth_comes_in_steps_that_grow_with_its_square(z):
    step = 2.8e-3 * z**2
    depth = np.broadcast_to(np.linspace(z - 3 * step, z + 3 * step, 1000), (1, 3, 1000))
    levels = np.unique(noisy(depth, replace(CLEAN, quantization=2.8e-3)))
    assert 6 <= levels.size <= 8
    np.testing.assert_allclose(np.diff(levels), step, rtol=0.1)


def test_dropout_loses_edges_alone():
    measured = noisy(step_between(1.0, 1.5), replace(CLEAN, dropout=1.0))
    lost = np.zeros_like(measured, bool)
    lost[:, :, 19:21] = True
    np.testing.assert_array_equal(measured == 0, lost)
    some = noisy(step_between(1.0, 1.5), replace(CLEAN, dropout=0.5), seed=1)
    assert 0.3 < (some[lost] == 0).mean() < 0.7


def test_steps_too_small_to_be_edges_lose_nothing():
    assert (noisy(step_between(1.0, 1.02), replace(CLEAN, dropout=1.0)) > 0).all()


def test_grazing_surfaces_are_lost_and_others_kept():
    noise = replace(CLEAN, grazing=80.0)
    assert not noisy(plane(1.0), noise, cosine=np.cos(np.deg2rad(81))).any()
    assert noisy(plane(1.0), noise, cosine=np.cos(np.deg2rad(79))).all()


def test_jitter_across_the_image_moves_edges_and_nothing_else():
    depth = step_between(1.0, np.inf)
    measured = noisy(depth, replace(CLEAN, lateral=1.0))
    moved = ~np.isclose(measured, depth, atol=1e-5)
    assert moved[:, :, 19:21].any()
    assert not moved[:, :, :19].any() and not moved[:, :, 21:].any()


def test_background_stays_empty_away_from_edges():
    depth = step_between(1.0, np.inf)
    measured = noisy(depth, SensorNoise())
    assert np.isinf(measured[:, :, 21:]).all()
    assert np.isfinite(measured[:, :, :19]).all()
    assert not np.isnan(measured).any()
    assert np.isinf(noisy(plane(np.inf), SensorNoise())).all()


def test_noise_is_a_function_of_the_generator():
    first, again, other = (noisy(plane(1.0, 20), SensorNoise(), seed=s) for s in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()
