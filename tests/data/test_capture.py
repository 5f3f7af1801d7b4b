import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.ndimage import binary_dilation

from jaxshape.data.capture import (
    camera_distance,
    capture,
    discretize,
    fuse_frames,
    fused_frames,
    fused_grids,
    measure_frames,
    sensor_of,
)
from jaxshape.data.virtual_cameras import CAMERAS, VirtualCamera
from jaxshape.geometry import camera, fusion, grid
from jaxshape.geometry.evidence import soft_grids
from jaxshape.geometry.fusing import Distances, Points

AZIMUTHS = jnp.repeat(jnp.arange(0.0, 360.0, 60.0), 2)
ELEVATIONS = jnp.tile(jnp.array([35.0, -35.0]), 6)
on_sphere = jax.jit(camera.on_sphere, static_argnums=2)


def look_around(mesh, *, noise=False, seed=0):
    """12 views from above and below, around the whole object."""
    views = on_sphere(AZIMUTHS, ELEVATIONS, 1.5 * 0.5)
    return capture(mesh, views, noise=noise, seed=seed, camera=VirtualCamera(64, 64, None))


def chair_like():
    """A seat, a back and a leg: parts that hide each other."""
    parts = [((0.4, 0.04, 0.4), (0, 0, 0)), ((0.4, 0.4, 0.04), (0, 0.2, -0.18)),
             ((0.06, 0.36, 0.06), (0, -0.2, 0))]  # fmt: skip
    boxes = [trimesh.creation.box(size) for size, _ in parts]
    for box, (_, place) in zip(boxes, parts, strict=True):
        box.apply_translation(place)
    return trimesh.util.concatenate(boxes)


@pytest.fixture(scope="module")
def ellipsoid():
    mesh = trimesh.creation.icosphere(3)
    mesh.apply_scale([0.2, 0.3, 0.15])
    return look_around(mesh)


def within_a_voxel(surface):
    return binary_dilation(np.asarray(surface), np.ones((3, 3, 3)))


def test_what_a_clean_frame_measures_lies_within_a_voxel_of_the_surface(ellipsoid):
    for captured in (ellipsoid, look_around(chair_like())):
        occupied = np.asarray(fusion.occupied(measure_frames(captured)))
        assert occupied.any(axis=(1, 2, 3)).all()
        assert not (occupied & ~within_a_voxel(captured.surface)).any()


def test_views_from_all_around_cover_a_convex_surface(ellipsoid):
    union = fusion.occupied(measure_frames(ellipsoid)).any(axis=0)
    assert (union & ellipsoid.surface).sum() > 0.75 * ellipsoid.surface.sum()
    # What is missing are voxels whose corner alone the surface cuts: their neighbours are seen.
    assert not (ellipsoid.surface & ~within_a_voxel(union)).any()


def test_no_clean_frame_sees_through_the_inside_of_a_solid(ellipsoid):
    seen_through = np.asarray(measure_frames(ellipsoid).seen_through)
    x, y, z = np.indices((32, 32, 32)) + 0.5 - 16
    inside = x**2 + y**2 + z**2 < 13**2  # the fitted box makes it a sphere of radius 15
    outside = x**2 + y**2 + z**2 > 17**2
    assert not (seen_through & inside).any()
    assert seen_through.any(axis=0)[outside].all()


def test_the_surface_touches_the_margins_and_is_hollow(ellipsoid):
    filled = np.argwhere(np.asarray(ellipsoid.surface))
    np.testing.assert_array_equal(filled.min(axis=0), 1)
    assert (filled.max(axis=0) >= 30).all() and (filled.max(axis=0) <= 31).all()
    assert not ellipsoid.surface[8:24, 8:24, 8:24].any()


def test_noise_changes_depth_but_neither_the_surface_nor_the_poses(ellipsoid):
    mesh = trimesh.creation.icosphere(3)
    mesh.apply_scale([0.2, 0.3, 0.15])
    first, again = (look_around(mesh, noise=True) for _ in range(2))
    np.testing.assert_array_equal(first.depth, again.depth)
    np.testing.assert_array_equal(first.surface, ellipsoid.surface)
    assert (first.depth != ellipsoid.depth).any()
    occupied = np.asarray(fusion.occupied(measure_frames(first)))
    strays = occupied & ~within_a_voxel(first.surface)
    assert strays.sum() < 0.01 * occupied.sum()


def test_discretising_points_agrees_with_a_histogram():
    points = np.random.default_rng(0).normal(0, 0.3, (2000, 3)).astype(np.float32)
    lower, upper = np.float32([-0.5, -0.4, -0.6]), np.float32([0.5, 0.6, 0.4])
    frame = grid.fit_box(jnp.asarray(lower), jnp.asarray(upper))
    edges = [o + s * np.arange(33) for o, s in zip(frame.origin, frame.voxel_size, strict=True)]
    expected, _ = np.histogramdd(points, bins=edges)
    np.testing.assert_array_equal(discretize(points, frame), expected > 0)


def test_the_camera_stands_in_proportion_to_the_objects_diagonal():
    box = trimesh.creation.box((0.3, 0.4, 1.2))
    np.testing.assert_allclose(camera_distance(box), 1.5 * 1.3)


@pytest.mark.slow
def test_frames_fused_in_one_go_and_one_after_the_other_are_the_same(ellipsoid):
    """The field of so many frames, its grids, and the grids after each number of frames."""
    sensor = sensor_of(CAMERAS["kinect"])
    poses = jax.tree.map(lambda x: x[:3], ellipsoid.T_object_camera)
    few = ellipsoid._replace(depth=ellipsoid.depth[:3], T_object_camera=poses)
    state, grids = fused_frames(few, Distances(), sensor)
    fields = fuse_frames(few, (1, 3), sensor)
    cumulative = fused_grids(few, Distances(), (1, 3), sensor)
    np.testing.assert_allclose(state.weight, fields.weight[1], atol=1e-5)
    expected = soft_grids(fields)
    np.testing.assert_allclose(cumulative.occupied, expected.occupied, atol=1e-4)
    np.testing.assert_allclose(cumulative.occluded, expected.occluded, atol=1e-4)
    np.testing.assert_allclose(grids.occupied, cumulative.occupied[1], atol=1e-4)


def test_points_of_more_and_more_frames_are_those_of_each_number(ellipsoid):
    grids = fused_grids(ellipsoid, Points(), (2, 5, 12))
    merged = fusion.merge_cumulative(measure_frames(ellipsoid))
    for i, k in enumerate((2, 5, 12)):
        one = jax.tree.map(lambda x, k=k: x[k - 1], merged)
        np.testing.assert_array_equal(grids.occupied[i], fusion.occupied(one))
        np.testing.assert_array_equal(grids.occluded[i], fusion.occluded(one))
