"""One scene, written in every layout, is read as the same frames."""

import json
import shutil
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, ImageFile
from recordings import (
    OPENCV,
    WRITERS,
    H,
    K,
    W,
    raw,
    record,
    save,
    write_7_scenes,
    write_bundlesdf,
    write_open3d,
    write_redwood,
    write_tum,
)

from jaxshape.data.sequences import LAYOUTS, SequenceError, open_sequence
from jaxshape.data.sequences.figures import gaps_of

SEEN = record()


def fault_of(folder, **settings):
    with pytest.raises(SequenceError) as caught:
        list(open_sequence(folder, **settings))
    return str(caught.value)


# What is read is what was written --------------------------------------------------------------


@settings(max_examples=3, deadline=None)
@given(seed=st.integers(0, 2**16), count=st.integers(1, 12))
def test_every_layout_gives_the_same_frames(tmp_path_factory, seed, count):
    seen = record(count, seed)
    for name, write in WRITERS.items():
        folder = tmp_path_factory.mktemp("recording")
        write(folder, seen)
        sequence = open_sequence(folder)
        assert sequence.layout == name.split()[0] and len(sequence) == count, name
        assert sequence.has_poses and not sequence.findings
        np.testing.assert_allclose(sequence.intrinsics, K, err_msg=name)
        for i, frame in enumerate(sequence):
            np.testing.assert_allclose(frame.depth, seen.depth[i], rtol=1e-6, err_msg=name)
            np.testing.assert_array_equal(frame.color, seen.color[i], err_msg=name)
            np.testing.assert_array_equal(frame.mask, seen.mask[i], err_msg=name)
            np.testing.assert_allclose(frame.T_world_camera, seen.T_world_camera[i], atol=1e-6)
        shutil.rmtree(folder)


@pytest.mark.parametrize("name", WRITERS)
def test_times_of_the_layouts_that_have_them(tmp_path, name):
    WRITERS[name](tmp_path, SEEN)
    sequence = open_sequence(tmp_path)
    if name in ("tum", "redwood"):
        start = 100 if name == "tum" else 0
        np.testing.assert_allclose(sequence.times, SEEN.times - 100 + start, atol=1e-5)
        np.testing.assert_allclose(sequence.color_delays, 0.01, atol=1e-5)
        assert sequence[2].time == sequence.times[2]
    else:
        assert sequence.times is None and sequence.color_delays is None
        assert sequence[2].time is None


@pytest.mark.parametrize("name", WRITERS)
def test_a_depth_scale_of_ones_own(tmp_path, name):
    WRITERS[name](tmp_path, SEEN, scale=2000)
    sequence = open_sequence(tmp_path, depth_scale=2000.0)
    np.testing.assert_allclose(sequence[1].depth, SEEN.depth[1], rtol=1e-6)
    assert open_sequence(tmp_path).depth_scale == (5000 if name == "tum" else 1000)


def test_a_depth_scale_in_the_file_of_the_camera(tmp_path):
    write_open3d(tmp_path, SEEN, scale=4000)
    path = tmp_path / "camera_primesense.json"
    about = json.loads(path.read_text())
    path.unlink()
    (tmp_path / "intrinsic.json").write_text(json.dumps(about | {"depth_scale": 4000.0}))
    sequence = open_sequence(tmp_path)
    assert sequence.depth_scale == 4000
    np.testing.assert_allclose(sequence[1].depth, SEEN.depth[1], rtol=1e-6)
    assert open_sequence(tmp_path, depth_scale=1000.0).depth_scale == 1000
    (tmp_path / "intrinsic.json").write_text(json.dumps(about | {"depth_scale": 0}))
    assert "intrinsic.json cannot be read as a camera" in fault_of(tmp_path)


def test_a_layout_can_be_asked_for(tmp_path):
    write_redwood(tmp_path, SEEN)
    assert open_sequence(tmp_path, layout="bundlesdf").layout == "bundlesdf"
    assert "no layout 'kinect'; give one of 7-scenes, tum" in fault_of(tmp_path, layout="kinect")


# Redwood and TUM: streams with times of their own ----------------------------------------------


def test_colours_are_paired_by_time_and_dropped_ones_are_missing(tmp_path):
    write_redwood(tmp_path, SEEN, color_delay=0.012)
    sorted((tmp_path / "rgb").iterdir())[2].unlink()
    sequence = open_sequence(tmp_path)
    colors = [frame.color for frame in sequence]
    assert [color is None for color in colors] == [False, False, True, False, False, False]
    for i in (0, 1, 3, 4, 5):
        np.testing.assert_array_equal(colors[i], SEEN.color[i])
    assert np.isnan(sequence.color_delays[2])


def test_a_redwood_scan_as_it_comes_has_neither_poses_nor_a_camera_file(tmp_path):
    write_redwood(tmp_path, SEEN, poses=False)
    (tmp_path / "cam_K.txt").unlink()
    sequence = open_sequence(tmp_path)
    assert not sequence.has_poses and sequence[0].T_world_camera is None
    known = np.array([[52.5, 0, 32], [0, 52.5, 24], [0, 0, 1]])
    np.testing.assert_allclose(sequence.intrinsics, known)
    assert "Carmine" in sequence.camera and not sequence.findings


@pytest.mark.parametrize(
    "folder, fx, cx, source",
    [
        ("rgbd_dataset_freiburg1_desk", 517.3, 319.1, "freiburg1"),
        ("fr2_xyz", 520.9, 325.6, "freiburg2"),
        ("my_fr3", 535.4, 320.6, "freiburg3"),
        ("office", 525.0, 320.0, "default of ROS"),
    ],
)
def test_tum_cameras_are_known_by_the_name_of_the_folder(tmp_path, folder, fx, cx, source):
    write_tum(tmp_path / folder, SEEN)
    (tmp_path / folder / "calibration.txt").unlink()
    sequence = open_sequence(tmp_path / folder)
    assert source in sequence.camera
    np.testing.assert_allclose(sequence.intrinsics[0], [fx / 10, 0, cx / 10])
    said = [finding.evidence for finding in sequence.findings]
    assert len(said) == (source != "freiburg3") and "ROS" not in "".join(said[1:])
    assert sequence.camera_is_guess == ("ROS" in sequence.camera)
    lens = {"freiburg1": "distortion 0.2624, -0.9531", "freiburg2": "distortion 0.2312, -0.7849"}
    assert all(lens.get(source, "no camera file") in one for one in said)


@pytest.mark.parametrize("lens", ["0.26 -0.95 0 0 1.16", "0 0 0 0 0", ""])
def test_a_lens_distortion_after_the_camera_is_remarked(tmp_path, lens):
    write_tum(tmp_path, SEEN)
    (tmp_path / "calibration.txt").write_text(f"60 60\n31.5 23.5\n{lens}\n")
    sequence = open_sequence(tmp_path)
    np.testing.assert_allclose(sequence.intrinsics, K)
    said = "calibration.txt has the lens distortion 0.26, -0.95, 0, 0, 1.16, which is ignored"
    assert [one.evidence for one in sequence.findings] == [said] * ("0.26" in lens)
    assert not sequence.camera_is_guess


def test_a_calibration_may_be_a_matrix(tmp_path):
    write_tum(tmp_path, SEEN)
    np.savetxt(tmp_path / "calibration.txt", OPENCV)
    np.testing.assert_allclose(open_sequence(tmp_path).intrinsics, K)


@pytest.mark.parametrize("write, folder", [(write_tum, "fr3"), (write_redwood, "chair")])
def test_a_camera_that_is_not_read_is_named_though_another_is_known(tmp_path, write, folder):
    write(tmp_path / folder, SEEN)
    for name in ("calibration.txt", "cam_K.txt"):
        (tmp_path / folder / name).unlink(missing_ok=True)
    assert not open_sequence(tmp_path / folder).findings
    (tmp_path / folder / "intrinsics.txt").write_text("60 0 32\n0 60 24\n0 0 1\n")
    (remark,) = open_sequence(tmp_path / folder).findings
    assert "no camera is read, though intrinsics.txt may hold it" in remark.evidence


def test_rotated_depth_of_sun3d_is_refused_by_name(tmp_path):
    write_redwood(tmp_path, SEEN, scale=8000, poses=False)
    (tmp_path / "cam_K.txt").rename(tmp_path / "intrinsics.txt")
    (tmp_path / "extrinsics").mkdir()
    assert "SUN3D, whose depth images hold millimetres that are rotated" in fault_of(tmp_path)


def test_tum_poses_between_and_outside_those_given(tmp_path):
    write_tum(tmp_path, SEEN)
    path = tmp_path / "groundtruth.txt"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:3], *lines[4:]]))  # the pose at frame 2 is lost
    T = open_sequence(tmp_path)[2].T_world_camera
    np.testing.assert_allclose(T, SEEN.T_world_camera[2], atol=1e-5)  # even motion: half way
    path.write_text("\n".join(lines[:3]))
    poses = [frame.T_world_camera is not None for frame in open_sequence(tmp_path)]
    assert poses == [True, True, False, False, False, False]


def test_tum_without_colours_or_poses(tmp_path):
    write_tum(tmp_path, SEEN, poses=False)
    (tmp_path / "rgb.txt").unlink()
    sequence = open_sequence(tmp_path)
    assert not sequence.has_poses and sequence[0].color is None and sequence.color_delays is None


def test_depth_images_that_a_list_leaves_out_are_counted(tmp_path):
    write_tum(tmp_path, SEEN)
    lines = (tmp_path / "depth.txt").read_text().splitlines()
    (tmp_path / "depth.txt").write_text("\n".join(lines[:-4]))
    (remark,) = open_sequence(tmp_path).findings
    assert remark.evidence == "4 of 6 images in depth/ are not listed in depth.txt"


def test_a_list_may_hold_the_associated_colours_too(tmp_path):
    """And names may have blanks."""
    write_tum(tmp_path, SEEN)
    lines = (tmp_path / "depth.txt").read_text().splitlines()[2:]
    paired = [f"{line} {line.replace('depth/', 'rgb/')}" for line in lines]
    (tmp_path / lines[0].split()[1]).rename(tmp_path / "depth/a 1.0 b.png")
    paired[0] = lines[0].split()[0] + " depth/a 1.0 b.png"
    (tmp_path / "depth.txt").write_text("\n".join(paired))
    for i, frame in enumerate(open_sequence(tmp_path)):
        np.testing.assert_allclose(frame.depth, SEEN.depth[i], rtol=1e-6)


def test_tum_colours_without_a_list_are_found_by_name_or_missed(tmp_path):
    write_tum(tmp_path, SEEN, color_delay=0)
    (tmp_path / "rgb.txt").unlink()
    sequence = open_sequence(tmp_path)
    np.testing.assert_array_equal(sequence[3].color, SEEN.color[3])
    assert sequence.color_delays is None and not sequence.findings
    (tmp_path / "rgb").rename(tmp_path / "old")
    (tmp_path / "rgb").mkdir()
    save(tmp_path / "rgb/first.png", SEEN.color[0])
    (remark,) = open_sequence(tmp_path).findings
    assert "6 of 6 depth images have no colour" in remark.evidence


def test_masks_of_other_names_are_named(tmp_path):
    write_bundlesdf(tmp_path, SEEN)
    for path in sorted((tmp_path / "masks").iterdir()):
        path.rename(path.with_stem(f"1{path.stem}"))
    (remark,) = open_sequence(tmp_path).findings
    assert "none of 6 masks is read" in remark.evidence


# Poses -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("folder, end", [("color", ".webp"), ("color", ".bmp"), ("mask", ".npy")])
def test_images_of_a_kind_that_is_not_read_are_named(tmp_path, folder, end):
    write_open3d(tmp_path, SEEN)
    for path in (tmp_path / folder).iterdir():
        path.rename(path.with_suffix(end))
    (remark,) = open_sequence(tmp_path).findings
    assert f"none of 6 files in {folder}/ is read, {folder}_0{end} among them" == remark.evidence


def test_frames_without_a_pose(tmp_path):
    write_open3d(tmp_path / "a", SEEN)
    lines = (tmp_path / "a/trajectory.log").read_text().splitlines()
    (tmp_path / "a/trajectory.log").write_text("\n".join(lines[:5] + lines[15:20]))
    poses = [frame.T_world_camera is not None for frame in open_sequence(tmp_path / "a")]
    assert poses == [True, False, False, True, False, False]
    write_bundlesdf(tmp_path / "b", SEEN)
    (tmp_path / "b/ob_in_cam/00002.txt").unlink()
    poses = [frame.T_world_camera is not None for frame in open_sequence(tmp_path / "b")]
    assert poses == [True, True, False, True, True, True]


def test_poses_of_other_frames_than_there_are(tmp_path):
    write_open3d(tmp_path, SEEN)
    for name in ("depth/depth_5.png", "depth/depth_4.png"):
        (tmp_path / name).unlink()
    assert "poses of frames up to 5, and there are 4 depth images" in fault_of(tmp_path)


def test_poses_of_bundlesdf_may_be_camera_to_world(tmp_path):
    write_bundlesdf(tmp_path, SEEN)
    shutil.rmtree(tmp_path / "ob_in_cam")
    assert not open_sequence(tmp_path).has_poses
    (tmp_path / "poses").mkdir()
    np.savetxt(tmp_path / "poses/3.txt", SEEN.T_world_camera[3])
    np.testing.assert_allclose(open_sequence(tmp_path)[3].T_world_camera, SEEN.T_world_camera[3])


def test_a_trajectory_of_poses_alone_says_nothing_of_the_camera(tmp_path):
    write_open3d(tmp_path, SEEN, as_json=True)
    path = tmp_path / "trajectory.json"
    parameters = [
        {"extrinsic": one["extrinsic"]} for one in json.loads(path.read_text())["parameters"]
    ]
    path.write_text(json.dumps({"parameters": parameters}))
    sequence = open_sequence(tmp_path)
    assert sequence.has_poses and "no camera file" in sequence.findings[0].evidence
    path.write_text("[]")
    assert "cannot be read as a" in fault_of(tmp_path)


def test_a_log_of_words_is_not_a_trajectory(tmp_path):
    write_open3d(tmp_path, SEEN)
    (tmp_path / "trajectory.log").rename(tmp_path / "z.log")
    (tmp_path / "run.log").write_text("started\n")
    (tmp_path / "config.json").write_text('{"name": 1}')
    assert open_sequence(tmp_path).has_poses


# Colour and masks of another size --------------------------------------------------------------


def test_colour_and_mask_of_twice_the_size_are_scaled(tmp_path):
    write_bundlesdf(tmp_path, SEEN)
    half = np.zeros((2 * H, 2 * W), bool)
    half[:, W:] = True
    save(tmp_path / "masks/00000.png", half)
    save(tmp_path / "rgb/00000.png", half[..., None].repeat(3, -1).astype(np.uint8) * 200)
    frame = open_sequence(tmp_path)[0]
    np.testing.assert_array_equal(frame.mask, half[::2, ::2])
    assert frame.color.shape == (H, W, 3)
    np.testing.assert_array_equal(frame.color[:, : W // 2 - 1], 0)
    np.testing.assert_array_equal(frame.color[:, W // 2 + 1 :], 200)


def test_a_mask_with_a_palette_is_what_is_not_black(tmp_path):
    write_bundlesdf(tmp_path, SEEN)
    mask = np.zeros((H, W), bool)
    mask[10:30, 10:30] = True
    for i, palette in enumerate(([0, 0, 0, 9, 9, 9], [255, 255, 255, 0, 0, 0], [7, 7, 7, 9, 9, 9])):
        image = Image.fromarray((mask ^ (i == 1)).astype(np.uint8)).convert("P")
        image.putpalette(palette)
        image.save(tmp_path / f"masks/{i:05d}.png")
    for frame in list(open_sequence(tmp_path))[:3]:
        np.testing.assert_array_equal(frame.mask, mask)


@pytest.mark.parametrize("quality", [75, 95])
def test_traces_around_the_object_in_a_jpeg_are_not_its_mask(tmp_path, quality):
    write_bundlesdf(tmp_path, SEEN)
    mask = np.zeros((H, W), bool)
    mask[13:30, 9:42] = True
    for i, shape in enumerate((mask, ~mask, mask & False)):
        (tmp_path / f"masks/{i:05d}.png").unlink()
        image = Image.fromarray(shape.astype(np.uint8) * 255)
        image.save(tmp_path / f"masks/{i:05d}.jpg", quality=quality)
        frame = open_sequence(tmp_path)[i]
        np.testing.assert_array_equal(frame.mask, shape)
        assert frame.instances is None


@pytest.mark.parametrize("hidden", [0, 255])
@pytest.mark.parametrize("mode", ["RGBA", "LA"])
def test_transparent_pixels_are_not_the_object(tmp_path, mode, hidden):
    """Programs that cut an object out leave any colour in the pixels that they hide."""
    write_bundlesdf(tmp_path, SEEN)
    mask = np.zeros((H, W), bool)
    mask[10:30, 10:30] = True
    gray = np.where(mask, 255 - hidden, hidden).astype(np.uint8)
    image = Image.merge("LA", [Image.fromarray(one) for one in (gray, mask * np.uint8(255))])
    path = tmp_path / "masks/00000.png"
    image.convert(mode).save(path)
    np.testing.assert_array_equal(open_sequence(tmp_path)[0].mask, mask)
    Image.fromarray(mask).convert("RGBA").save(path)  # opaque, so that black is around the object
    np.testing.assert_array_equal(open_sequence(tmp_path)[0].mask, mask)


def test_gray_of_16_bits_keeps_its_shades(tmp_path):
    write_bundlesdf(tmp_path, SEEN)
    gray = SEEN.color[0, ..., 0]
    save(tmp_path / "rgb/00000.png", gray.astype(np.uint16) << 8)
    np.testing.assert_array_equal(open_sequence(tmp_path)[0].color, np.dstack([gray] * 3))


def test_a_stack_of_depth_images_in_one_file_is_not_read_as_one(tmp_path):
    write_open3d(tmp_path, SEEN)
    (tmp_path / "depth/depth_1.png").unlink()
    first, *others = (Image.fromarray(raw(depth, 1000)) for depth in SEEN.depth)
    first.save(tmp_path / "depth/depth_1.tif", save_all=True, append_images=others)
    sequence = open_sequence(tmp_path)
    assert sequence[0].depth.any() and sequence[2].depth.any()
    with pytest.raises(SequenceError, match="holds several images; expected one"):
        sequence[1]


def test_colours_of_another_aspect_are_left_out_and_said(tmp_path):
    seen = SEEN._replace(color=np.zeros((6, 72, 128, 3), np.uint8))
    write_bundlesdf(tmp_path, seen)
    sequence = open_sequence(tmp_path)
    assert sequence[0].color is None
    assert "128 x 72 pixels and depth images 64 x 48" in sequence.findings[0].evidence


# Folders as people have them -------------------------------------------------------------------


def test_odd_names_and_orders(tmp_path):
    write_bundlesdf(tmp_path, SEEN)
    for i, name in enumerate(["été 2", "9", "Kopie von 10", "left 1"]):
        save(tmp_path / "depth" / f"{name}.PNG", raw(SEEN.depth[i], 1000))
    for i in range(6):
        (tmp_path / f"depth/{i:05d}.png").unlink()
    (tmp_path / "depth/Thumbs.db").write_text("no image")
    (tmp_path / "depth/.hidden.png").write_text("no image")
    sequence = open_sequence(tmp_path)
    assert set(sequence.names) == {"été 2", "9", "Kopie von 10", "left 1"}
    colors = {frame.name: frame.color is not None for frame in sequence}
    assert colors == {"été 2": True, "9": False, "Kopie von 10": False, "left 1": True}


def test_folders_may_be_in_capitals(tmp_path):
    write_open3d(tmp_path, SEEN)
    before = open_sequence(tmp_path)[2]
    for name in ("DEPTH", "Color", "Mask"):
        (tmp_path / name.lower()).rename(tmp_path / name)
    after = open_sequence(tmp_path)[2]
    np.testing.assert_array_equal(after.depth, before.depth)
    np.testing.assert_array_equal(after.color, before.color)
    np.testing.assert_array_equal(after.mask, before.mask)


def test_frames_are_counted_not_spelt(tmp_path):
    for i in (1, 2, 10, 100):
        save(tmp_path / f"depth/{i}.png", raw(SEEN.depth[0], 1000))
    assert open_sequence(tmp_path).names == ("1", "2", "10", "100")


@pytest.mark.parametrize(
    "names",
    [
        "9.9 9.933333 9.966667 10.0 10.033333 10.066667 10.1 10.133333",  # no zeros at their ends
        "9.90 9.93 9.96 10.00 10.03",
        "run1.9 run1.10 run1.11 run1.100",
        "run1.0008 run1.0009 run1.0010 run1.0011",
    ],
)
def test_times_and_numbers_after_a_point_are_in_order(tmp_path, names):
    for name in names.split():
        save(tmp_path / f"depth/{name}.png", raw(SEEN.depth[0], 1000))
    sequence = open_sequence(tmp_path)
    assert sequence.names == tuple(names.split())
    assert names.startswith("run1.9") or not gaps_of(sequence)


def test_depth_that_is_aligned_to_colour_is_preferred(tmp_path):
    write_open3d(tmp_path, SEEN)
    shutil.copytree(tmp_path / "depth", tmp_path / "aligned_depth_to_color")
    for path in (tmp_path / "depth").iterdir():
        save(path, np.full((H, W), 900, np.uint16))
    np.testing.assert_allclose(open_sequence(tmp_path)[2].depth, SEEN.depth[2], rtol=1e-6)


def test_of_a_measurement_and_its_picture_the_measurement_is_read(tmp_path):
    write_bundlesdf(tmp_path, SEEN)
    for i, depth in enumerate(SEEN.depth):
        save(tmp_path / f"depth/{i:05d}.png", raw(depth, 50).astype(np.uint8))
        np.save(tmp_path / f"depth/{i:05d}.npy", depth)
    np.testing.assert_allclose(open_sequence(tmp_path)[2].depth, SEEN.depth[2], rtol=1e-6)


def test_a_folder_that_fits_nothing_says_what_would(tmp_path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "notes.txt").write_text("")
    said = fault_of(tmp_path)
    assert "holds no recording but photos, notes.txt" in said
    assert all(name in said for name in LAYOUTS)
    (tmp_path / "empty").mkdir()
    assert "holds no recording but nothing" in fault_of(tmp_path / "empty")
    (tmp_path / "empty/depth").mkdir()
    assert "holds no depth image" in fault_of(tmp_path / "empty")
    assert "is not a folder" in fault_of(tmp_path / "nowhere")


def test_a_folder_nearby_that_fits_is_named(tmp_path):
    write_7_scenes(tmp_path / "scan/frames", SEEN)
    assert f"give {tmp_path / 'scan/frames'}, which fits" in fault_of(tmp_path / "scan")
    assert f"give {tmp_path / 'scan/frames'}, which fits" in fault_of(tmp_path)
    write_bundlesdf(tmp_path / "other", SEEN)
    assert f"give {tmp_path / 'other'}, which fits" in fault_of(tmp_path / "other/depth")


def test_a_truncated_image_in_mid_sequence_costs_its_frame_alone(tmp_path):
    write_tum(tmp_path, SEEN)
    path = sorted((tmp_path / "depth").iterdir())[3]
    for cut in (100, 0):
        path.write_bytes(path.read_bytes()[:cut])
        sequence = open_sequence(tmp_path)
        for i in (0, 1, 2, 4, 5):
            np.testing.assert_allclose(sequence[i].depth, SEEN.depth[i], rtol=1e-6)
        with pytest.raises(SequenceError, match="cannot be read as an image"):
            sequence[3]


def test_a_first_image_that_is_damaged_does_not_hide_the_others(tmp_path):
    write_redwood(tmp_path, SEEN)
    for kind in ("depth", "rgb"):
        sorted((tmp_path / kind).iterdir())[0].write_bytes(b"")
    assert open_sequence(tmp_path)[1].depth.any()


@pytest.mark.parametrize("kind", ["depth", "color"])
def test_a_first_image_of_another_size_costs_its_frame_alone(tmp_path, kind):
    write_open3d(tmp_path, SEEN)
    small = Image.open(tmp_path / kind / f"{kind}_0.png").resize((W // 4, H // 2))
    small.save(tmp_path / kind / f"{kind}_0.png")
    sequence = open_sequence(tmp_path)
    assert sequence.shape == (H, W) and not sequence.findings
    with pytest.raises(SequenceError, match=f"{kind}_0.png is 16 x 24 pixels; expected 64 x 48"):
        sequence[0]
    assert sequence[1].color is not None


def test_ten_thousand_frames_open_at_once_and_unread(tmp_path, monkeypatch):
    (tmp_path / "depth").mkdir()
    (tmp_path / "rgb").mkdir()
    Image.fromarray(raw(SEEN.depth[0], 1000)).save(tmp_path / "one.png")
    for i in range(10_000):
        for kind in ("depth", "rgb"):
            (tmp_path / f"{kind}/{i + 1:07d}-{i * 33333:012d}.png").hardlink_to(
                tmp_path / "one.png"
            )
    decoded, load = [], ImageFile.ImageFile.load
    monkeypatch.setattr(
        ImageFile.ImageFile, "load", lambda image: (decoded.append(image), load(image))[1]
    )
    start = time.process_time()
    sequence = open_sequence(tmp_path)
    seconds = time.process_time() - start
    assert len(sequence) == 10_000 and sequence.layout == "redwood" and not decoded
    assert seconds < 3
    assert sequence[9_876].color is not None and len(decoded) == 2


@pytest.mark.parametrize(
    "damage, said",
    [
        (lambda f: (f / "depth.txt").write_text("1.0 a.png\n2.0\n"), "line 2 has no file: '2.0'"),
        (lambda f: (f / "depth.txt").write_text("# none\n"), "lists no image"),
        (lambda f: (f / "depth.txt").write_text("1.0 gone.png\n"), "cannot be read as an image"),
        (lambda f: (f / "groundtruth.txt").write_text("1 2 3\n"), "cannot be read as a traj"),
        (lambda f: (f / "groundtruth.txt").write_text("1 0 0 0 0 0 0 2\n"), "quaternion of len"),
        (lambda f: (f / "calibration.txt").write_text("500 500\n"), "cannot be read as a camera"),
    ],
)
def test_damaged_lists(tmp_path, damage, said):
    write_tum(tmp_path, SEEN)
    damage(tmp_path)
    assert said in fault_of(tmp_path)


@pytest.mark.parametrize(
    "camera, said",
    [
        ('{"width": 64, "height": 64, "intrinsic_matrix": [1,0,0,0,1,0,32,24,1]}', "of 64 x 64"),
        ('{"width": 64, "height": 48, "intrinsic_matrix": [1,0,0]}', "cannot be read as a camera"),
        ('{"width": 64, "height": 48, "intrinsic_matrix": [0,0,0,0,1,0,32,24,1]}', "focal lengths"),
        ("{", "cannot be read as a camera"),
    ],
)
def test_damaged_cameras(tmp_path, camera, said):
    write_open3d(tmp_path, SEEN)
    (tmp_path / "camera_primesense.json").write_text(camera)
    assert said in fault_of(tmp_path)


def test_one_camera_of_several_is_used_and_the_others_are_named(tmp_path):
    write_open3d(tmp_path, SEEN)
    path = tmp_path / "camera_primesense.json"
    about = json.loads(path.read_text())
    path.rename(tmp_path / "depth_intrinsic.json")
    about["intrinsic_matrix"][0] *= 1.3
    (tmp_path / "color_intrinsic.json").write_text(json.dumps(about))
    (tmp_path / "camera.json").write_text('{"width": 9, "height": 9, "intrinsic_matrix": [1]}')
    sequence = open_sequence(tmp_path)
    np.testing.assert_allclose(sequence.intrinsics, K)
    said = "color_intrinsic.json gives other intrinsics than depth_intrinsic.json, which are used"
    assert [remark.evidence for remark in sequence.findings] == [said]
    np.savetxt(tmp_path / "cam_K.txt", K)
    assert open_sequence(tmp_path).camera == "cam_K.txt"


def test_a_camera_that_is_guessed_is_a_finding_and_must_have_the_aspect(tmp_path):
    write_open3d(tmp_path, SEEN)
    (tmp_path / "camera_primesense.json").unlink()
    sequence = open_sequence(tmp_path)
    assert "no camera file" in sequence.findings[0].evidence
    np.testing.assert_allclose(sequence.intrinsics[0], [52.5, 0, 32])
    for path in (tmp_path / "depth").iterdir():
        save(path, np.full((36, 64), 2000, np.uint16))
    assert "makes images of 640 x 480, not of 64 x 36" in fault_of(tmp_path)
