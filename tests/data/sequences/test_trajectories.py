"""Trajectories: round trips, and texts as other tools write them."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxshape.data.sequences import (
    Pinhole,
    SequenceError,
    Trajectory,
    read_trajectory,
    write_trajectory,
)

CAMERA = Pinhole(np.array([[525.0, 0, 320], [0, 525, 240], [0, 0, 1]]), (480, 640))
QUARTER = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
"""A quarter turn about z, then a step to 1, 2, 3."""


def some_way(seed, count):
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (count, 1, 1))
    if count:
        T[:, :3, :3] = Rotation.random(count, random_state=seed).as_matrix()
    T[:, :3, 3] = rng.normal(0, 3, (count, 3))
    return Trajectory(T, np.arange(count), 1.3e9 + np.sort(rng.uniform(0, 60, count)))


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**16), count=st.integers(0, 6))
def test_a_trajectory_comes_back(tmp_path_factory, seed, count):
    folder, way = tmp_path_factory.mktemp("way"), some_way(seed, count)
    for suffix in (".txt", ".log", ".json"):
        write_trajectory(folder / f"way{suffix}", way, CAMERA)
        back = read_trajectory(folder / f"way{suffix}")
        np.testing.assert_allclose(back.T_world_camera, way.T_world_camera, atol=1e-6)
        np.testing.assert_array_equal(back.frames, way.frames)
        if suffix == ".txt":
            np.testing.assert_allclose(back.times, way.times, atol=1e-6, rtol=0)


def test_a_log_keeps_the_numbers_of_its_frames(tmp_path):
    way = some_way(0, 3)._replace(frames=np.array([0, 7, 20]))
    write_trajectory(tmp_path / "way.log", way)
    np.testing.assert_array_equal(read_trajectory(tmp_path / "way.log").frames, [0, 7, 20])


# As other tools write them ---------------------------------------------------------------------


def test_tum_as_the_benchmark_writes_it(tmp_path):
    (tmp_path / "groundtruth.txt").write_text(
        "# ground truth trajectory\n"
        "# timestamp tx ty tz qx qy qz qw\n"
        "1305031098.6659 1 2 3 0 0 0.70710678 0.70710678\n"
        "1305031098.6758 1 2 3 0 0 -0.70710678 -0.70710678\n"
        "1305031098.6860 nan nan nan nan nan nan nan\n"
    )
    way = read_trajectory(tmp_path / "groundtruth.txt")
    np.testing.assert_allclose(way.T_world_camera, [QUARTER, QUARTER], atol=1e-6)
    np.testing.assert_array_equal(way.times, [1305031098.6659, 1305031098.6758])


def test_log_as_open3d_writes_it(tmp_path):
    """Camera to world, by rows."""
    (tmp_path / "trajectory.log").write_text(
        "0 0 1\n"
        "1.00000000 0.00000000 0.00000000 0.00000000\n"
        "0.00000000 1.00000000 0.00000000 0.00000000\n"
        "0.00000000 0.00000000 1.00000000 0.00000000\n"
        "0.00000000 0.00000000 0.00000000 1.00000000\n"
        "1 1 2\n"
        "0.00000000 -1.00000000 0.00000000 1.00000000\n"
        "1.00000000 0.00000000 0.00000000 2.00000000\n"
        "0.00000000 0.00000000 1.00000000 3.00000000\n"
        "0.00000000 0.00000000 0.00000000 1.00000000\n"
    )
    way = read_trajectory(tmp_path / "trajectory.log")
    np.testing.assert_array_equal(way.T_world_camera, [np.eye(4), QUARTER])
    np.testing.assert_array_equal(way.frames, [0, 1])


def test_json_as_open3d_writes_it(tmp_path):
    """World to camera, by columns: the inverse of QUARTER has the translation -2, 1, -3."""
    (tmp_path / "camera.json").write_text(
        """{"class_name": "PinholeCameraTrajectory", "parameters": [{
            "class_name": "PinholeCameraParameters",
            "extrinsic": [0, -1, 0, 0,  1, 0, 0, 0,  0, 0, 1, 0,  -2, 1, -3, 1],
            "intrinsic": {"height": 480, "width": 640,
                "intrinsic_matrix": [525, 0, 0,  0, 525, 0,  319.5, 239.5, 1]},
            "version_major": 1, "version_minor": 0}], "version_major": 1, "version_minor": 0}"""
    )
    way = read_trajectory(tmp_path / "camera.json")
    np.testing.assert_allclose(way.T_world_camera, [QUARTER], atol=1e-12)
    write_trajectory(tmp_path / "again.json", way, CAMERA)
    texts = [json.loads((tmp_path / f"{name}.json").read_text()) for name in ("camera", "again")]
    assert texts[0] == texts[1]


def test_a_missing_extrinsic_is_the_one_that_is_named(tmp_path):
    good = {"extrinsic": np.eye(4).ravel().tolist()}
    content = {"parameters": [good, {"extrinsic": None}, good]}
    (tmp_path / "camera.json").write_text(json.dumps(content))
    with pytest.raises(SequenceError, match="the extrinsic of pose 1: None is not a number"):
        read_trajectory(tmp_path / "camera.json")


def test_a_written_log_is_open3ds_text(tmp_path):
    write_trajectory(tmp_path / "way.log", Trajectory(QUARTER[None], np.array([4])))
    text = (tmp_path / "way.log").read_text()
    assert text == "4 4 5\n0 -1 0 1\n1 0 0 2\n0 0 1 3\n0 0 0 1\n"


def test_a_tum_file_without_times_counts_frames(tmp_path):
    write_trajectory(tmp_path / "way.txt", Trajectory(QUARTER[None], np.array([4])))
    line = (tmp_path / "way.txt").read_text().splitlines()[1].split()
    assert line[0] == "4.000000"
    np.testing.assert_allclose(
        np.abs([float(x) for x in line[1:]])[[0, 1, 2, 5, 6]],
        [1, 2, 3, 0.5**0.5, 0.5**0.5],
        atol=1e-8,
    )


# What is refused -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name, text, said",
    [
        ("a.txt", "1 2 3\n", "cannot be read as a trajectory"),
        ("a.txt", "1 0 0 0 0 0 0 0\n", "quaternion of length 0"),
        ("a.log", "0 0 1\n1 0 0 0\n", "2 lines, not five"),
        ("a.log", "0 0 1\n2 0 0 0\n0 2 0 0\n0 0 2 0\n0 0 0 1\n", "Pose 0 of .* orthonormal"),
        ("a.log", "0 0 1\n" + "1 0 0 0 0 0 0 0\n" * 4, "4 x 8, not 4 x 4"),
        ("a.json", "{}", "KeyError"),
        ("a.json", '{"parameters": [{"extrinsic": [1, 2]}]}', "cannot be read as a trajectory"),
    ],
)
def test_damaged_trajectories(tmp_path, name, text, said):
    (tmp_path / name).write_text(text)
    with pytest.raises(SequenceError, match=said):
        read_trajectory(tmp_path / name)


def test_json_needs_a_camera_and_a_failure_leaves_the_old_file(tmp_path):
    (tmp_path / "way.json").write_text("old")
    with pytest.raises(ValueError, match="give the camera, or write a .log file"):
        write_trajectory(tmp_path / "way.json", some_way(0, 2))
    assert (tmp_path / "way.json").read_text() == "old"
    with pytest.raises(SequenceError, match="nowhere"):
        read_trajectory(tmp_path / "nowhere.log")
