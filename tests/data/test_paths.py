"""Camera paths measure what the settings say, and every draw is a function of the seed."""

from dataclasses import replace

import jax
import numpy as np
import pytest
import trimesh

from jaxshape.data.capture import camera_distance, capture, measure_frames
from jaxshape.data.config import DATASETS, FAULTLESS, DatasetConfig
from jaxshape.data.faults import Frames
from jaxshape.data.paths import FARTHEST, NEAREST, draw_box, draw_path, draw_poses, padded
from jaxshape.data.virtual_cameras import CAMERAS
from jaxshape.geometry import camera, fusion

BOX = trimesh.creation.box((0.5, 0.9, 0.6))
QUICK = DatasetConfig(
    frames=(1, 2), cameras=("paper",), noisy=0.0, arcs=0.0, faults=FAULTLESS, resolution=16
)


def test_more_frames_know_more():
    path = draw_path(BOX, replace(QUICK, frames=(1, 2, 6)), 3)
    unknown = np.asarray(path.measured.occluded).sum(axis=(1, 2, 3))
    assert path.measured.occupied.shape == (3, 16, 16, 16)
    assert unknown[0] > unknown[1] > unknown[2]
    assert (np.asarray(path.measured.occupied) <= 1).all()


def test_a_path_of_the_paper_is_a_view_of_the_paper(monkeypatch):
    """One clean random view, fused as points: what `capture` and `measure_frames` give."""
    views = []
    original = camera.random_views
    monkeypatch.setattr(camera, "random_views", lambda *a: views.append(original(*a)) or views[-1])
    path = draw_path(BOX, replace(DATASETS["paper"], resolution=16), 5)
    captured = capture(BOX, views[0], noise=False, seed=5, resolution=16)
    expected = fusion.occupied(measure_frames(captured))
    found = np.asarray(path.measured.occupied)
    np.testing.assert_array_equal(found, np.asarray(expected))
    np.testing.assert_array_equal(path.surface, captured.surface)


def test_paths_are_functions_of_the_seed():
    first, again, other = (draw_path(BOX, QUICK, seed) for seed in (1, 1, 2))
    jax.tree.map(np.testing.assert_array_equal, first, again)
    assert (first.measured.occupied != other.measured.occupied).any()


@pytest.mark.parametrize("name", ["paper", "kinect"])
def test_arcs_stand_at_the_cameras_distance_and_turn_one_way(name):
    kind, config = CAMERAS[name], replace(QUICK, arcs=1.0, frames=(10,))
    usual = camera_distance(BOX, kind)
    for seed in range(10):
        poses = draw_poses(BOX, kind, config, np.random.default_rng(seed))
        eyes = np.asarray(poses.translation(), np.float64)
        radius = np.linalg.norm(eyes, axis=1)
        np.testing.assert_allclose(radius, radius[0], rtol=1e-4)
        assert NEAREST * usual * 0.99 < radius[0] < FARTHEST * usual * 1.01
        azimuth = np.unwrap(np.arctan2(eyes[:, 0], eyes[:, 2]))
        turns = np.diff(azimuth)
        assert (turns > 0).all() or (turns < 0).all()
        assert 59 < np.rad2deg(abs(azimuth[-1] - azimuth[0])) < 361


def test_loose_boxes_hold_the_object_and_are_at_most_6_percent_larger_on_each_side():
    loose = replace(QUICK, faults=replace(FAULTLESS, loose=1.0))
    for seed in range(20):
        low, high = draw_box(BOX, loose, np.random.default_rng(seed)) - BOX.bounds
        assert (low <= 0).all() and (high >= 0).all()
        assert (np.maximum(-low, high) <= 0.06 * BOX.extents + 1e-9).all()
        tight = draw_box(BOX, QUICK, np.random.default_rng(seed))
        np.testing.assert_array_equal(tight, BOX.bounds)


def test_padding_adds_rays_that_met_nothing():
    depth = np.ones((2, 50, 70), np.float32)
    frames = padded(Frames(depth, depth > 0, camera.orbit(2, 1.0)))
    assert frames.depth.shape == frames.segmented.shape == (2, 64, 128)
    np.testing.assert_array_equal(frames.depth[:, :50, :70], depth)
    assert np.isinf(frames.depth[:, 50:]).all() and not frames.segmented[:, :, 70:].any()


def test_settings_out_of_range_are_refused(unchecked_types):
    for wrong in (
        {"frames": ()}, {"frames": (2, 1)}, {"frames": (0, 1)}, {"paths": 0}, {"cameras": ()},
        {"cameras": ("polaroid",)}, {"noisy": 1.5}, {"arcs": -0.1},
    ):  # fmt: skip
        with pytest.raises(ValueError, match=next(iter(wrong))):
            DatasetConfig(**wrong)
