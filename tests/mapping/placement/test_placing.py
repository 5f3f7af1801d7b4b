"""Boxes found from points: their parts one by one, then chairs found with the shipped prior."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from jax.test_util import check_grads
from numpy.lib.stride_tricks import sliding_window_view
from scipy.interpolate import RegularGridInterpolator

from jaxshape.data.chairs import random_chair
from jaxshape.data.render import add_sensor_noise, fit_intrinsics, render_depth
from jaxshape.geometry import camera
from jaxshape.mapping.placement import placing
from jaxshape.mapping.placement.placing import Hypothesis, PlacementConfig, UprightBox
from jaxshape.mapping.placement.rays import (
    FREE_POINTS,
    SURFACE_POINTS,
    RaySamples,
    pooled,
    sample_rays,
)
from jaxshape.model.weights import load_prior

CONFIG = PlacementConfig(yaws=12, overhangs=(0.0, 0.35))
IMAGE_SIZE = 96
UNKNOWN = jnp.float32(jnp.nan)
turn_about_y = jaxlie.SO3.from_y_radians


def smooth_logits():
    """Around 0, and without the bends that interpolation between random numbers would have."""
    x, y, z = jnp.meshgrid(*[jnp.linspace(0, 3, 32)] * 3, indexing="ij")
    return 2 * jnp.sin(x + y) * jnp.cos(z - 0.5 * y)


def random_samples(seed=0, surface=40, free=30):
    rng = np.random.default_rng(seed)
    points = lambda n, reach: jnp.asarray(rng.uniform(-reach, reach, (n, 3)))  # noqa: E731
    return RaySamples(points(surface, 0.3), points(free, 0.5), jnp.array([0.6, 0.0, -0.8]))


BOX = UprightBox(jnp.array(0.4), jnp.array([-0.31, -0.3, -0.33]), jnp.array([0.35, 0.36, 0.29]))


# ------------------------------------------------------------------------ boxes


def test_boxes_hold_the_points_stand_on_the_floor_and_reach_away_from_the_camera():
    seen = random_samples(surface=SURFACE_POINTS)
    boxes = placing.propose(seen, jnp.array(-0.7), CONFIG)
    assert len(boxes.yaw) == CONFIG.yaws * len(CONFIG.overhangs)
    np.testing.assert_allclose(boxes.lower[:, 1], -0.7)
    voxels = jax.vmap(lambda box: placing.to_voxels(box, seen.surface, 32))(boxes)
    assert ((voxels > 0.5) & (voxels < 31.5)).all(axis=-1).mean() > 0.98
    tight, wide = (jax.tree.map(lambda x, n=n: x[n], boxes) for n in (0, CONFIG.yaws))
    assert wide.yaw == tight.yaw == 0
    assert (wide.upper - tight.upper)[0] > 0 == (wide.lower - tight.lower)[0]  # looks along +x
    assert (wide.lower - tight.lower)[2] < 0 == (wide.upper - tight.upper)[2]  # and along -z
    unknown = placing.propose(seen, UNKNOWN, CONFIG)
    below = np.repeat([0.0, 0.35 * 0.59], CONFIG.yaws)  # legs may be out of sight
    np.testing.assert_allclose(unknown.lower[:, 1], -0.3 - below, atol=0.01)


def test_the_box_fills_the_grid():
    corners = jnp.stack([BOX.lower, BOX.upper]) @ placing.turn(BOX.yaw).T
    voxels = placing.to_voxels(BOX, corners, 32)
    np.testing.assert_allclose(voxels, [[1.01] * 3, [30.99] * 3], atol=1e-4)


# ------------------------------------------------------------------------ the misfit


def slow_misfit(logits, box, seen, config):
    """One point after the other, in NumPy."""
    padded = np.pad(np.asarray(logits), 1, constant_values=placing.EMPTY)
    at_centers = RegularGridInterpolator([np.arange(-1, 33) + 0.5] * 3, padded)
    around = sliding_window_view(padded, (2, 2, 2)).max(axis=(-3, -2, -1))
    around = np.pad(around, 1, constant_values=placing.EMPTY)
    at_corners = RegularGridInterpolator([np.arange(-1, 34)] * 3, around)
    c, s = np.cos(float(box.yaw)), np.sin(float(box.yaw))
    lower, upper = np.asarray(box.lower), np.asarray(box.upper)

    def voxel(p):
        turned = np.array([c * p[0] - s * p[2], p[1], s * p[0] + c * p[2]])
        return 1.01 + (turned - lower) / (upper - lower) * (32 - 2.02)

    def logit(field, v):
        return field(np.clip(v, -0.5, 32.5))[0] if (np.abs(v - 16) < 17).all() else placing.EMPTY

    def surprise(probability):
        return -np.log(0.03 + 0.97 * probability)

    sigmoid = lambda x: 1 / (1 + np.exp(-x))  # noqa: E731
    measured, outside, free = [], [], []
    for p in np.asarray(seen.surface):
        v = voxel(p)
        measured.append(surprise(sigmoid((logit(at_corners, v) + logit(at_centers, v)) / 2)))
        outside.append(min(np.maximum(np.abs(v - 16) - 14.99, 0).sum(), 4))
    for p in np.asarray(seen.free):
        free.append(surprise(1 - sigmoid(logit(at_centers, voxel(p)))))
    sizes = zip(upper - lower, config.typical_size, config.size_spread, strict=True)
    unusual = sum((np.log(size / typical) / spread) ** 2 for size, typical, spread in sizes)
    return np.mean(measured) + 2 * np.mean(free) + 0.1 * np.mean(outside) + 0.0015 * unusual


def test_misfit_agrees_with_a_slow_reference():
    seen = random_samples()
    fast = placing.misfit(smooth_logits(), BOX, seen, CONFIG)
    np.testing.assert_allclose(fast, slow_misfit(smooth_logits(), BOX, seen, CONFIG), rtol=1e-4)


def test_misfit_has_the_right_gradient():
    with jax.enable_x64(True):
        widen = lambda tree: jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), tree)  # noqa: E731
        logits, box, seen = widen((smooth_logits(), BOX, random_samples()))
        loss = jax.jit(lambda logits, box: placing.misfit(logits, box, seen, CONFIG))
        check_grads(loss, (logits, box), order=1, modes=["rev"], eps=1e-6, rtol=1e-4)


def test_misfit_depends_on_neither_units_nor_the_world():
    """Everything twice as large, or all turned, explains as much."""
    twice = PlacementConfig(typical_size=tuple(2 * x for x in CONFIG.typical_size))
    seen, logits = random_samples(), smooth_logits()
    expected = placing.misfit(logits, BOX, seen, CONFIG)
    double = lambda x: 2 * x  # noqa: E731
    box = UprightBox(BOX.yaw, 2 * BOX.lower, 2 * BOX.upper)
    scaled = placing.misfit(logits, box, jax.tree.map(double, seen), twice)
    np.testing.assert_allclose(scaled, expected, rtol=1e-4)
    R = placing.turn(jnp.array(1.1))
    turned = seen._replace(surface=seen.surface @ R.T, free=seen.free @ R.T)
    box = BOX._replace(yaw=BOX.yaw + 1.1)
    np.testing.assert_allclose(placing.misfit(logits, box, turned, CONFIG), expected, rtol=1e-3)


# ------------------------------------------------------------------------ the search


def test_the_best_boxes_are_improved_and_no_two_that_look_the_same_way():
    yaws, misfits = jnp.array([0.0, 0.1, 3.0, 3.1, 1.0]), jnp.array([1.0, 1.1, 1.4, 1.3, jnp.inf])
    boxes = Hypothesis(UprightBox(yaws, jnp.zeros((5, 3)), jnp.ones((5, 3))), jnp.zeros((5, 2)))
    tried = placing._Candidate(boxes, (), jnp.zeros((5, 1, 1, 1)), misfits)
    chosen = placing._most_promising(tried, 3)
    assert [int(i) for i in chosen] == [0, 3, 4]
    chosen = placing._most_promising(tried, 5)  # then those that look the same way
    assert [int(i) for i in chosen] == [0, 3, 4, 1, 2]


@pytest.fixture(scope="module")
def prior():
    return load_prior("chair-autoencoder")


@pytest.fixture(scope="module")
def find(prior):
    """The program of `reconstruct`, with and without a floor and an earlier placement.

    Other settings would be another program, which takes half a minute to compile.
    """
    place = jax.jit(placing.place, static_argnums=4)

    def find(seen, floor=UNKNOWN, known=None):
        known = placing.nothing_known(prior) if known is None else known
        return place(prior, seen, jnp.asarray(floor, jnp.float32), known, PlacementConfig())

    return find


def look(mesh, azimuth, elevation=25.0, distance=2.0):
    """What one noisy frame says of a mesh, in its own frame."""
    T = camera.on_sphere(jnp.array([azimuth]), jnp.array([elevation]), distance)
    intrinsics = fit_intrinsics(mesh, T, IMAGE_SIZE)
    depth, cosine = render_depth(mesh, T, intrinsics, IMAGE_SIZE)
    depth = add_sensor_noise(depth, cosine, np.random.default_rng(0))
    depth, segmented = jnp.asarray(depth[0]), jnp.asarray(np.isfinite(depth[0]) & (depth[0] > 0))
    seen = jax.jit(sample_rays)(jax.random.key(0), depth, segmented, intrinsics)
    return pooled(jax.tree.map(lambda x: x[None], seen), T)


def yaw_of(T_world_object):
    front = T_world_object.rotation() @ jnp.array([0.0, 0.0, 1.0])
    return float(jnp.arctan2(front[0], front[2]))


@pytest.fixture(scope="module")
def chair():
    return random_chair(1_000_004, style="side chair")


@pytest.fixture(scope="module")
def one_view(chair, find):
    """The chair as it is seen in its own frame, and where it is found."""
    seen = look(chair, 40.0)
    return seen, find(seen, -chair.extents[1] / 2)


def test_a_chair_is_found_from_one_view(chair, one_view):
    _, found = one_view
    assert abs(np.degrees(yaw_of(found.T_world_object))) < 5
    assert np.linalg.norm(found.T_world_object.translation()) < 0.05
    np.testing.assert_allclose(found.size, chair.extents, rtol=0.15)
    assert found.margin > 0.01


def test_a_moved_and_turned_chair_is_found_there(chair, one_view, find):
    seen, found = one_view
    turned = turn_about_y(jnp.float32(np.pi / 2))
    T = jaxlie.SE3.from_rotation_and_translation(turned, jnp.array([3.0, 1.0, -2.0]))
    move = lambda points: camera.transform(T, points)  # noqa: E731
    elsewhere = RaySamples(move(seen.surface), move(seen.free), turned @ seen.away)
    moved = find(elsewhere, 1.0 - chair.extents[1] / 2)
    expected = (T @ found.T_world_object).as_matrix()
    np.testing.assert_allclose(moved.T_world_object.as_matrix(), expected, atol=0.02)
    np.testing.assert_allclose(moved.size, found.size, atol=0.02)


def test_a_placement_fits_the_program_that_found_it(prior, one_view):
    """Of other types, it would be compiled a second time, which takes longer than placing."""
    _, found = one_view
    expected = jax.tree.map(jax.typeof, placing.nothing_known(prior))
    assert jax.tree.map(jax.typeof, found) == expected


def test_an_earlier_placement_is_gone_on_from(chair, one_view, find):
    seen, found = one_view
    again = find(seen, floor=-chair.extents[1] / 2, known=found)
    assert again.misfit <= found.misfit + 1e-4
    moved = (found.T_world_object.inverse() @ again.T_world_object).as_matrix()
    np.testing.assert_allclose(moved, np.eye(4), atol=0.05)


def test_nothing_seen_is_nothing_placed(find):
    nan = jnp.full((SURFACE_POINTS, 3), jnp.float32(jnp.nan))
    nothing = RaySamples(nan, nan[:FREE_POINTS], nan[0])
    assert jnp.isinf(find(nothing).misfit)
