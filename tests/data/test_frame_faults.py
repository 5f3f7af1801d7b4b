"""Each fault changes images or poses as its name says, in its share, and nothing else changes."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linprog

from jaxshape.data.config import FAULTLESS
from jaxshape.data.faults import POSE_ERROR, pixel_rays, with_faults
from jaxshape.geometry import camera
from jaxshape.geometry.camera import Intrinsics

SIZE = np.array([0.6, 1.0, 0.6])
CAMERA = Intrinsics(*jnp.float32([60, 60, 24, 24]))
POSES = camera.orbit(4, 2.0)
FRAMES = 4


def ball(radius=0.35):
    """Depth images of a ball at the origin, with nothing behind it."""
    rays = pixel_rays(CAMERA, (48, 48))
    images = []
    for pose in np.asarray(POSES.as_matrix(), np.float64):
        directions = rays @ pose[:3, :3].T
        a, b = (directions**2).sum(-1), directions @ pose[:3, 3]
        inside = b**2 - a * (pose[:3, 3] @ pose[:3, 3] - radius**2)
        depth = (-b - np.sqrt(np.maximum(inside, 0))) / a
        images.append(np.where(inside > 0, depth, np.inf))
    return np.float32(images)


DEPTH = ball()


def struck(seed=0, **shares):
    rng = np.random.default_rng(seed)
    return with_faults(DEPTH, CAMERA, POSES, SIZE, replace(FAULTLESS, **shares), rng)


def test_without_faults_frames_stay_as_they_are():
    before = DEPTH.copy()
    frames = struck()
    np.testing.assert_array_equal(frames.depth, DEPTH)
    np.testing.assert_array_equal(frames.segmented, np.isfinite(DEPTH))
    np.testing.assert_allclose(frames.T_object_camera.as_matrix(), POSES.as_matrix(), atol=1e-6)
    struck(hidden=1.0, missing=1.0, segmentation=1.0)
    np.testing.assert_array_equal(DEPTH, before)


def test_a_pose_error_moves_poses_by_its_deviation_and_images_not_at_all():
    moves = []
    for seed in range(100):
        frames = struck(seed, pose_error=1.0)
        np.testing.assert_array_equal(frames.depth, DEPTH)
        moves.append((POSES.inverse() @ frames.T_object_camera).log())
    deviations = np.std(np.concatenate(moves), axis=0)
    np.testing.assert_allclose(deviations, np.repeat(POSE_ERROR, 3), rtol=0.2)


def test_what_is_missing_is_a_disc_about_a_pixel_of_the_object():
    for seed in range(20):
        frames = struck(seed, missing=1.0)
        for lost, before in zip(frames.depth == 0, DEPTH, strict=True):
            assert lost.any() and np.isfinite(before[lost]).any()
            row, column = np.nonzero(lost)
            extent = max(np.ptp(row), np.ptp(column)) + 1
            assert extent <= 2 * 0.12 * 48 + 1
        assert not frames.segmented[frames.depth == 0].any()


def test_a_wrong_mask_cuts_a_side_off_or_takes_in_floor():
    cuts, leaks = 0, 0
    for seed in range(40):
        frames = struck(seed, segmentation=1.0)
        before = np.isfinite(DEPTH)
        for mask, depth, was, known in zip(
            frames.segmented, frames.depth, before, DEPTH, strict=True
        ):
            if (mask & ~was).any():
                leaks += 1
                added = mask & ~was
                points = floor_points(frames, added)
                np.testing.assert_allclose(points[:, 1], -SIZE[1] / 2, atol=1e-4)
                np.testing.assert_array_equal(depth[~added], known[~added])
            elif (was & ~mask).any():
                cuts += 1
                assert (was & ~mask).sum() < 0.3 * was.sum() + 48
                np.testing.assert_array_equal(depth, known)
    assert cuts > 40 and leaks > 20


def floor_points(frames, added):
    """Object-frame points of the pixels added to one of the images, whichever it is."""
    for depth, pose, was in zip(
        frames.depth, np.asarray(POSES.as_matrix(), np.float64), np.isfinite(DEPTH), strict=True
    ):
        if (np.isfinite(depth) & ~was)[added].all():
            rays = pixel_rays(CAMERA, depth.shape)[added]
            return (rays * depth[added][:, None]) @ pose[:3, :3].T + pose[:3, 3]
    raise AssertionError("no image has these pixels")


def test_a_hidden_side_is_the_same_in_all_frames():
    for seed in range(20):
        frames = struck(seed, hidden=1.0)
        kept, lost = [], []
        for depth, pose in zip(DEPTH, np.asarray(POSES.as_matrix(), np.float64), strict=True):
            seen = np.isfinite(depth)
            points = np.full((*depth.shape, 3), np.nan)
            points[seen] = (pixel_rays(CAMERA, depth.shape)[seen] * depth[seen][:, None]) @ pose[
                :3, :3
            ].T + pose[:3, 3]
            now = frames.depth[len(kept)] > 0
            kept.append(points[seen & now & np.isfinite(frames.depth[len(kept)])])
            lost.append(points[seen & ~now])
        kept, lost = np.concatenate(kept), np.concatenate(lost)
        assert len(kept) > 0
        if len(lost) > 50:
            assert margin_between(kept, lost) > 0


def margin_between(below, above):
    """The most by which a plane parts two clouds, by a linear program; 0 where none does."""
    rows = np.concatenate([np.c_[-above, np.ones(len(above))], np.c_[below, -np.ones(len(below))]])
    rows = np.c_[rows, np.ones(len(rows))]
    bounds = [(-1, 1)] * 3 + [(None, None), (0, None)]
    return linprog([0, 0, 0, 0, -1], rows, np.zeros(len(rows)), bounds=bounds).x[-1]


@pytest.mark.parametrize("fault", ["missing", "segmentation"])
def test_a_fault_strikes_its_share_of_the_frames(fault):
    count = 0
    for seed in range(100):
        frames = struck(seed, **{fault: 0.3})
        changed = (frames.segmented != np.isfinite(DEPTH)).any(axis=(1, 2))
        count += changed.sum()
    assert 0.2 < count / (100 * FRAMES) < 0.4


def test_frames_of_nothing_go_through_every_fault():
    nothing = np.full((FRAMES, 48, 48), np.inf, np.float32)
    every = replace(FAULTLESS, pose_error=1.0, missing=1.0, segmentation=1.0, hidden=1.0)
    for seed in range(10):
        frames = with_faults(nothing, CAMERA, POSES, SIZE, every, np.random.default_rng(seed))
        assert not (frames.segmented & (frames.depth == 0)).any()
