import numpy as np
import pytest
from analytic_room import CHAIR, FLOOR, TABLE, WALLS, K, room
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxshape.mapping.segmentation.planes import (
    NEIGHBOURS,
    Plane,
    along_walls,
    camera_points,
    dominant_planes,
    floor_plane,
    height_above,
    on_plane,
)


def patch(normal, distance, rng, count=1500, noise=0.003):
    """Points 2 m around that of a plane which is nearest to the camera."""
    basis = np.linalg.svd(np.array([normal]))[2]
    flat = rng.uniform(-1, 1, (count, 2)) @ basis[1:] - distance * np.asarray(normal)
    return flat + noise * rng.normal(size=(count, 1)) * np.asarray(normal)


def unit(x):
    return np.asarray(x) / np.linalg.norm(x)


NORMALS = [unit((0.1, -0.9, -0.4)), unit((0.9, 0.1, -0.6)), unit((-0.3, 0.2, -1))]


def test_planes_are_found_among_noise_and_strays():
    rng = np.random.default_rng(0)
    counts, distances = (1800, 1200, 800), (1.3, 1.9, 2.4)
    clouds = [patch(n, d, rng, c) for n, d, c in zip(NORMALS, distances, counts, strict=True)]
    strays = rng.uniform((-2, -2, 0.5), (2, 2, 4), (800, 3))
    planes = dominant_planes(np.concatenate([*clouds, strays]), count=3)
    for plane, normal, distance, count in zip(planes, NORMALS, distances, counts, strict=True):
        assert plane.normal @ normal > np.cos(np.deg2rad(0.5))
        assert plane.offset == pytest.approx(distance, abs=0.005)
        assert plane.share == pytest.approx(count / 4600, abs=0.05)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_a_plane_turns_and_shifts_with_its_points(seed):
    rng = np.random.default_rng(seed)
    points = patch(NORMALS[0], 1.5, rng, 600) + (0, 0, 2.5)
    R = Rotation.from_rotvec(rng.uniform(-0.3, 0.3, 3)).as_matrix()  # stays ahead of the camera
    t = rng.uniform(-0.2, 0.2, 3)
    (plane,) = dominant_planes(points, count=1)
    (moved,) = dominant_planes(points @ R.T + t, count=1)
    side = np.sign(moved.normal @ R @ plane.normal)
    np.testing.assert_allclose(side * moved.normal, R @ plane.normal, atol=2e-3)
    same = on_plane(plane, points) == on_plane(moved, points @ R.T + t)
    assert same.mean() > 0.98


def test_the_same_points_give_the_same_planes():
    points = camera_points(room([FLOOR, WALLS, CHAIR]).depth, K).reshape(-1, 3)
    first, second = dominant_planes(points, seed=3), dominant_planes(points, seed=3)
    assert len(first) > 2
    np.testing.assert_equal(first, second)


def test_normals_look_towards_the_camera_and_heights_grow_towards_it():
    points = camera_points(room([FLOOR, WALLS]).depth, K).reshape(-1, 3)
    for plane in dominant_planes(points):
        assert np.linalg.norm(plane.normal) == pytest.approx(1)
        assert plane.offset > 0
        assert height_above(plane, np.zeros((1, 3))) == plane.offset


@pytest.mark.parametrize("count", [0, 2, NEIGHBOURS - 1])
def test_too_few_points_have_no_plane(count):
    points = np.full((50, 3), np.nan)
    points[:count] = np.random.default_rng(0).normal(size=(count, 3))
    assert dominant_planes(points) == []


def test_a_cloud_without_planes_gives_none_large():
    points = np.random.default_rng(0).uniform((-2, -2, 1), (2, 2, 5), (4000, 3))
    assert all(plane.share < 0.1 for plane in dominant_planes(points))


@pytest.mark.parametrize("eye", [(0.9, 1.4, 1.8), (-1.2, 1.0, 1.5), (0.2, 2.0, 1.2)])
def test_the_floor_gives_up_and_the_height_of_the_camera(eye):
    seen = room([FLOOR, WALLS, CHAIR, TABLE], eye)
    points = camera_points(seen.depth, K)
    planes = dominant_planes(points.reshape(-1, 3))
    floor = floor_plane(points.reshape(-1, 3), planes, points[seen.label == 2])
    assert floor is not None
    assert floor.plane.normal @ seen.T_world_camera[1, :3] > np.cos(np.deg2rad(0.7))
    assert floor.plane.offset == pytest.approx(eye[1], abs=0.015)
    assert floor.confidence > 0.9


def test_a_table_top_is_no_sure_floor():
    """Seen alone it passes for one; not once something lies below it, or the object does."""
    normal = unit((0, -0.8, -0.6))
    table = Plane(normal, 0.6, 0.4)
    on_top, below = -0.6 * normal + [[0.1, 0, 0]] * 90, -1.3 * normal + [[0, 0, 0.1]] * 10
    assert floor_plane(on_top, [table]).confidence > 0.9
    assert floor_plane(np.concatenate([on_top, below]), [table]).confidence == 0
    assert floor_plane(on_top, [table], below).confidence == 0
    hovering = -0.1 * normal + np.zeros((20, 3))
    assert floor_plane(on_top, [table], hovering).confidence < 0.5


def test_walls_and_ceilings_are_no_floors():
    walls = [Plane(np.array([0.0, 0, -1]), 2.0, 0.5), Plane(np.array([0.0, 1, 0]), 1.0, 0.4)]
    assert floor_plane(np.zeros((5, 3)), walls) is None


@pytest.mark.parametrize("eye", [(0.9, 1.4, 1.8), (-1.2, 1.0, 1.5), (0.2, 2.0, 1.2)])
@pytest.mark.parametrize("roll", [0.0, 20.0, -35.0])
def test_two_walls_give_up_without_a_floor(eye, roll):
    """The camera looks into the corner; what is level in the room is left out."""
    seen = room([WALLS, CHAIR], eye, target=(1.0, 0.9, -1.0))
    points = camera_points(seen.depth, K).reshape(-1, 3)
    turn_camera = Rotation.from_euler("z", roll, degrees=True).as_matrix()
    up = along_walls(dominant_planes(points @ turn_camera.T))
    assert up is not None
    assert up @ turn_camera @ seen.T_world_camera[1, :3] > np.cos(np.deg2rad(1.5))


def test_one_wall_or_a_wall_and_a_floor_do_not_tell_the_vertical():
    level, wall = Plane(unit((0, -0.9, -0.4)), 1.2, 0.4), Plane(unit((0, 0.4, -0.9)), 2.0, 0.3)
    assert along_walls([wall]) is None
    assert along_walls([level, wall]) is None  # they meet along a line that is level
    side = Plane(np.array([1.0, 0, 0]), 1.0, 0.04)
    assert along_walls([wall, side]) is None  # too small for a wall
    slanted = Plane(unit((0.5, 0.4, -0.9)), 2.0, 0.3)
    assert along_walls([wall, slanted]) is None  # nearly one wall
    np.testing.assert_allclose(along_walls([wall, side._replace(share=0.2)]), unit((0, -0.9, -0.4)))


def test_unmeasured_pixels_have_no_point():
    depth = np.full((4, 5), 2, np.float32)
    depth[0, 0], depth[1, 1] = 0, np.inf
    points = camera_points(depth, K)
    known = np.isfinite(points).all(axis=-1)
    np.testing.assert_array_equal(known, (depth > 0) & np.isfinite(depth))
    assert not on_plane(Plane(np.array([0.0, 0, -1]), 2.0, 1.0), points)[~known].any()
