"""Clouds become F and M by rays, and are placed by the prior as they stand."""

import itertools

import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from jaxshape.data.boxes import Box
from jaxshape.data.chairs import random_chair
from jaxshape.data.clouds import Cloud, without_strays
from jaxshape.data.meshes import axes_to_canonical, axis_named, sample_oriented
from jaxshape.geometry.grid import GridFrame
from jaxshape.mapping.placement import cloud_placing
from jaxshape.mapping.placement.cloud_placing import (
    AXES,
    SEARCH,
    PlacedCloud,
    cloud_grids,
    place_cloud,
)
from jaxshape.model.weights import load_prior

N = 32
FRAME = GridFrame(jnp.full(3, -0.5), jnp.full(3, 1 / N))


def placed(cloud, metres=1.0):
    return PlacedCloud(Box(np.eye(4), np.ones(3)), metres, "y", 0.0, (), cloud)


def wall(side=0.6, count=200):
    """A square in the plane z = 0.01, in the middle of voxels 16."""
    x, y = np.meshgrid(*[np.linspace(-side / 2, side / 2, count)] * 2)
    return np.stack([x, y, np.full_like(x, 0.01)], -1).reshape(-1, 3)


def states(cloud, metres=1.0):
    grids = cloud_grids(cloud, placed(cloud, metres), FRAME, N)
    occupied, occluded = np.asarray(grids.occupied), np.asarray(grids.occluded)
    assert not (occupied & occluded).any()
    return occupied, ~(occupied | occluded)


def test_a_sensor_frees_what_is_before_the_surface_and_nothing_behind():
    points = wall()
    occupied, free = states(Cloud(points, None, np.array([0.0, 0.0, 5.0])))
    z = np.flatnonzero(occupied.any(axis=(0, 1)))
    assert z.tolist() == [16]
    assert not free[:, :, :17].any()
    inside = occupied[:, :, 16]
    assert free[inside][:, 18:].mean() > 0.9  # the rays that end in the wall
    assert not free[:6].any() and not free[:, 27:].any()  # where no ray passes


def test_normals_free_a_short_way_until_another_surface():
    points, ahead = wall(), np.array([[0.0, 0.0, 1.0]])
    near = points + [0.0, 0.0, 3 / N]
    occupied, free = states(Cloud(points, np.repeat(ahead, len(points), 0), None))
    inside = occupied[:, :, 16]
    assert free[inside][:, 18:20].all()
    assert not free[inside][:, 21:].any() and not free[:, :, :17].any()
    both = np.concatenate([points, near])
    sideways = points * [1, 1, 0] / np.linalg.norm(points[:, :2], axis=1, keepdims=True)
    normals = np.concatenate([np.repeat(ahead, len(points), 0), sideways])
    occupied, free = states(Cloud(both, normals, None))
    assert free[inside][:, 18].all()
    assert not free[inside][:, :16].any() and not free[inside][:, 20:].any()


def test_without_rays_nothing_is_free_and_units_are_brought_to_metres():
    occupied, free = states(Cloud(wall() * 1000, None, None), metres=0.001)
    assert occupied[:, :, 16].sum() > 300 and not free.any()


@pytest.mark.slow
@pytest.mark.parametrize("up, front, unit", [("z", "x", 1.0), ("-y", "z", 1000.0)])
def test_a_chair_is_placed_as_it_stands(up, front, unit):
    mesh = random_chair(3)
    points, normals = sample_oriented(mesh, 20_000, 0)
    R_file_object = axes_to_canonical(up, front).T
    cloud = Cloud(
        unit * (points @ R_file_object.T + [0.3, -2.0, 1.0]), normals @ R_file_object.T, None
    )
    found = place_cloud(cloud, load_prior())
    assert found.up == up and found.metres == pytest.approx(1 / unit)
    assert len(found.warnings) == (unit != 1)
    T = found.box.T_world_object
    np.testing.assert_allclose(T[:3, :3], R_file_object, atol=0.1)
    np.testing.assert_allclose(T[:3, 3], [0.3, -2.0, 1.0], atol=0.05)
    np.testing.assert_allclose(found.box.size, mesh.extents, atol=0.08)


def test_a_sensor_within_the_object_is_refused():
    """The place where a cloud was centred, or metres beside a cloud in millimetres."""
    points = 1000 * wall() @ np.array([[1, 0, 0], [0, 1, 0.5], [0, 0, 1]])
    for place in ((0.0, 0.0, 20.0), points.mean(axis=0), (0.3, 0.2, 1.5)):
        with pytest.raises(ValueError, match=r"within the object, whose points reach from -300"):
            place_cloud(Cloud(points, None, np.array(place)), load_prior("chair-autoencoder"))


@pytest.mark.parametrize(
    "extent, metres, said",
    [
        (0.4, 1.0, ""),
        (2.8, 1.0, ""),
        (95.7, 0.01, "taken as cm"),
        (860.0, 0.001, "taken as mm"),
        (12.0, 0.86 / 12, "no length is measured"),
        (0.1, 8.6, "no length is measured"),
    ],
)
def test_the_unit_is_the_one_of_a_plausible_size(extent, metres, said):
    found, warnings = cloud_placing._metres(Cloud(wall(extent), None, None), SEARCH)
    assert found == pytest.approx(metres) and len(warnings) == (said != "")
    assert all(said in warning for warning in warnings)


def test_up_may_be_the_normal_of_a_plane_between_the_axes():
    level = wall()[:, [0, 2, 1]]  # a square in the plane of x and z
    turn = jaxlie.SO3.from_x_radians(jnp.deg2rad(25.0)).as_matrix()
    tilted = Cloud(level @ np.asarray(turn).T, None, None)
    found = cloud_placing._directions(tilted, 1.0, None)
    assert len(found) == len(AXES) + 2
    cosines = [normal @ np.asarray(turn)[:, 1] for normal in found.values()]
    assert max(cosines) > 0.999 and min(cosines) < -0.999
    assert len(cloud_placing._directions(Cloud(level, None, None), 1.0, None)) == len(AXES)
    assert list(cloud_placing._directions(tilted, 1.0, "-z")) == ["-z"]


@pytest.mark.parametrize("front", [None, "x"])
def test_a_level_frame_has_up_along_y_and_turns_the_front_as_little_as_possible(front):
    up = np.array([0.0, -0.6, 0.8])
    R = cloud_placing._level(up, front)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(R @ up, [0, 1, 0], atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1)
    if front == "x":
        np.testing.assert_allclose(R @ [1.0, 0, 0], [0, 0, 1], atol=1e-12)
    for up, front in itertools.permutations(AXES, 2):
        if up[-1] != front[-1]:
            np.testing.assert_array_equal(
                cloud_placing._level(axis_named(up), front), axes_to_canonical(up, front)
            )


@pytest.mark.slow
def test_a_chair_stands_on_its_lowest_point_unless_its_legs_are_missing():
    mesh = random_chair(3)
    points, _ = sample_oriented(mesh, 20_000, 0)
    prior, bottom = load_prior("chair-autoencoder"), mesh.bounds[0, 1]

    def bottom_of(kept):
        found = place_cloud(Cloud(points[kept], None, None), prior, up="y", front="z")
        return found.box.T_world_object[1, 3] - found.box.size[1] / 2

    assert bottom_of(slice(None)) == pytest.approx(bottom, abs=0.02)
    above = points[:, 1] > bottom + 0.35 * mesh.extents[1]
    assert bottom_of(above) < bottom + 0.2 * mesh.extents[1]


@pytest.mark.slow
def test_a_tilted_chair_far_from_the_origin_in_centimetres_with_strays_is_placed():
    mesh = random_chair(3)
    points, _ = sample_oriented(mesh, 20_000, 0)
    turn = np.asarray(jaxlie.SO3.from_x_radians(jnp.deg2rad(155.0)).as_matrix(), np.float64)
    strays = np.array([[0, 1.9, 0], [0.1, -1.8, 0.3]])
    place = np.array([5e5, 5.4e6, 300.0])
    cloud = Cloud(100 * np.concatenate([points, strays]) @ turn.T + place, None, None)
    found = place_cloud(cloud, load_prior("chair-autoencoder"))
    T = found.box.T_world_object
    assert found.metres == pytest.approx(0.01) and T[:3, 1] @ turn[:, 1] > np.cos(0.1)
    np.testing.assert_allclose(T[:3, 3] / found.metres, place, atol=6)
    np.testing.assert_allclose(found.box.size, mesh.extents, atol=0.12)
    assert any("2 points lie far away" in warning for warning in found.warnings)


def test_points_far_from_all_others_do_not_count():
    normals = np.repeat([[0.0, 0.0, 1.0]], 40_000, 0)
    cloud = Cloud(wall(), normals, None)
    assert len(without_strays(cloud).points) == 40_000
    far = np.array([[6.0, 0, 0], [0, -9, 0], [0, 0, 1e6]])
    many = Cloud(np.concatenate([far, wall()]), np.concatenate([normals[:3], normals]), None)
    kept = without_strays(many)
    np.testing.assert_array_equal(kept.points, cloud.points)
    assert kept.normals is not None and len(kept.normals) == 40_000
    near = Cloud(np.concatenate([wall(count=60), [[0, 0, 0.5], [0.2, 0.1, -0.4]]]), None, None)
    assert len(without_strays(near).points) == 3600
    twice = Cloud(np.repeat(wall(count=60), 10, axis=0), None, None)
    assert len(without_strays(twice).points) == 36_000


def test_axes_that_are_not_perpendicular_are_refused():
    with pytest.raises(ValueError, match="must be perpendicular"):
        place_cloud(Cloud(wall(), None, None), load_prior(), up="y", front="-y")
