from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from jaxshape.mapping.tracking import surfels
from jaxshape.mapping.tracking.surfels import CELLS, Lattice, Sums

CENTER = np.array([4.0, -2.0, 7.0])
SIZE = np.array([0.64, 0.96, 0.8])
R = Rotation.from_rotvec([0.3, -0.8, 0.2]).as_matrix()  # of the box, in the world
LATTICE = Lattice(
    jnp.float32(CELLS / SIZE[:, None] * R.T),
    jnp.float32(CELLS / 2 - CELLS / SIZE * (R.T @ CENTER)),
)
COUNT = CELLS**3

add_up = jax.jit(surfels.add_up)
cell_of = jax.jit(surfels.cell_of)
measured_surface = jax.jit(surfels.measured_surface)
predicted_surface = jax.jit(surfels.predicted_surface)


@jax.jit
def matched(surface, points, normals, distance):
    return surfels.match_surface(surface)(points, normals, distance)


def world(points):
    """From coordinates in the box, of which the centre is 0 and the sides are +- 1."""
    return np.float32((np.asarray(points) * SIZE / 2) @ R.T + CENTER)


def scattered(rng, count=4000, reach=1.2):
    """Random oriented points in and about the box."""
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    deviation = rng.uniform(0.001, 0.01, count)
    return world(rng.uniform(-reach, reach, (count, 3))), np.float32(normals), np.float32(deviation)


def sampled_plane(rng, *, noise=0.002, count=20_000):
    """Points of a plane through the box, and its normal."""
    normal = R @ [0.6, 0.0, 0.8]
    flat = np.stack([R @ [0.8, 0.0, -0.6], R @ [0.0, 1.0, 0.0]])
    points = CENTER + rng.uniform(-0.28, 0.28, (count, 2)) @ flat
    points += noise * rng.normal(size=(count, 1)) * normal
    normals = normal + 0.05 * rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return np.float32(points), np.float32(normals), np.full(count, noise, np.float32), normal


def patches(surface):
    """Indices, points and normals of the cells that have a patch."""
    index = np.nonzero(np.isfinite(surface.deviation))[0]
    return index, np.asarray(surface.points)[index], np.asarray(surface.normals)[index]


# ------------------------------------------------------------------ cells


def test_centres_of_cells_lie_in_their_cells():
    index = jnp.arange(COUNT)
    centers = surfels.cell_centers(LATTICE, index)
    np.testing.assert_array_equal(cell_of(LATTICE, centers), index)
    np.testing.assert_allclose(np.asarray(centers).mean(axis=0), CENTER, atol=1e-4)
    assert float(surfels.cell_size(LATTICE)) == pytest.approx(np.prod(SIZE) ** (1 / 3) / CELLS)


def test_what_is_outside_or_not_a_number_is_in_no_cell():
    outside = [[*((0.5,) * i), s * 1.01, *((0.5,) * (2 - i))] for i in range(3) for s in (-1, 1)]
    points = np.concatenate([world(outside), np.full((1, 3), np.nan, np.float32)])
    np.testing.assert_array_equal(cell_of(LATTICE, points), COUNT)
    corners = world([[0.995 * s for s in signs] for signs in product((-1, 1), repeat=3)])
    expected = [np.ravel_multi_index(i, (CELLS,) * 3) for i in product((0, CELLS - 1), repeat=3)]
    np.testing.assert_array_equal(cell_of(LATTICE, corners), expected)


# ------------------------------------------------------------------ what was measured


def test_sums_over_cells_are_those_of_a_loop():
    points, normals, deviation = scattered(np.random.default_rng(0))
    sums = add_up(LATTICE, points, normals, deviation)
    cell = np.asarray(cell_of(LATTICE, points))
    expected = np.zeros((COUNT, 7))
    for i, p, n, s in zip(cell, points, normals, deviation, strict=True):
        if i < COUNT:
            corner = np.array(np.unravel_index(i, (CELLS,) * 3))
            center = world((corner + 0.5) / CELLS * 2 - 1)
            expected[i] += np.concatenate([[1], p - center, n]) / s**2
    np.testing.assert_allclose(sums.weight, expected[:, 0], rtol=1e-4)
    np.testing.assert_allclose(sums.point, expected[:, 1:4], atol=2.0)  # of up to 1e4 with 1e-6 m
    np.testing.assert_allclose(sums.normal, expected[:, 4:], rtol=1e-3, atol=0.5)


def test_sums_of_parts_are_the_sums_of_the_whole():
    rng = np.random.default_rng(1)
    cloud = scattered(rng)
    cloud[2][rng.random(len(cloud[2])) < 0.2] = np.inf  # no point
    whole = add_up(LATTICE, *cloud)
    part = rng.integers(0, 3, len(cloud[2]))
    parts = surfels.no_sums()
    for i in range(3):
        of_part = (*cloud[:2], np.where(part == i, cloud[2], np.float32(np.inf)))
        parts = jax.tree.map(jnp.add, parts, add_up(LATTICE, *of_part))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=0.05), parts, whole)
    left_out = jax.tree.map(lambda x: x[np.isfinite(cloud[2])], cloud)
    again = add_up(LATTICE, *left_out)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=0.05), again, whole)


def test_patches_of_a_sampled_plane_lie_on_it():
    *cloud, normal = sampled_plane(np.random.default_rng(2))
    surface = measured_surface(LATTICE, add_up(LATTICE, *cloud))
    index, points, normals = patches(surface)
    assert len(index) > 2000
    height, deviation = (points - CENTER) @ normal, np.asarray(surface.deviation)[index]
    assert (np.abs(height) < 4 * deviation).all()
    assert np.sqrt(np.mean((height / deviation) ** 2)) < 1.3
    middle = deviation < 0.001  # of points of 2 mm, several in the cell
    assert middle.sum() > 1000 and np.sqrt(np.mean(height[middle] ** 2)) < 0.001
    assert (normals[middle] @ normal > np.cos(np.deg2rad(10))).all()
    np.testing.assert_array_equal(cell_of(LATTICE, points), index)
    assert not surface.two_sided.any()


def test_a_cell_with_the_two_sides_of_a_board_has_no_patch():
    points, normals, deviation, _ = sampled_plane(np.random.default_rng(3))
    normals[::2] *= -1
    surface = measured_surface(LATTICE, add_up(LATTICE, points, normals, deviation))
    cell, count = np.unique(np.asarray(cell_of(LATTICE, points)), return_counts=True)
    assert np.isinf(np.asarray(surface.deviation)[cell[count > 20]]).mean() > 0.95


# ------------------------------------------------------------------ what is predicted


def voxels():
    """Centres of the voxels, the sides of the box being +- 1."""
    axis = (np.arange(32) + 0.5) / 16 - 1
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)


def sphere_shell(radius=0.6):
    """Voxels that a sphere passes through, in a box of equal sides, and its distance and normal."""
    shell = np.abs(np.linalg.norm(voxels(), axis=-1) - radius) < 0.5 / 16

    def off(p):
        length = np.linalg.norm(p, axis=-1)
        return length - radius, p / length[..., None]

    return shell, off


def seat_board(height=0.13):
    """The voxels of a level board, and the distance to it and its normal."""
    at = voxels()
    board = (np.abs(at[..., 1] - height) < 0.5 / 16) & (np.abs(at[..., [0, 2]]) < 0.7).all(axis=-1)
    level = at[..., 1][board].mean()
    return board, lambda p: (p[..., 1] - level, np.broadcast_to([0.0, 1.0, 0.0], p.shape))


@pytest.mark.parametrize("shape", [sphere_shell, seat_board])
def test_predicted_patches_lie_in_the_middle_of_the_shell(shape):
    side = np.full(3, 0.8)
    linear = CELLS / 0.8 * R.T
    lattice = Lattice(jnp.float32(linear), jnp.float32(CELLS / 2 - linear @ CENTER))
    solid, off = shape()
    surface = predicted_surface(lattice, np.where(solid, 0.9, 0.1).astype(np.float32))
    _, points, normals = patches(surface)
    assert len(points) > 0.6 * solid.sum()
    distance, normal = off((points - CENTER) @ R / (side / 2))
    # Within half a voxel all, and within the deviation that is claimed on average.
    assert np.abs(distance * 16).max() < 0.5
    assert np.sqrt(np.mean((distance * 16) ** 2)) < surfels.PREDICTED_DEVIATION
    cosine = np.abs(np.sum(normals @ R * normal, axis=-1))  # two-sided
    assert np.degrees(np.arccos(np.minimum(cosine, 1))).max() < 20
    assert surface.two_sided[np.isfinite(surface.deviation)].all()


def test_the_prediction_is_left_out_where_it_was_measured():
    *cloud, normal = sampled_plane(np.random.default_rng(4))
    measured = measured_surface(LATTICE, add_up(LATTICE, *cloud))
    predicted = predicted_surface(LATTICE, jnp.float32(seat_board()[0]))
    both = jax.jit(surfels.composed_surface)(measured, predicted)
    m, p = (np.isfinite(x.deviation) for x in (measured, predicted))
    assert (m & p).any() and (p & ~m).any()
    for field in ("points", "normals", "deviation", "two_sided"):
        found, a, b = (np.asarray(getattr(x, field)) for x in (both, measured, predicted))
        np.testing.assert_array_equal(found[m], a[m])
        np.testing.assert_array_equal(found[p & ~m], b[p & ~m])
    assert np.isinf(np.asarray(both.deviation)[~m & ~p]).all()


# ------------------------------------------------------------------ the patch near to a cell


def test_the_nearest_patch_is_that_of_a_tree():
    rng = np.random.default_rng(5)
    is_patch = np.zeros(COUNT, bool)
    is_patch[rng.integers(0, COUNT, 1500)] = True
    is_patch[[0, COUNT - 1, CELLS - 1]] = True  # nothing may wrap around the corners
    nearest = np.asarray(jax.jit(surfels._nearest)(is_patch))
    cells = np.stack(np.unravel_index(np.arange(COUNT), (CELLS,) * 3), axis=-1)
    expected, _ = cKDTree(cells[is_patch]).query(cells, p=np.inf)
    has = nearest < COUNT
    np.testing.assert_array_equal(has, expected <= surfels._REACH)
    assert is_patch[nearest[has]].all()
    found = np.abs(cells[has] - cells[nearest[has]]).max(axis=1)
    np.testing.assert_array_equal(found, expected[has])


def test_points_near_a_surface_match_it_and_others_do_not():
    *cloud, normal = sampled_plane(np.random.default_rng(6), noise=5e-4)
    surface = measured_surface(LATTICE, add_up(LATTICE, *cloud))
    points = cloud[0][:500]
    facing = np.float32(np.broadcast_to(normal, points.shape))
    lifted = points + np.float32(0.01 * normal)
    found = matched(surface, lifted, facing, 0.04)
    hit = np.isfinite(np.asarray(found.deviation))
    assert hit.mean() > 0.95
    height = np.sum((lifted - found.points) * found.normals, axis=-1)[hit]
    np.testing.assert_allclose(height, 0.01, atol=0.003)
    assert np.isinf(matched(surface, lifted, facing, 0.005).deviation).all()  # out of reach
    assert np.isinf(matched(surface, lifted, -facing, 0.04).deviation).all()  # from behind
    across = np.float32(np.broadcast_to(R @ [0.0, 1.0, 0.0], points.shape))
    assert np.isinf(matched(surface, lifted, across, 0.04).deviation).all()
    behind = matched(surface._replace(two_sided=~surface.two_sided), lifted, -facing, 0.04)
    np.testing.assert_array_equal(np.isfinite(behind.deviation), hit)
    assert not found.in_reach.any()


def test_nothing_matches_an_empty_surface():
    points, normals, _ = scattered(np.random.default_rng(7), 100)
    for sums in (surfels.no_sums(), Sums(*(0 * x for x in surfels.no_sums()))):
        found = matched(measured_surface(LATTICE, sums), points, normals, 1.0)
        assert np.isinf(found.deviation).all()
    empty = predicted_surface(LATTICE, jnp.zeros((32, 32, 32)))
    assert np.isinf(empty.deviation).all()
    assert not any(np.isnan(x).any() for x in jax.tree.leaves(empty))
