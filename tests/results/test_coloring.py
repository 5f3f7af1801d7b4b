"""Colours of a box whose sides are known, seen from two of them and from above."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxshape.data.render import fit_intrinsics, render_depth
from jaxshape.geometry import camera, grid
from jaxshape.geometry.fusing import Distances, fuse
from jaxshape.results.coloring import NEUTRAL, ColorView, color_vertices
from jaxshape.results.output import Observation, shape_mesh

SIZE = 160
HALF = np.array([0.25, 0.2, 0.15])
SIDES = np.array(
    [[200, 40, 40], [40, 200, 40], [40, 40, 200], [200, 200, 40], [40, 200, 200], [200, 40, 200]],
    np.uint8,
)
"""Colours of the sides at +x, +y, +z, -x, -y, -z."""
BOX = trimesh.creation.box(2 * HALF)
FRAME = grid.fit_box_isotropic(*jnp.float32(BOX.bounds))
REACH = 0.03


def side_of(points):
    """0 to 2 for the sides at +x, +y and +z, 3 to 5 for those at -x, -y and -z."""
    share = points / HALF
    axis = np.abs(share).argmax(axis=-1)
    return axis + 3 * (np.take_along_axis(share, axis[..., None], axis=-1)[..., 0] < 0)


def near_an_edge(points, margin):
    """Points whose side is in doubt, or whose colour may come from across an edge."""
    close = (HALF - np.abs(points)) < margin
    return close.sum(axis=-1) > 1


@pytest.fixture(scope="module")
def seen():
    """Depth, intrinsics and poses of five frames from the front and the right, and above."""
    azimuth = jnp.array([0.0, 25, 50, 75, 90])
    T = jax.jit(camera.on_sphere, static_argnums=2)(azimuth, jnp.full(5, 35.0), 1.2)
    intrinsics = fit_intrinsics(BOX, T, SIZE)
    depth, _ = render_depth(BOX, T, intrinsics, SIZE)
    return depth, intrinsics, T


@pytest.fixture(scope="module")
def views(seen):
    depth, intrinsics, T = seen
    points = np.asarray(camera.unproject(intrinsics, jnp.where(np.isfinite(depth), depth, 0)))
    found = []
    for one, at, pose in zip(depth, points, np.asarray(T.as_matrix(), np.float64), strict=True):
        color = SIDES[side_of(at @ pose[:3, :3].T + pose[:3, 3])]
        color = np.where(np.isfinite(one)[..., None], color, 0).astype(np.uint8)  # black behind
        found.append(ColorView(color, one, tuple(map(float, intrinsics)), pose))
    return found


@pytest.fixture(scope="module")
def observation(seen, views):
    depth, intrinsics, T = seen
    field = jax.jit(fuse, static_argnums=0)(
        Distances(), jnp.asarray(depth), jnp.isfinite(depth), intrinsics, T, FRAME
    )
    nothing = np.zeros((32, 32, 32), bool)
    return Observation([], nothing, nothing, FRAME, np.eye(4), None, field, views)


@pytest.fixture(scope="module")
def logits():
    """Sure of the voxels that hold the sides."""
    points = BOX.sample(40_000, seed=0)
    voxel = np.floor((points - np.asarray(FRAME.origin)) / np.asarray(FRAME.voxel_size))
    found = np.full((32, 32, 32), -6.0, np.float32)
    found[tuple(voxel.astype(int).T)] = 6
    return found


@pytest.fixture(scope="module")
def found(observation, logits):
    return shape_mesh(observation, logits > 0, logits)


def test_each_side_has_its_colour_and_hidden_ones_are_neutral(found):
    points = found.mesh.vertices
    side, sure = side_of(points), ~near_an_edge(points, 0.03)
    shown = np.isin(side, [0, 1, 2])
    assert found.measured[shown & sure].mean() > 0.98
    assert not found.measured[~shown & sure].any()
    for number in (0, 1, 2):
        colors = found.color[(side == number) & sure & found.measured].astype(int)
        assert len(colors) > 300
        assert (np.abs(colors - SIDES[number]).max(axis=1) < 12).mean() > 0.98
    np.testing.assert_array_equal(np.unique(found.color[~found.measured], axis=0), [NEUTRAL])


def test_no_background_bleeds_onto_the_rims(found):
    """The black behind the box is at depth jumps only, where colours come from further inside."""
    assert (found.color.sum(axis=1, dtype=int) > 265).all()  # the sides have 280 or more


def test_what_stands_in_front_gives_no_colour(found, views):
    """A white board before half of one camera hides half of the box from it, and no more."""
    board = np.zeros((SIZE, SIZE), bool)
    board[:, : SIZE // 2] = True
    one = views[2]
    hidden = one._replace(
        depth=np.where(board, np.float32(0.4), one.depth),
        color=np.where(board[..., None], np.uint8(255), one.color),
    )
    mesh, every = found.mesh, np.ones(len(found.mesh.vertices), bool)
    colors = color_vertices(mesh, every, [hidden], reach=0.0)
    assert (colors.min(axis=1) < 250).all()
    is_neutral = (colors == NEUTRAL).all(axis=1)
    alone = (color_vertices(mesh, every, [one], reach=0.0) == NEUTRAL).all(axis=1)
    assert 0.2 < 1 - (~is_neutral).sum() / (~alone).sum() < 0.8


def test_the_best_view_decides(found, views):
    """Of a good frontal view and one that is aslant and wrong, the frontal one counts."""
    wrong = views[0]._replace(color=np.full_like(views[0].color, 255))  # sees the right side aslant
    right = side_of(found.mesh.vertices) == 0
    right &= ~near_an_edge(found.mesh.vertices, 0.04)
    both = color_vertices(found.mesh, right, [views[4], wrong], reach=REACH)
    np.testing.assert_allclose(both[right].astype(int), np.tile(SIDES[0], (right.sum(), 1)), atol=9)


def test_without_frames_there_are_no_colours(found):
    assert color_vertices(found.mesh, found.measured, [], reach=REACH) is None


def test_a_mesh_without_frames_is_the_same_mesh(observation, found, logits):
    plain = shape_mesh(observation._replace(views=()), logits > 0, logits)
    assert plain.color is None
    np.testing.assert_array_equal(plain.mesh.vertices, found.mesh.vertices)
    np.testing.assert_array_equal(plain.measured, found.measured)


def test_by_points_the_mesh_is_that_of_the_composed_grid(observation, logits):
    plain = shape_mesh(observation._replace(field=None), logits > 0, logits)
    assert plain.measured is None and plain.color is None and plain.mesh.is_watertight
