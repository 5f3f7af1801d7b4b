"""The convention of a recording is found, named and undone; a right recording is left alone."""

import numpy as np
import pytest
from recordings import CX, FX, WRITERS, H, K, W, record, write_7_scenes, write_bundlesdf, write_log
from scipy.spatial.transform import Rotation

from jaxshape.data.sequences import open_sequence
from jaxshape.data.sequences.inspection import inspect_sequence

SEEN = record(12)
T = SEEN.T_world_camera
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
V, U = np.mgrid[:H, :W] + 0.5
RAY = np.sqrt(1 + ((U - CX) / FX) ** 2 + ((V - H / 2) / FX) ** 2)
"""Length of the ray through each pixel to where its depth is 1."""


def wxyz(poses):
    """The poses that are read where x y z w was expected and w x y z was written."""
    x, y, z, w = Rotation.from_matrix(poses[:, :3, :3]).as_quat().T
    read = poses.copy()
    read[:, :3, :3] = Rotation.from_quat(np.stack([w, x, y, z], axis=-1)).as_matrix()
    return read


def shifted_by(factor, poses):
    scaled = poses.copy()
    scaled[:, :3, 3] *= factor
    return scaled


def rotations_by_columns(poses):
    read = poses.copy()
    read[:, :3, :3] = np.swapaxes(poses[:, :3, :3], 1, 2)
    return read


WRITTEN = {
    "wxyz": (wxyz(T), SEEN.depth, 1000),
    "opengl": (T @ OPENGL, SEEN.depth, 1000),
    "millimetres": (shifted_by(1000, T), SEEN.depth, 1000),
    "centimetres": (shifted_by(100, T), SEEN.depth, 1000),
    "inverted": (np.linalg.inv(T), SEEN.depth, 1000),
    "transposed": (np.swapaxes(T, 1, 2), SEEN.depth, 1000),
    "ray": (T, SEEN.depth * RAY, 1000),
    "mirrored": (T, SEEN.depth[:, :, ::-1], 1000),
    "--depth-scale 4000": (T, SEEN.depth, 4000),
    "--depth-scale 6553.5": (T, SEEN.depth, 6553.5),
    "inverted opengl": (np.linalg.inv(T @ OPENGL), SEEN.depth, 1000),
    "wxyz inverted": (wxyz(np.linalg.inv(T)), SEEN.depth, 1000),
    "millimetres opengl": (shifted_by(1000, T @ OPENGL), SEEN.depth, 1000),
    "opengl --depth-scale 4000": (T @ OPENGL, SEEN.depth, 4000),
}
"""Poses, depth and depth scale as they are written, by what has to be found."""


def write(folder, poses, depth, scale):
    write_7_scenes(folder, SEEN._replace(T_world_camera=poses, depth=depth), scale)
    return open_sequence(folder)


@pytest.mark.parametrize("name", WRITTEN)
def test_each_convention_is_found_named_and_undone(tmp_path, name):
    found = inspect_sequence(write(tmp_path, *WRITTEN[name]))
    warning, *others = found.warnings
    assert len(others) == (name == "mirrored")  # its colours and masks
    stated = f"--convention {name}" if not name.startswith("--") else name
    assert f"It is read in this convention. {stated} confirms it" in warning.advice, warning
    assert "then 9" in warning.evidence and found.poses.is_used and found.poses.agreement > 0.95
    for i, frame in enumerate(found.sequence):
        np.testing.assert_allclose(frame.T_world_camera, T[i], atol=1e-6)
        np.testing.assert_allclose(frame.depth, SEEN.depth[i], atol=1e-3)
    assert found.depths.median == pytest.approx(np.median(SEEN.depth), rel=0.1)


@pytest.mark.parametrize("name", ["wxyz", "ray", "opengl --depth-scale 4000"])
def test_a_convention_that_is_stated_is_used_and_not_doubted(tmp_path, name):
    sequence = write(tmp_path, *WRITTEN[name])
    names = tuple(name.split(" --")[0].split())
    found = inspect_sequence(sequence, names)
    rest = [warning for warning in found.warnings if "--depth-scale 4000" not in warning.advice]
    assert not rest and not found.poses.is_used
    np.testing.assert_allclose(found.sequence[3].T_world_camera, T[3], atol=1e-6)


def test_what_is_denied_or_known_is_named_but_not_used(tmp_path):
    sequence = write(tmp_path / "a", *WRITTEN["opengl"])
    found = inspect_sequence(sequence, ("as-given",))
    assert "Is --convention opengl meant?" in " ".join(w.advice for w in found.warnings)
    np.testing.assert_array_equal(found.sequence[3].T_world_camera, sequence[3].T_world_camera)
    found = inspect_sequence(write(tmp_path / "b", T, SEEN.depth, 4000), keep_scale=True)
    assert found.sequence.depth_scale == 1000 and not found.poses.is_used
    assert "Is --depth-scale 4000 meant?" in found.warnings[0].advice


def test_poses_that_fit_less_well_than_usual_are_doubted(tmp_path):
    """A focal length that is wrong enough to bend the room, but not to tear it."""
    write(tmp_path, T, SEEN.depth, 1000)
    wrong = np.where(np.eye(3, dtype=bool), np.diag([0.6 * FX, 0.6 * FX, 1.0]), K)
    np.savetxt(tmp_path / "camera-intrinsics.txt", wrong)
    found = inspect_sequence(open_sequence(tmp_path))
    assert 0.5 < found.poses.agreement < 0.7
    (said,) = [one for one in found.warnings if "less well than usual" in one.evidence]
    assert "focal length" in said.advice


def test_colours_beside_mirrored_depth_are_named(tmp_path):
    found = inspect_sequence(write(tmp_path, *WRITTEN["mirrored"]))
    assert "colour images and masks are read as they are" in found.warnings[1].evidence
    for path in tmp_path.glob("*.color.png"):
        path.unlink()
    found = inspect_sequence(open_sequence(tmp_path))
    assert "mirrored, and masks are read as they are" in found.warnings[1].evidence
    for path in tmp_path.glob("*.mask.png"):
        path.unlink()
    assert len(inspect_sequence(open_sequence(tmp_path)).warnings) == 1


def test_an_unusual_depth_scale_is_found_along_a_continuum(tmp_path):
    found = inspect_sequence(write(tmp_path, T, SEEN.depth, 3300))
    assert found.sequence.depth_scale == pytest.approx(3300, rel=0.05)


def test_poses_without_a_metric_scale_may_be_the_cause_of_an_odd_depth_scale(tmp_path):
    """Both fit alike. The factor in the advice makes the poses metric."""
    found = inspect_sequence(write(tmp_path, shifted_by(1 / 2.7, T), SEEN.depth, 1000))
    (said,) = [one for one in found.warnings if "COLMAP" in one.evidence]
    factor = float(said.advice.rstrip(".").rpartition(" ")[2])
    assert factor == pytest.approx(2.7, rel=0.05)
    assert f"{1 / factor:.2g}" in said.advice and "1000 units a metre" in said.advice
    usual = inspect_sequence(write(tmp_path / "usual", T, SEEN.depth, 4000))
    assert not any("COLMAP" in one.evidence for one in usual.warnings)


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("seed", range(2))
def test_a_right_recording_with_noise_is_left_alone(tmp_path, name, seed):
    noise = np.random.default_rng(seed).normal(0, 1.6e-3, SEEN.depth.shape) * SEEN.depth**2
    WRITERS[name](tmp_path, SEEN._replace(depth=SEEN.depth + noise))
    found = inspect_sequence(open_sequence(tmp_path))
    assert found.warnings == () and found.poses.reading.best is None
    assert found.poses.agreement > 0.8


def test_matrices_by_columns_of_object_to_camera_and_of_a_log(tmp_path):
    write_bundlesdf(tmp_path / "a", SEEN)
    for path in (tmp_path / "a/ob_in_cam").iterdir():
        np.savetxt(path, np.loadtxt(path).T)
    write_log(tmp_path / "b.log", np.swapaxes(T, 1, 2))
    write_bundlesdf(tmp_path / "b", SEEN)
    for path in (tmp_path / "b/ob_in_cam").iterdir():
        path.unlink()
    (tmp_path / "b/ob_in_cam").rmdir()
    (tmp_path / "b.log").rename(tmp_path / "b/trajectory.log")
    for folder in ("a", "b"):
        found = inspect_sequence(open_sequence(tmp_path / folder))
        assert "--convention transposed confirms it" in found.warnings[0].advice
        for i, frame in enumerate(found.sequence):
            np.testing.assert_allclose(frame.T_world_camera, T[i], atol=1e-6)


def test_rotations_alone_by_columns(tmp_path):
    found = inspect_sequence(write(tmp_path, rotations_by_columns(T), SEEN.depth, 1000))
    np.testing.assert_allclose(found.sequence[5].T_world_camera, T[5], atol=1e-6)


def test_a_camera_at_rest_tells_nothing(tmp_path):
    still = SEEN.depth[:1].repeat(6, axis=0)
    poses = np.tile(np.eye(4), (6, 1, 1)) @ OPENGL
    write_7_scenes(tmp_path, SEEN._replace(depth=still, T_world_camera=poses))
    found = inspect_sequence(open_sequence(tmp_path))
    assert found.poses.reading.pairs == 0 and found.poses.reading.best is None
