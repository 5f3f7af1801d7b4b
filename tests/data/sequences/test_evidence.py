"""Pairs of frames and the share of pixels on which they agree."""

import numpy as np
import pytest
from recordings import record, save, write_7_scenes

from jaxshape.data.sequences import open_sequence
from jaxshape.data.sequences.evidence import agreement, seen_by, telling_pairs

SEEN = record(12)


def pairs_of(folder, poses=SEEN.T_world_camera):
    write_7_scenes(folder, SEEN._replace(T_world_camera=poses))
    return telling_pairs(open_sequence(folder))


def test_pairs_do_not_depend_on_how_poses_are_written(tmp_path):
    right = pairs_of(tmp_path / "a")
    wrong = pairs_of(tmp_path / "b", np.linalg.inv(SEEN.T_world_camera))
    assert len(right) == len(wrong) > 3
    for one, other in zip(right, wrong, strict=True):
        np.testing.assert_array_equal(one.depth_b, other.depth_b)
    there, back = seen_by(right), seen_by(wrong)
    assert agreement(there) > 0.95 and agreement(back) < 0.5
    assert agreement(back, ("inverted",)) == pytest.approx(agreement(there), abs=1e-6)


def test_poses_and_depth_that_grow_together_agree_as_before(tmp_path):
    poses = SEEN.T_world_camera.copy()
    seen = seen_by(pairs_of(tmp_path / "a", poses))
    poses[:, :3, 3] /= 4
    smaller = seen_by(pairs_of(tmp_path / "b", poses))
    assert agreement(smaller, longer=4.0) == pytest.approx(agreement(seen), abs=1e-6)
    assert agreement(smaller) < agreement(seen) - 0.05


def test_poses_that_turn_the_camera_away_win_nothing(tmp_path):
    poses = SEEN.T_world_camera.copy()
    poses[::2, :3, 3] += [0, 0, 50]
    seen = seen_by(pairs_of(tmp_path, poses))
    assert agreement(seen) < 0.5


def test_frames_without_pose_or_image_are_passed_over(tmp_path):
    count = len(pairs_of(tmp_path))
    (tmp_path / "frame-000000.pose.txt").unlink()
    (tmp_path / "frame-000006.depth.png").write_bytes(b"")
    (tmp_path / "frame-000003.pose.txt").write_text("no matrix")
    save(tmp_path / "frame-000011.depth.png", np.zeros((48, 64), np.uint16))
    pairs = telling_pairs(open_sequence(tmp_path))
    assert 0 < len(pairs) < count and agreement(seen_by(pairs)) > 0.9
    assert agreement(()) == 0
