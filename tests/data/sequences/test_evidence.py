"""Poses the wrong way round."""

import numpy as np
from recordings import record, save, write_7_scenes

from jaxshape.data.sequences import open_sequence, pose_agreement, poses_look_inverted

SEEN = record(12)


def write_room(folder, *, invert):
    poses = np.linalg.inv(SEEN.T_world_camera) if invert else SEEN.T_world_camera
    write_7_scenes(folder, SEEN._replace(T_world_camera=poses))
    return open_sequence(folder)


def test_inverted_poses_are_noticed_and_right_ones_are_not(tmp_path):
    right = write_room(tmp_path / "right", invert=False)
    wrong = write_room(tmp_path / "wrong", invert=True)
    assert not poses_look_inverted(right) and poses_look_inverted(wrong)
    there, back = pose_agreement(right), pose_agreement(wrong)
    assert there.as_given > 0.8 and there.pairs > 3
    np.testing.assert_allclose((back.inverted, back.as_given), there[:2], atol=1e-6)


def test_a_sequence_that_cannot_tell_is_not_accused(tmp_path):
    write_7_scenes(tmp_path, SEEN._replace(depth=SEEN.depth[:1], T_world_camera=np.eye(4)[None]))
    assert not poses_look_inverted(open_sequence(tmp_path))  # one frame
    rest = np.tile(np.eye(4), (4, 1, 1))
    write_7_scenes(tmp_path, SEEN._replace(depth=SEEN.depth[:4], T_world_camera=rest))
    assert pose_agreement(open_sequence(tmp_path)).pairs == 0  # a camera at rest


def test_frames_without_pose_or_image_are_passed_over(tmp_path):
    sequence = write_room(tmp_path, invert=True)
    pairs = pose_agreement(sequence).pairs
    (tmp_path / "frame-000000.pose.txt").unlink()
    (tmp_path / "frame-000006.depth.png").write_bytes(b"")
    (tmp_path / "frame-000003.pose.txt").write_text("no matrix")
    save(tmp_path / "frame-000011.depth.png", np.zeros((48, 64), np.uint16))
    sequence = open_sequence(tmp_path)
    assert 0 < pose_agreement(sequence).pairs < pairs and poses_look_inverted(sequence)
