import subprocess
import sys

import numpy as np
import pytest
import trimesh
from pixels import drawn, grid_of

from jaxshape import random_chair
from jaxshape.report import pictures
from jaxshape.report.pictures import render_mesh, render_voxels


def middle(mask):
    """Row and column of the centre of what is drawn."""
    return np.argwhere(mask).mean(axis=0)


# Grids


@pytest.mark.parametrize("azimuth, elevation", [(35, 25), (0, 0), (-120, 60), (200, -30), (90, 90)])
def test_a_voxel_is_drawn_where_its_centre_projects(azimuth, elevation):
    a, e = np.radians([azimuth, elevation])
    right = np.array([np.cos(a), 0, -np.sin(a)])
    up = np.array([-np.sin(a) * np.sin(e), np.cos(e), -np.cos(a) * np.sin(e)])
    size = 320
    corners = np.array(np.meshgrid(*[[-16, 16]] * 3)).reshape(3, -1)
    scale = size / (1.02 * 2 * max((right @ corners).max(), (up @ corners).max()))
    for cell in [(0, 0, 0), (31, 31, 31), (5, 20, 28)]:
        place = np.array(cell) + 0.5 - 16
        expected = size / 2 - scale * (up @ place), size / 2 + scale * (right @ place)
        view = {"size": size, "azimuth": float(azimuth), "elevation": float(elevation)}
        image = render_voxels(grid_of(cell), **view)
        np.testing.assert_allclose(middle(drawn(image)), np.array(expected) - 0.5, atol=1)


def test_y_is_up_and_the_left_of_the_object_and_its_front_are_near():
    row, _ = middle(drawn(render_voxels(grid_of((16, 31, 16)))))
    assert row < 64
    _, left = middle(drawn(render_voxels(grid_of((0, 16, 16)))))
    _, right = middle(drawn(render_voxels(grid_of((31, 16, 16)))))
    assert left < right
    front, back = (16, 16, 31), (16, 16, 0)
    assert (
        middle(drawn(render_voxels(grid_of(front))))[0]
        > middle(drawn(render_voxels(grid_of(back))))[0]
    )  # seen from above, what is near is low


def test_near_voxels_hide_far_ones():
    """Painting agrees with a ray through each pixel, followed in small steps."""
    n, size = 6, 40
    labels = np.random.default_rng(0).integers(0, 4, (n, n, n)) % 3  # half empty, two kinds
    image = render_voxels(labels, ("#ff0000", "#0000ff"), size=size).astype(int)

    a, e = np.radians([35.0, 25.0])
    towards = np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
    right = np.array([np.cos(a), 0, -np.sin(a)])
    up = np.cross(towards, right)
    width, height = (np.abs(v).sum() * n for v in (right, up))
    step = 1.02 * max(width, height) / size

    def first_hit(x, y):
        for depth in np.arange(n, -n, -0.02):
            cell = np.floor(x * right + y * up + depth * towards + n / 2).astype(int)
            if (cell >= 0).all() and (cell < n).all() and labels[tuple(cell)]:
                return labels[tuple(cell)]
        return 0

    offsets = (np.arange(size) + 0.5 - size / 2) * step
    expected = np.array([[first_hit(x, -y) for x in offsets] for y in offsets])
    found = np.where(drawn(image), np.where(image[..., 0] > image[..., 2], 1, 2), 0)
    assert set(np.unique(expected)) == {0, 1, 2}
    assert (found == expected).mean() > 0.93  # all but pixels that straddle an edge


def test_the_faces_of_a_block_join_without_gaps():
    image = render_voxels(np.ones((8, 8, 8), bool), size=200)
    for line in drawn(image):
        columns = np.flatnonzero(line)
        assert len(columns) == 0 or len(columns) == columns[-1] - columns[0] + 1
    center = image[60:140:4, 60:140:4].astype(int)
    assert len(np.unique(center.reshape(-1, 3), axis=0)) >= 3  # three sides, shaded differently


def test_top_is_lighter_than_sides_and_a_corner_is_darker_than_open_floor():
    block = render_voxels(np.ones((8, 8, 8), bool), size=200).sum(axis=-1, dtype=int)
    top, front, side = block[45:60, 90:110], block[110:130, 50:70], block[110:130, 150:170]
    assert np.median(top) > np.median(front) and np.median(top) > np.median(side)
    assert np.median(front) != np.median(side)

    floor = np.zeros((8, 8, 8), bool)
    floor[:, 0, :] = True
    floor_and_wall = floor.copy()
    floor_and_wall[:, :, 0] = True
    wall = drawn(render_voxels(floor_and_wall & ~floor, size=200))
    is_floor = drawn(render_voxels(floor, size=200)) & ~wall
    before, after = (render_voxels(g, size=200).astype(int) for g in (floor, floor_and_wall))
    change = (after - before).sum(axis=-1)[is_floor]
    assert change.min() < -20 and (change <= 3).all()  # darker at the wall, lighter nowhere


def test_empty_grids_shapes_and_repeatability():
    empty = render_voxels(np.zeros((32, 32, 32), bool), size=64)
    assert empty.shape == (64, 64, 3) and empty.dtype == np.uint8 and (empty == 255).all()
    grid = np.random.default_rng(0).random((32, 32, 32)) < 0.1
    np.testing.assert_array_equal(render_voxels(grid), render_voxels(grid))


# Meshes


def test_a_mesh_fills_the_picture_and_stands_upright():
    cone = trimesh.creation.cone(radius=0.3, height=1.0)  # along +z
    cone.apply_transform([[1, 0, 0, 5], [0, 0, 1, 7], [0, -1, 0, 9], [0, 0, 0, 1]])
    image = render_mesh(cone, size=96, color="#ff0000", elevation=10.0)
    assert image.shape == (96, 96, 3) and image.dtype == np.uint8
    widths = drawn(image).sum(axis=1)
    rows = np.flatnonzero(widths)
    assert rows[0] <= 2 and rows[-1] >= 93
    assert widths[20] < widths[50] < widths[80]  # the tip is up
    np.testing.assert_allclose(middle(drawn(image))[1], 47.5, atol=1)
    inside = image[drawn(image) & (image[..., 0] > 150) & (image[..., 1] < 20)]
    assert len(inside) > 1000 and (inside[:, 1:] == 0).all()  # the colour, darker or lighter


def test_an_inside_out_mesh_looks_the_same():
    ball = trimesh.creation.icosphere(subdivisions=2)
    inverted = ball.copy()
    inverted.invert()
    images = [render_mesh(m, size=48).astype(int) for m in (ball, inverted)]
    assert np.abs(images[0] - images[1]).max() <= 1


def test_without_embree_a_mesh_looks_the_same(monkeypatch):
    chair = random_chair(7)
    shades = np.random.default_rng(0).integers(0, 255, (len(chair.vertices), 3)).astype(np.uint8)
    image = render_mesh(chair, color=shades, size=64).astype(int)
    monkeypatch.setattr(pictures, "has_embree", False)
    other = render_mesh(chair, color=shades, size=64)
    assert (np.abs(image - other).max(axis=2) > 8).mean() < 0.005  # rays that graze an edge


def test_a_mesh_without_faces_is_white():
    assert (render_mesh(trimesh.Trimesh(), size=32) == 255).all()


def test_importing_the_module_leaves_matplotlib_alone():
    code = "import sys, jaxshape.report.pictures; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
