"""The 7-Scenes layout, and the images, poses and intrinsics that all layouts share."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageFile

from jaxshape.data.sequences import SequenceError, check_rigid, open_sequence

H, W = 6, 8
K = np.array([[10.0, 0, W / 2], [0, 10.0, H / 2], [0, 0, 1]])


def write_frame(folder, number, *, depth=None, color=None, pose=None, mask=None):
    stem = folder / f"frame-{number}"
    depth = np.full((H, W), 2000, np.uint16) if depth is None else depth
    Image.fromarray(depth).save(f"{stem}.depth.png")
    np.savetxt(f"{stem}.pose.txt", np.eye(4) if pose is None else pose)
    if color is not None:
        Image.fromarray(color).save(f"{stem}.color.png")
    if mask is not None:
        Image.fromarray(mask).save(f"{stem}.mask.png")


@pytest.fixture
def folder(tmp_path):
    np.savetxt(tmp_path / "camera-intrinsics.txt", K)
    write_frame(tmp_path, "000000")
    return tmp_path


def translation(*t):
    T = np.eye(4)
    T[:3, 3] = t
    return T


# What is read is what was written


def test_a_frame_comes_back_as_written(folder):
    rng = np.random.default_rng(0)
    raw = rng.integers(1000, 4000, (H, W)).astype(np.uint16)
    raw[0, :3] = 0, 65535, 65534
    color = rng.integers(0, 256, (H, W, 3)).astype(np.uint8)
    mask = rng.integers(0, 2, (H, W)).astype(np.uint8) * 3
    pose = translation(1, 2, 3)
    write_frame(folder, "000000", depth=raw, color=color, pose=pose, mask=mask)

    sequence = open_sequence(folder)
    frame = sequence[0]
    assert frame.name == "frame-000000" and sequence.names == ("frame-000000",)
    assert frame.depth.dtype == np.float32
    np.testing.assert_allclose(frame.depth, np.where(raw == 65535, 0, raw / 1000), rtol=1e-6)
    np.testing.assert_array_equal(frame.color, color)
    np.testing.assert_array_equal(frame.mask, mask > 0)
    np.testing.assert_array_equal(frame.T_world_camera, pose)
    np.testing.assert_array_equal(sequence.intrinsics, K)


def test_colour_and_mask_are_optional_and_colour_may_be_jpeg(folder):
    assert open_sequence(folder)[0].color is None and open_sequence(folder)[0].mask is None
    Image.new("RGB", (W, H), (255, 0, 0)).save(folder / "frame-000000.color.jpg")
    color = open_sequence(folder)[0].color
    assert color is not None and color[..., 0].min() > 250 and color[..., 1:].max() < 5
    (folder / "frame-000000.color.jpg").rename(folder / "frame-000000.color.jpeg")
    np.testing.assert_array_equal(open_sequence(folder)[0].color, color)


def test_names_may_be_in_capitals(folder):
    write_frame(folder, "000001", color=np.full((H, W, 3), 9, np.uint8))
    first, second = open_sequence(folder)
    for path in folder.glob("frame-*"):
        path.rename(folder / path.name.upper())
    again = open_sequence(folder)
    assert len(again) == 2 and again.names == (first.name, second.name)
    np.testing.assert_array_equal(again[1].color, second.color)
    np.testing.assert_array_equal(again[1].depth, second.depth)


@pytest.mark.parametrize("scale", [1000.0, 5000.0])
def test_depth_scale_is_units_per_metre(folder, scale):
    write_frame(folder, "000000", depth=np.full((H, W), int(1.5 * scale), np.uint16))
    np.testing.assert_allclose(open_sequence(folder, depth_scale=scale)[0].depth, 1.5)


def test_frames_come_in_the_order_of_their_numbers(folder):
    for number in ("2", "10", "000001"):
        write_frame(folder, number, pose=translation(int(number), 0, 0))
    sequence = open_sequence(folder)
    assert len(sequence) == 4
    assert [frame.T_world_camera[0, 3] for frame in sequence] == [0, 1, 2, 10]
    assert sequence[-1].name == "frame-10"
    with pytest.raises(IndexError):
        sequence[4]


def test_intrinsics_may_lie_in_the_parent_folder(tmp_path):
    (tmp_path / "frames").mkdir()
    write_frame(tmp_path / "frames", "0")
    np.savetxt(tmp_path / "camera-intrinsics.txt", K)
    np.testing.assert_array_equal(open_sequence(tmp_path / "frames").intrinsics, K)


def test_opening_decodes_no_image_and_a_frame_only_its_own(tmp_path, monkeypatch):
    np.savetxt(tmp_path / "camera-intrinsics.txt", K)
    write_frame(tmp_path, "0")
    depth, pose = (tmp_path / f"frame-0.{end}" for end in ("depth.png", "pose.txt"))
    for number in range(1, 2000):
        (tmp_path / f"frame-{number}.depth.png").hardlink_to(depth)
        (tmp_path / f"frame-{number}.pose.txt").hardlink_to(pose)
    decoded, load = [], ImageFile.ImageFile.load

    def counting_load(image):
        decoded.append(image)
        return load(image)

    monkeypatch.setattr(ImageFile.ImageFile, "load", counting_load)
    sequence = open_sequence(tmp_path)
    assert len(sequence) == 2000 and not decoded
    assert sequence[1234].name == "frame-1234"
    assert {Path(image.filename).name for image in decoded} == {"frame-1234.depth.png"}


# Every fault is one sentence that names the file, what was found and what to do


def fault_of(folder, **settings):
    with pytest.raises(SequenceError) as caught:
        list(open_sequence(folder, **settings))
    return str(caught.value)


def test_a_frame_without_a_pose_and_a_pose_without_a_frame(folder):
    for number in ("000001", "000002", "000003"):
        write_frame(folder, number)
    (folder / "frame-000001.pose.txt").unlink()
    (folder / "frame-000002.depth.png").unlink()
    sequence = open_sequence(folder)
    assert [frame.name[-1] for frame in sequence if frame.T_world_camera is None] == ["1"]
    assert sequence.has_poses and sequence.names[-2:] == ("frame-000001", "frame-000003")
    assert "without a depth image: 1, the first of frame-000002" in sequence.findings[0].evidence


def test_a_sequence_without_poses(folder):
    (folder / "frame-000000.pose.txt").unlink()
    sequence = open_sequence(folder)
    assert not sequence.has_poses and sequence[0].T_world_camera is None


def test_missing_folder_frames_or_intrinsics(folder, tmp_path):
    assert "is not a folder" in fault_of(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    assert "holds no recording but nothing" in fault_of(tmp_path / "empty")
    (folder / "camera-intrinsics.txt").unlink()
    assert "camera-intrinsics.txt is missing" in fault_of(folder)


@pytest.mark.parametrize("kind", ["depth", "color", "mask"])
def test_truncated_images(folder, kind):
    noise = np.random.default_rng(0).integers(0, 256, (H, W, 3)).astype(np.uint8)
    write_frame(folder, "000001", color=noise, mask=noise[..., 0])
    path = folder / f"frame-000001.{kind}.png"
    whole = path.read_bytes()
    for cut in (0, 20, len(whole) - 30):
        path.write_bytes(whole[:cut])
        message = fault_of(folder)
        assert str(path) in message and "cannot be read as an image" in message


def test_a_depth_image_of_8_bit_or_of_colours(folder):
    write_frame(folder, "000000", depth=np.full((H, W), 200, np.uint8))
    assert "Pillow mode L; expected a depth image with one channel of 16 bit" in fault_of(folder)
    write_frame(folder, "000000", depth=np.full((H, W, 3), 200, np.uint8))
    assert "Pillow mode RGB" in fault_of(folder)


@pytest.mark.parametrize("kind", ["depth", "color", "mask"])
def test_images_of_another_aspect(folder, kind):
    write_frame(folder, "000000", color=np.zeros((H, W, 3), np.uint8))
    pixels = np.full((H, W + 1), 200, np.uint16 if kind == "depth" else np.uint8)
    write_frame(folder, "000001", **{kind: pixels})
    message = fault_of(folder)
    assert f"frame-000001.{kind}.png is 9 x 6 pixels; expected 8 x 6" in message


@pytest.mark.parametrize(
    "raw, scale, said, meant",
    [
        (1900, 1.0, "1.9 km", 1000),
        (10000, 200000.0, "50 mm", "4000, 5000, 6553.5 or 10000"),
        (60000, 1000.0, "60 m", 10000),
    ],
)
def test_a_wrong_depth_scale_is_named_with_a_likely_one(folder, raw, scale, said, meant):
    write_frame(folder, "000000", depth=np.full((H, W), raw, np.uint16))
    message = fault_of(folder, depth_scale=scale)
    assert f"the median depth is {said}" in message
    assert f"is --depth-scale {meant} meant?" in message


def test_a_depth_scale_of_zero_and_a_frame_without_depth(folder):
    assert "The depth scale is 0" in fault_of(folder, depth_scale=0.0)
    write_frame(folder, "000000", depth=np.zeros((H, W), np.uint16))
    assert not open_sequence(folder)[0].depth.any()  # legal: nothing was measured


@pytest.mark.parametrize("text", ["nan", "-inf", "1.#INF", "-1.#IND"])
def test_lost_poses_are_none(folder, text):
    row = " ".join([text] * 4)
    write_frame(folder, "000001")
    (folder / "frame-000000.pose.txt").write_text(f"{row}\n{row}\n{row}\n0 0 0 1\n")
    poses = [frame.T_world_camera for frame in open_sequence(folder)]
    assert poses[0] is None and poses[1] is not None


@pytest.mark.parametrize(
    "pose, said",
    [
        (np.diag([2.0, 2, 2, 1]), "not orthonormal"),
        (np.diag([-1.0, 1, 1, 1]), "mirrors"),
        (translation(1, 0, 0).T, "last row"),
        (np.eye(3), "is not a matrix"),
        (np.eye(4)[:2], "is not a matrix"),
    ],
)
def test_poses_that_are_not_rigid(folder, pose, said):
    write_frame(folder, "000000", pose=pose)
    message = fault_of(folder)
    assert "frame-000000.pose.txt" in message and said in message


def test_poses_that_are_not_numbers(folder):
    (folder / "frame-000000.pose.txt").write_text("1 0 0 zero\n")
    assert "could not convert string to float: 'zero'" in fault_of(folder)


def test_a_rigid_motion_passes_and_nan_does_not():
    with pytest.raises(SequenceError, match="a motion holds NaN or infinity"):
        check_rigid(np.full((4, 4), np.nan), "a motion")
    rotation = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    T = translation(1, 2, 3)
    T[:3, :3] = rotation * np.sign(np.linalg.det(rotation))
    check_rigid(T, "a motion")


@pytest.mark.parametrize(
    "matrix, said",
    [
        (K * [[-1], [1], [1]], "focal lengths -10, 10"),
        (K * [[0], [1], [1]], "focal lengths 0, 10"),
        (K * [[2], [2], [1]], "principal point at 8, 6"),
        (K * [[1], [1], [2]], r"last row [0.0, 0.0, 2.0]"),
        (K + [[0, 1, 0], [0, 0, 0], [0, 0, 0]], "has 1 and 0 beside its focal lengths"),
        (K[:2], "is not a matrix"),
    ],
)
def test_intrinsics_that_do_not_fit(folder, matrix, said):
    np.savetxt(folder / "camera-intrinsics.txt", matrix)
    assert said in fault_of(folder)
