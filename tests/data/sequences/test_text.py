"""Numbers in text files as people and their tools write them."""

import codecs

import numpy as np
import pytest
from recordings import record, tum_line, write_open3d, write_tum

from jaxshape.data.sequences import SequenceError, open_sequence, read_trajectory
from jaxshape.data.sequences.inspection import inspect_sequence
from jaxshape.data.sequences.poses import read_matrix

SEEN = record(6)
PLAIN = "1 0 0 2\n0 1 0 3\n0 0 1 -4.5\n0 0 0 1\n"


@pytest.mark.parametrize(
    "content",
    [
        PLAIN.encode(),
        codecs.BOM_UTF8 + PLAIN.encode(),
        PLAIN.encode("utf-16"),
        PLAIN.encode("utf-16-le"),
        PLAIN.encode("utf-16-be"),
        PLAIN.replace("\n", "\r\n").encode(),
        PLAIN.replace(" ", ", ").encode(),
        ("# camera to world\n\n" + PLAIN.replace("\n", " // a row\n")).encode(),
        PLAIN.replace(" ", ",").replace("\n", "],\n[").rstrip("[").encode(),
        PLAIN.replace("\n", " ").encode(),
        PLAIN.removesuffix("0 0 0 1\n").encode(),
        PLAIN.removesuffix("0 0 0 1\n").replace("\n", " ").encode(),
    ],
)
def test_a_matrix_however_it_is_written(tmp_path, content):
    (tmp_path / "pose.txt").write_bytes(content)
    expected = [[1, 0, 0, 2], [0, 1, 0, 3], [0, 0, 1, -4.5], [0, 0, 0, 1]]
    np.testing.assert_array_equal(read_matrix(tmp_path / "pose.txt", 4), expected)


def test_lines_of_another_length_are_refused_with_their_number(tmp_path):
    path = tmp_path / "way.txt"
    path.write_text("# time\n" + "1 0 0 0 0 0 0 1\n" + "2 0 0 0 0 0 0 1 7\n")
    with pytest.raises(SequenceError, match="line 3 holds 9 numbers, not 8"):
        read_trajectory(path)
    path.write_text("#timestamp, p, q, v, bw, ba\n" + ",".join(["1"] * 17) + "\n")
    with pytest.raises(
        SequenceError, match="17 numbers, not 8; of a EuRoC file, keep .* put w last"
    ):
        read_trajectory(path)


def test_a_trajectory_of_utf_16_with_commas(tmp_path):
    lines = [tum_line(i, T).replace(" ", ", ") for i, T in enumerate(SEEN.T_world_camera)]
    (tmp_path / "way.txt").write_bytes("\n".join(lines).encode("utf-16"))
    way = read_trajectory(tmp_path / "way.txt")
    np.testing.assert_allclose(way.T_world_camera, SEEN.T_world_camera, atol=1e-9)


def test_a_list_of_windows_is_read(tmp_path):
    write_tum(tmp_path, SEEN)
    for name in ("depth.txt", "rgb.txt"):
        text = (tmp_path / name).read_text().replace("/", "\\").replace("\n", "\r\n")
        (tmp_path / name).write_bytes(text.encode())
    frame = open_sequence(tmp_path)[2]
    np.testing.assert_allclose(frame.depth, SEEN.depth[2], rtol=1e-6)
    np.testing.assert_array_equal(frame.color, SEEN.color[2])


def test_times_that_do_not_rise(tmp_path):
    write_tum(tmp_path, SEEN)
    lines = (tmp_path / "depth.txt").read_text().splitlines()
    (tmp_path / "depth.txt").write_text(
        "\n".join(
            f"{0.033 + 0.001 * (i % 2)} {line.split()[1]}" for i, line in enumerate(lines[2:])
        )
    )
    with pytest.raises(
        SequenceError, match="times that do not rise.*not intervals between frames: write"
    ):
        open_sequence(tmp_path)


def test_time_bases_without_overlap_are_named(tmp_path):
    write_tum(tmp_path, SEEN)
    way = [tum_line(t + 1e9, T) for t, T in zip(SEEN.times, SEEN.T_world_camera, strict=True)]
    (tmp_path / "groundtruth.txt").write_text("\n".join(way))
    found = inspect_sequence(open_sequence(tmp_path))
    assert found.poses is None
    (warning,) = found.warnings
    assert "no time in common" in warning.evidence and "1000000100.000" in warning.evidence


@pytest.mark.parametrize(
    "name", ["pose.txt", "CameraTrajectory.txt", "scene_gt.json", "trajectory.txt", "poses.npy"]
)
def test_poses_that_are_not_read_are_named(tmp_path, name):
    write_open3d(tmp_path, SEEN)
    (tmp_path / "trajectory.log").unlink()
    assert inspect_sequence(open_sequence(tmp_path)).warnings == ()
    (tmp_path / name).write_text("{}")
    (warning,) = inspect_sequence(open_sequence(tmp_path)).warnings
    assert f"no poses are read, though {name} may hold them" in warning.evidence


@pytest.mark.parametrize(
    "name", ["camera_matrix.csv", "K_intrinsics.npy", "intrinsic/calibration.txt", "metadata"]
)
def test_cameras_that_are_not_read_are_named(tmp_path, name):
    write_open3d(tmp_path, SEEN)
    (tmp_path / "camera_primesense.json").unlink()
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("{}")
    sequence = open_sequence(tmp_path)
    assert sequence.camera_is_guess
    said = [f.evidence for f in sequence.findings if "no camera is read" in f.evidence]
    assert (len(said) == 1 and name.split("/")[0] in said[0]) == (name != "metadata")
