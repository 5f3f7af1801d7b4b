from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from jaxshape.geometry import camera, fusion
from jaxshape.geometry.camera import Intrinsics
from jaxshape.geometry.fusion import Measurement
from jaxshape.geometry.grid import GridFrame

RESOLUTION = 8
FRAMES = 5
IMAGE = (28, 36)
INTRINSICS = Intrinsics(*jnp.array([32.0, 30.0, 18.0, 15.0]))
FRAME = GridFrame(jnp.array([-0.5, -0.6, -0.4]), jnp.array([0.125, 0.15, 0.1]))
IN_FRONT = camera.on_sphere(jnp.array(0.0), jnp.array(0.0), 2.0)
TRACES = []


def counted_measure(*args):
    TRACES.append(args)
    return fusion.measure(*args, resolution=RESOLUTION)


measure = jax.jit(counted_measure)


def random_frames(seed=0):
    """Depths about the grid, with gaps and background, from all around, and random segments."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(1.4, 2.6, (FRAMES, *IMAGE))
    depth[rng.random(depth.shape) < 0.1] = 0
    depth[rng.random(depth.shape) < 0.1] = np.inf
    segmented = rng.random(depth.shape) < 0.7
    return jnp.float32(depth), jnp.asarray(segmented), camera.orbit(FRAMES, 2.0, step=70.0)


def pose_of(poses, *index):
    return jaxlie.SE3(poses.wxyz_xyz[index])


def measurements(frames):
    depth, segmented, poses = frames
    return [measure(depth[i], segmented[i], INTRINSICS, pose_of(poses, i), FRAME)
            for i in range(FRAMES)]  # fmt: skip


@pytest.fixture(scope="module")
def frames():
    return random_frames()


@pytest.fixture(scope="module")
def measured(frames):
    """One measurement per frame, in a list."""
    return measurements(frames)


@pytest.fixture(scope="module")
def stacked(measured):
    return jax.tree.map(lambda *x: jnp.stack(x), *measured)


def plain_depth(value):
    return jnp.full(IMAGE, value, jnp.float32)


def look(depth, segmented=True):
    segmented = jnp.full(depth.shape, segmented) if isinstance(segmented, bool) else segmented
    return measure(depth, segmented, INTRINSICS, IN_FRONT, FRAME)


def assert_equal(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def test_a_frame_agrees_with_loops_over_pixels_and_voxels(frames, measured):
    for i, (hits, seen_through) in enumerate(measured):
        depth, segmented = np.asarray(frames[0][i], np.float64), frames[1][i]
        T = np.asarray(pose_of(frames[2], i).as_matrix(), np.float64)
        fx, fy, cx, cy = map(float, INTRINSICS)
        origin, size = np.asarray(FRAME.origin, np.float64), np.asarray(FRAME.voxel_size)

        expected_hits = np.zeros((RESOLUTION,) * 3, int)
        for row, column in np.ndindex(depth.shape):
            z = depth[row, column]
            if segmented[row, column] and 0 < z < np.inf:
                ray = np.array([(column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy, 1])
                point = T[:3, :3] @ (z * ray) + T[:3, 3]
                voxel = np.floor((point - origin) / size).astype(int)
                if (voxel >= 0).all() and (voxel < RESOLUTION).all():
                    expected_hits[tuple(voxel)] += 1

        expected_seen = np.zeros((RESOLUTION,) * 3, bool)
        for voxel in np.ndindex(expected_seen.shape):
            center = origin + (np.array(voxel) + 0.5) * size
            x, y, z = T[:3, :3].T @ (center - T[:3, 3])
            row, column = int(np.floor(fy * y / z + cy)), int(np.floor(fx * x / z + cx))
            if z > 0 and 0 <= row < depth.shape[0] and 0 <= column < depth.shape[1]:
                expected_seen[voxel] = z < depth[row, column]

        assert expected_hits.sum() > 30 and 30 < expected_seen.sum() < 400
        np.testing.assert_array_equal(hits, expected_hits)
        np.testing.assert_array_equal(seen_through, expected_seen)


def test_frames_merge_one_at_a_time_all_at_once_and_cumulatively_to_the_same(measured, stacked):
    cumulative = fusion.merge_cumulative(stacked)
    total = fusion.nothing_measured(RESOLUTION)
    for i, frame in enumerate(measured):
        total = fusion.merge(total, frame)
        assert_equal(total, jax.tree.map(lambda x, i=i: x[i], cumulative))
    assert_equal(total, fusion.merge_all(stacked))


def test_merging_is_commutative_and_associative_with_nothing_measured_as_identity(measured):
    a, b, c = measured[:3]
    assert_equal(fusion.merge(a, b), fusion.merge(b, a))
    assert_equal(fusion.merge(fusion.merge(a, b), c), fusion.merge(a, fusion.merge(b, c)))
    assert_equal(fusion.merge(a, fusion.nothing_measured(RESOLUTION)), a)


@pytest.mark.parametrize("min_hits", [1, 2])
def test_every_voxel_is_occupied_or_occluded_or_seen_through(stacked, min_hits):
    occupied = fusion.occupied(stacked, min_hits)
    occluded = fusion.occluded(stacked, min_hits)
    assert occupied.any() and occluded.any()
    assert not (occupied & occluded).any()
    np.testing.assert_array_equal(occupied | occluded | stacked.seen_through, True)
    np.testing.assert_array_equal(occluded, ~occupied & ~stacked.seen_through)


def test_seeing_more_never_occludes_more(stacked):
    occluded = fusion.occluded(fusion.merge_cumulative(stacked))
    assert not (occluded[1:] & ~occluded[:-1]).any()
    assert occluded[-1].sum() < occluded[0].sum()


def test_fewer_hits_than_the_minimum_are_not_occupied():
    measurement = Measurement(
        jnp.array([[[0, 1, 2, 3]]]), jnp.array([[[False, True, False, True]]])
    )
    np.testing.assert_array_equal(fusion.occupied(measurement, 2), [[[False, False, True, True]]])
    np.testing.assert_array_equal(fusion.occluded(measurement, 2), [[[True, False, False, False]]])


def test_infinite_depth_frees_everything_and_zero_depth_says_nothing():
    nothing_there, nothing_known = look(plain_depth(jnp.inf)), look(plain_depth(0.0))
    assert nothing_there.seen_through.all()
    assert not nothing_known.seen_through.any()
    assert not nothing_there.hits.any() and not nothing_known.hits.any()


def test_voxels_outside_the_image_stay_unknown():
    narrow = INTRINSICS._replace(fx=jnp.float32(120.0), fy=jnp.float32(120.0))
    depth = plain_depth(jnp.inf)
    seen = measure(depth, jnp.ones(depth.shape, bool), narrow, IN_FRONT, FRAME).seen_through
    assert seen[4, 4].all()
    assert not seen[0].any() and not seen[-1].any()


def test_a_foreign_object_in_front_keeps_what_is_behind_it_occluded():
    left = jnp.arange(IMAGE[1]) < INTRINSICS.cx
    depth = jnp.where(left, plain_depth(0.8), plain_depth(jnp.inf))
    measurement = look(depth, segmented=jnp.zeros(depth.shape, bool))
    assert not fusion.occupied(measurement).any()
    occluded = fusion.occluded(measurement)
    assert occluded[:4].all()
    assert not occluded[4:].any()


def test_a_wall_frees_what_is_in_front_of_it_and_occludes_what_is_behind():
    measurement = look(plain_depth(1.95))  # the plane z = 0.05: inside voxels [:, :, 4]
    occluded = fusion.occluded(measurement)
    assert fusion.occupied(measurement)[:, :, 4].any()
    assert not fusion.occupied(measurement)[:, :, [0, 1, 2, 3, 5, 6, 7]].any()
    assert occluded[:, :, :4].all()
    assert not occluded[:, :, 5:].any()


def test_points_count_where_a_histogram_counts_them_and_outside_they_are_dropped():
    rng = np.random.default_rng(0)
    points = rng.uniform(-2, RESOLUTION + 2, (3000, 3)).astype(np.float32)
    points[:3] = [[np.nan, 1, 1], [np.inf, 1, 1], [-np.inf, 1, 1]]
    points[3:6] = [[-0.01, 1, 1], [RESOLUTION, 1, 1], [0, 0, 0]]
    # np.histogramdd counts its last edge in, so that the points on it are moved off first.
    finite = points[np.isfinite(points).all(1) & (points < RESOLUTION).all(1)]
    expected, _ = np.histogramdd(finite, bins=[np.arange(RESOLUTION + 1)] * 3)
    hits = fusion.count_points(jnp.asarray(points), RESOLUTION)
    np.testing.assert_array_equal(hits, expected)


def test_vmap_over_objects_and_frames_equals_loops(frames, measured):
    depth, segmented, poses = frames
    smaller = GridFrame(FRAME.origin * 0.7, FRAME.voxel_size * 0.7)
    both = jax.tree.map(lambda a, b: jnp.stack([a, b]), FRAME, smaller)
    one = partial(fusion.measure, resolution=RESOLUTION)
    over_frames = jax.vmap(one, (0, 0, None, 0, None))
    batched = jax.jit(jax.vmap(over_frames, (None, None, None, None, 0)))(
        depth, segmented, INTRINSICS, poses, both
    )
    for i in range(FRAMES):
        small = measure(depth[i], segmented[i], INTRINSICS, pose_of(poses, i), smaller)
        assert_equal(jax.tree.map(lambda x, i=i: x[0, i], batched), measured[i])
        assert_equal(jax.tree.map(lambda x, i=i: x[1, i], batched), small)


def test_other_values_of_the_same_shape_are_not_traced_again(frames):
    measurements(frames)
    traces = len(TRACES)
    measurements(random_frames(seed=1))
    look(plain_depth(2.0))
    assert len(TRACES) == traces == 1
