"""What phones, datasets and renderers write is read as it was seen, with their own conventions."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from device_recordings import (
    OWN_CAMERAS,
    TO_OPENGL,
    WRITERS,
    save_float_tiff,
    shoot,
    write_bop,
    write_nerfstudio,
    write_npz,
    write_realsense,
    write_record3d,
    write_replica,
    write_scannet,
    write_stray_scanner,
    write_wild_rgbd,
)
from recordings import OPENCV, H, W, raw, save

from jaxshape.data.sequences import LAYOUTS, SequenceError, open_sequence
from jaxshape.data.sequences.evidence import agreement, seen_by, telling_pairs
from jaxshape.data.sequences.rasters import depth_channel

SEEN = shoot()


def fault_of(folder):
    with pytest.raises(SequenceError) as caught:
        list(open_sequence(folder))
    sentence = str(caught.value)
    assert "\n" not in sentence and sentence.endswith(".")
    return sentence


def share_seen_again(a, b):
    """Pixels of one frame that a second one sees at the same place, moved by their poses."""
    v, u = np.mgrid[:H, :W] + 0.5
    pixels = np.stack([u, v, np.ones((H, W))], -1).reshape(-1, 3)
    p_a = pixels @ np.linalg.inv(a.intrinsics).T * a.depth.reshape(-1, 1)
    T_b_a = np.linalg.inv(b.T_world_camera) @ a.T_world_camera
    p_b = p_a[a.depth.ravel() > 0] @ T_b_a[:3, :3].T + T_b_a[:3, 3]
    u, v, z = (p_b @ b.intrinsics.T).T
    column, row = np.floor(u / z).astype(int), np.floor(v / z).astype(int)
    inside = (z > 0) & (column >= 0) & (column < W) & (row >= 0) & (row < H)
    there = b.depth[row[inside], column[inside]]
    known = there > 0
    return np.mean(np.abs(there - z[inside])[known] < 0.02)


# All of them -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", WRITERS)
def test_frames_are_read_as_they_were_seen(tmp_path, name):
    WRITERS[name](tmp_path, SEEN)
    sequence = open_sequence(tmp_path)
    assert sequence.layout == name and len(sequence) == len(SEEN.depth) and sequence.has_poses
    unit = 1 / 6553.5 if name == "replica" else 1e-6
    for i, frame in enumerate(sequence):
        measured = SEEN.mask[i] if name == "stray-scanner" else np.ones((H, W), bool)
        np.testing.assert_allclose(frame.depth[measured], SEEN.depth[i][measured], atol=unit)
        assert (frame.depth[~measured] == 0).all()
        np.testing.assert_allclose(frame.T_world_camera, SEEN.T_world_camera[i], atol=1e-6)
        np.testing.assert_allclose(frame.intrinsics, SEEN.K[i], atol=1e-6)
        if name == "stray-scanner":  # its images are scaled down from those of the film
            assert np.corrcoef(frame.color.ravel(), SEEN.color[i].ravel())[0, 1] > 0.8
        else:
            np.testing.assert_array_equal(frame.color, SEEN.color[i])
        if frame.mask is not None:
            np.testing.assert_array_equal(frame.mask, SEEN.mask[i])


@pytest.mark.parametrize("name", OWN_CAMERAS)
def test_each_frame_has_the_camera_it_was_taken_with(tmp_path, name):
    seen = shoot(zoom=0.08)
    WRITERS[name](tmp_path, seen)
    frames = list(open_sequence(tmp_path))
    for frame, K in zip(frames, seen.K, strict=True):
        np.testing.assert_allclose(frame.intrinsics, K, atol=1e-6)
    assert share_seen_again(frames[0], frames[4]) > 0.9
    alike = frames[4]._replace(intrinsics=frames[0].intrinsics)
    assert share_seen_again(frames[0], alike) < 0.5


def test_poses_agree_with_depth_by_the_camera_of_each_frame(tmp_path):
    """The focal length doubles within the film."""
    WRITERS["npz"](tmp_path, shoot(9, zoom=0.12))
    sequence = open_sequence(tmp_path)
    assert agreement(seen_by(telling_pairs(sequence))) > 0.9
    alike = replace(sequence, cameras=None)
    assert agreement(seen_by(telling_pairs(alike))) < 0.75


@pytest.mark.parametrize("name", WRITERS)
def test_poses_bring_one_frame_onto_another(tmp_path, name):
    WRITERS[name](tmp_path, SEEN)
    a, b = (open_sequence(tmp_path)[i] for i in (0, 4))
    assert share_seen_again(a, b) > 0.85  # the rest is hidden by the sphere
    for wrong in (np.linalg.inv, lambda T: T @ TO_OPENGL):
        turned = [one._replace(T_world_camera=wrong(one.T_world_camera)) for one in (a, b)]
        assert share_seen_again(*turned) < 0.7


@pytest.mark.parametrize(
    "name, file",
    [
        ("bop", "scene_camera.json"),
        ("wildrgb-d", "cam_poses.txt"),
        ("wildrgb-d", "metadata"),
        ("stray-scanner", "odometry.csv"),
        ("stray-scanner", "camera_matrix.csv"),
        ("nerfstudio", "transforms.json"),
        ("replica", "cam_params.json"),
        ("scannet", "intrinsic/intrinsic_depth.txt"),
        ("npz", "scan.npz"),
    ],
)
@pytest.mark.parametrize("content", [b"", b"[1, 2]", b'{"frames": 3}', b"\xff\x00\xfe", b"1 x 3\n"])
def test_damaged_files_end_in_one_sentence(tmp_path, name, file, content):
    if name == "stray-scanner":
        write_stray_scanner(tmp_path, SEEN, own_cameras=False, unpacked=False)
    else:
        WRITERS[name](tmp_path, SEEN)
    (tmp_path / file).write_bytes(content)
    assert fault_of(tmp_path)


@pytest.mark.parametrize("name", LAYOUTS)
def test_an_empty_folder_is_of_no_layout_that_is_asked_for(tmp_path, name):
    with pytest.raises(SequenceError, match=r"\.$"):
        open_sequence(tmp_path, layout=name)


@pytest.mark.parametrize(
    "name, folder",
    [("scannet", "color"), ("bop", "rgb"), ("wildrgb-d", "rgb"), ("record3d", "rgb")],
)
def test_colours_that_are_counted_from_another_number_are_named(tmp_path, name, folder):
    WRITERS[name](tmp_path, SEEN)
    before = open_sequence(tmp_path).findings
    for path in sorted((tmp_path / folder).iterdir(), reverse=True):
        path.rename(path.with_stem(str(int(path.stem) + 1).zfill(len(path.stem))))
    (remark,) = set(open_sequence(tmp_path).findings) - set(before)
    assert "1 of 5 depth images have no colour image, although" in remark.evidence
    assert "there are 5" in remark.evidence and "a frame late" in remark.advice


@pytest.mark.parametrize("layout", ["scannet", "open3d"])
def test_poses_that_are_counted_from_another_number_are_named(tmp_path, layout):
    write_scannet(tmp_path, SEEN)
    assert not open_sequence(tmp_path).findings
    for path in sorted((tmp_path / "pose").iterdir(), reverse=True):
        path.rename(path.with_stem(str(int(path.stem) + 1)))
    remark = open_sequence(tmp_path, layout=layout).findings[0]
    assert "1 of 5 depth images have no pose of their number, although" in remark.evidence


@pytest.mark.parametrize("name", ["record3d", "wildrgb-d", "stray-scanner", "icl-nuim"])
def test_poses_of_one_file_that_are_counted_from_another_number_are_named(tmp_path, name):
    WRITERS[name](tmp_path, SEEN)
    before = open_sequence(tmp_path).findings
    for folder in {"depth", "rgb", "masks", "confidence"} & {
        one.name for one in tmp_path.iterdir()
    }:
        paths = sorted((tmp_path / folder).iterdir(), reverse=True)
        for path in paths:
            path.rename(path.with_stem(str(int(path.stem) + 1).zfill(len(path.stem))))
    (remark,) = set(open_sequence(tmp_path).findings) - set(before)
    assert "1 of 5 depth images have no pose of their number, although" in remark.evidence


@pytest.mark.parametrize(
    "start, fault",
    [("nan 0 0 0 0 0 0 1", None), ("inf 0 0 0 0 0 0 1", None), ("0 0 0 0 5 5 5 5", "length 1")],
)
def test_poses_of_icl_nuim_without_a_number_or_a_rotation(tmp_path, start, fault):
    WRITERS["icl-nuim"](tmp_path, SEEN)
    (path,) = tmp_path.glob("*.gt.freiburg")
    path.write_text("\n".join([start, *path.read_text().splitlines()[1:]]))
    sequence = open_sequence(tmp_path)
    np.testing.assert_allclose(sequence[1].T_world_camera, SEEN.T_world_camera[1], atol=1e-6)
    if fault is None:
        assert sequence[0].T_world_camera is None
    else:
        with pytest.raises(SequenceError, match=fault):
            sequence[0]


# ScanNet, WildRGB-D, Replica -------------------------------------------------------------------


def test_a_pose_of_infinity_is_none(tmp_path):
    write_scannet(tmp_path, SEEN)
    np.savetxt(tmp_path / "pose/2.txt", np.full((4, 4), -np.inf))
    poses = [frame.T_world_camera is None for frame in open_sequence(tmp_path)]
    assert poses == [False, False, True, False, False]


def test_wild_rgbd_poses_are_found_by_the_number_of_the_image(tmp_path):
    write_wild_rgbd(tmp_path, SEEN)
    lines = (tmp_path / "cam_poses.txt").read_text().splitlines()
    (tmp_path / "cam_poses.txt").write_text("\n".join(lines[:1:-1]))  # the last three, backwards
    sequence = open_sequence(tmp_path)
    assert sequence[1].T_world_camera is None
    np.testing.assert_allclose(sequence[3].T_world_camera, SEEN.T_world_camera[3], atol=1e-9)


def test_poses_of_replica_stay_with_their_images_when_some_are_removed(tmp_path):
    write_replica(tmp_path, SEEN)
    for number in (0, 2):
        (tmp_path / f"results/depth{number:06d}.png").unlink()
    for frame, T in zip(open_sequence(tmp_path), SEEN.T_world_camera[[1, 3, 4]], strict=True):
        np.testing.assert_allclose(frame.T_world_camera, T, atol=1e-9)


def test_matrices_of_replica_may_have_a_header_and_commas(tmp_path):
    write_replica(tmp_path, SEEN)
    path = tmp_path / "traj.txt"
    path.write_text("# camera to world\n\n" + path.read_text().replace(" ", ", "))
    np.testing.assert_allclose(open_sequence(tmp_path)[4].T_world_camera, SEEN.T_world_camera[4])


def test_replica_of_semantic_nerf_is_in_millimetres(tmp_path):
    for i, depth in enumerate(SEEN.depth):
        save(tmp_path / f"depth/depth_{i}.png", raw(depth, 1000))
    np.savetxt(tmp_path / "traj_w_c.txt", SEEN.T_world_camera.reshape(-1, 16))
    np.savetxt(tmp_path / "cam_K.txt", OPENCV)
    sequence = open_sequence(tmp_path)
    assert sequence.layout == "replica"
    np.testing.assert_allclose(sequence[3].depth, SEEN.depth[3], rtol=1e-6)


def test_a_trajectory_of_tum_called_traj_is_not_replica(tmp_path):
    write_replica(tmp_path, SEEN)
    (tmp_path / "results").rename(tmp_path / "depth")
    assert open_sequence(tmp_path).layout == "replica"
    (tmp_path / "traj.txt").write_text("0 0 0 0 0 0 0 1\n")
    np.savetxt(tmp_path / "cam_K.txt", OPENCV)
    assert open_sequence(tmp_path).layout == "bundlesdf"


# BOP -------------------------------------------------------------------------------------------


def test_without_a_world_the_object_of_most_images_is_the_world(tmp_path):
    T_world_object = np.eye(4)
    T_world_object[:3, 3] = 0.2, -0.1, 2.0
    write_bop(tmp_path, SEEN, w2c=False, T_world_object=T_world_object)
    sequence = open_sequence(tmp_path)
    assert "object 4" in sequence.findings[0].evidence
    T = np.linalg.inv(T_world_object) @ SEEN.T_world_camera[3]
    np.testing.assert_allclose(sequence[3].T_world_camera, T, atol=1e-9)
    np.testing.assert_array_equal(sequence[3].mask, SEEN.mask[3])


def test_depth_images_that_the_scene_does_not_name_are_left_out_and_counted(tmp_path):
    write_bop(tmp_path, SEEN)
    about = json.loads((tmp_path / "scene_camera.json").read_text())
    (tmp_path / "scene_camera.json").write_text(json.dumps({k: about[k] for k in "135"}))
    sequence = open_sequence(tmp_path)
    assert len(sequence) == 3
    assert sequence.findings[1].evidence == "2 depth images are not in scene_camera.json"


def test_keys_of_a_scene_may_have_zeros_in_front(tmp_path):
    write_bop(tmp_path, SEEN)
    expected = list(open_sequence(tmp_path))
    for name in ("scene_camera.json", "scene_gt.json"):
        content = json.loads((tmp_path / name).read_text())
        padded = {f"{int(key):06d}": value for key, value in content.items()}
        (tmp_path / name).write_text(json.dumps(padded))
    sequence = open_sequence(tmp_path)
    assert len(sequence) == len(expected)
    for frame, known in zip(sequence, expected, strict=True):
        np.testing.assert_array_equal(frame.T_world_camera, known.T_world_camera)
        np.testing.assert_array_equal(frame.mask, known.mask)


def test_depth_is_in_the_unit_of_the_scene(tmp_path):
    write_bop(tmp_path, SEEN, unit=1.0)
    assert open_sequence(tmp_path).depth_scale == 1000
    about = json.loads((tmp_path / "scene_camera.json").read_text())
    about["3"]["depth_scale"] = 0.5
    (tmp_path / "scene_camera.json").write_text(json.dumps(about))
    assert "[0.5, 1.0]" in fault_of(tmp_path)


def test_times_of_arrays_that_do_not_rise_are_not_used_and_named(tmp_path):
    write_npz(tmp_path, SEEN)
    with np.load(tmp_path / "scan.npz") as file:
        arrays = dict(file)
    for times, remarks in (([0.0, 1, 2, 3, 4], 0), ([0.0, 1, 1, 2, 3], 1)):
        np.savez(tmp_path / "scan.npz", times=np.array(times), **arrays)
        sequence = open_sequence(tmp_path)
        assert (sequence.times is None) == bool(remarks)
        assert [one.evidence[:21] for one in sequence.findings] == [
            "the times do not rise"
        ] * remarks


# Stray Scanner and Record3D --------------------------------------------------------------------


def test_tables_of_rows_of_other_lengths_are_refused(tmp_path):
    write_stray_scanner(tmp_path, SEEN)
    path = tmp_path / "odometry.csv"
    first, *rows = path.read_text().splitlines()
    path.write_text("\n".join([first, *rows[:2], rows[2] + ", 7", *rows[3:]]))
    assert "a row has more cells than the first line" in fault_of(tmp_path)
    path.write_text("\n".join([first + ", more" * 100, *(row + ", 7" * 100 for row in rows)]))
    np.testing.assert_allclose(
        open_sequence(tmp_path)[2].T_world_camera, SEEN.T_world_camera[2], atol=1e-6
    )


def test_missing_confidence_maps_are_counted(tmp_path):
    write_stray_scanner(tmp_path, SEEN)
    assert not open_sequence(tmp_path).findings
    (tmp_path / "confidence/000002.png").unlink()
    sequence = open_sequence(tmp_path)
    (finding,) = sequence.findings
    assert "1 of 5 depth images have no confidence map" in finding.evidence
    np.testing.assert_allclose(sequence[2].depth, SEEN.depth[2], rtol=1e-6)
    shutil.rmtree(tmp_path / "confidence")  # as older recordings
    assert not open_sequence(tmp_path).findings


def test_a_film_is_named_and_the_camera_is_of_its_size(tmp_path):
    write_stray_scanner(tmp_path, SEEN, own_cameras=False, unpacked=False)
    sequence = open_sequence(tmp_path)
    assert "rgb.mp4" in sequence.findings[0].evidence and "ffmpeg" in sequence.findings[0].advice
    np.testing.assert_allclose(sequence.intrinsics, SEEN.K[0])
    assert sequence.camera == "camera_matrix.csv" and sequence.cameras is None
    np.testing.assert_allclose(sequence.times, 5e4 + np.arange(5) / 60)


def test_packed_record3d_files_are_refused_by_name(tmp_path):
    (tmp_path / "scan.r3d").write_bytes(b"PK")
    assert "LZFSE" in fault_of(tmp_path / "scan.r3d")


def test_record3d_metadata_are_checked(tmp_path):
    write_record3d(tmp_path, SEEN)
    path = tmp_path / "metadata.json"
    about = json.loads(path.read_text())
    for change in ({"poses": [1, 2]}, {"w": None}, {"K": "x", "perFrameIntrinsicCoeffs": []}):
        path.write_text(json.dumps(about | change))
        assert "metadata.json gives no usable" in fault_of(tmp_path)


def test_record3d_without_cameras_of_its_frames_has_one(tmp_path):
    write_record3d(tmp_path, SEEN)
    about = json.loads((tmp_path / "metadata.json").read_text())
    del about["perFrameIntrinsicCoeffs"]
    (tmp_path / "metadata.json").write_text(json.dumps(about))
    sequence = open_sequence(tmp_path)
    assert sequence.cameras is None
    np.testing.assert_allclose(sequence[3].intrinsics, SEEN.K[0])


# nerfstudio ------------------------------------------------------------------------------------


def edit(folder, **entries):
    path = folder / "transforms.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | entries))


def test_a_scale_that_was_applied_to_the_poses_is_taken_back(tmp_path):
    write_nerfstudio(tmp_path, SEEN, applied_scale=0.25)
    T = open_sequence(tmp_path)[4].T_world_camera
    np.testing.assert_allclose(T, SEEN.T_world_camera[4], atol=1e-9)


def test_an_angle_of_view_and_images_without_suffix(tmp_path):
    write_nerfstudio(tmp_path, SEEN)
    about = json.loads((tmp_path / "transforms.json").read_text())
    for frame in about["frames"]:
        frame["file_path"] = frame["file_path"].removesuffix(".png")
        for name in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
            del frame[name]
    path = tmp_path / "images/frame_00003.png"
    path.rename(path.with_suffix(".tiff"))
    angle = 2 * np.arctan(W / 2 / SEEN.K[0, 0, 0])
    edit(tmp_path, frames=about["frames"], camera_angle_x=float(angle))
    frame = open_sequence(tmp_path)[2]
    np.testing.assert_allclose(frame.intrinsics, SEEN.K[0])
    np.testing.assert_array_equal(frame.color, SEEN.color[2])


def test_instant_ngp_has_its_own_names_of_depth_and_its_unit(tmp_path):
    write_nerfstudio(tmp_path, SEEN)
    about = json.loads((tmp_path / "transforms.json").read_text())
    for frame in about["frames"]:
        frame["depth_path"] = frame.pop("depth_file_path").replace("depth", "deep")
    (tmp_path / "depth").rename(tmp_path / "deep")
    for i, depth in enumerate(SEEN.depth):
        save(tmp_path / f"deep/frame_{i + 1:05d}.png", raw(depth, 4000))
    edit(tmp_path, frames=about["frames"], integer_depth_scale=1 / 4000)
    np.testing.assert_allclose(open_sequence(tmp_path)[2].depth, SEEN.depth[2], rtol=1e-6)


@pytest.mark.parametrize(
    "name", ["../secret.png", "..\\secret.png", "/etc/hostname", "depth/link.png", 7]
)
def test_files_outside_of_the_recording_are_not_opened(tmp_path, name):
    folder = tmp_path / "recording"
    folder.mkdir()
    write_nerfstudio(folder, SEEN)
    save(tmp_path / "secret.png", raw(SEEN.depth[0], 1000))
    (folder / "depth/link.png").symlink_to(tmp_path / "secret.png")
    about = json.loads((folder / "transforms.json").read_text())
    about["frames"][0]["depth_file_path"] = name
    edit(folder, frames=about["frames"])
    assert repr(name) in fault_of(folder)


def test_lenses_and_missing_depth_are_remarked(tmp_path):
    write_nerfstudio(tmp_path, SEEN)
    about = json.loads((tmp_path / "transforms.json").read_text())
    del about["frames"][0]["depth_file_path"]
    edit(tmp_path, frames=about["frames"], k1=-0.2)
    sequence = open_sequence(tmp_path)
    assert len(sequence) == 4
    left, bent = (finding.evidence for finding in sequence.findings)
    assert left.startswith("1 frames have no depth") and "-0.2" in bent


def test_a_depth_image_that_is_named_twice_is_read_once(tmp_path):
    write_nerfstudio(tmp_path, SEEN)
    frames = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    edit(tmp_path, frames=[one for frame in frames for one in (frame, frame)])
    sequence = open_sequence(tmp_path)
    assert len(set(sequence.names)) == len(sequence) == len(frames)
    (remark,) = sequence.findings
    assert "5 frames name the depth image of an earlier frame" in remark.evidence
    np.testing.assert_allclose(sequence[3].T_world_camera, SEEN.T_world_camera[3], atol=1e-6)


def test_colours_that_are_named_and_missing_are_counted(tmp_path):
    write_nerfstudio(tmp_path, SEEN)
    shutil.rmtree(tmp_path / "images")
    (remark,) = open_sequence(tmp_path).findings
    assert "5 colour images that transforms.json names do not exist" in remark.evidence


@pytest.mark.parametrize(
    "lens",
    [{"is_fisheye": True}, {"camera_model": "EQUIRECTANGULAR"}, {"distortion_params": [0.3]}],
)
@pytest.mark.parametrize("frame", [None, 2])
def test_cameras_that_are_no_pinholes_are_remarked(tmp_path, lens, frame):
    write_nerfstudio(tmp_path, SEEN)
    about = json.loads((tmp_path / "transforms.json").read_text())
    (about if frame is None else about["frames"][frame]).update(lens)
    (tmp_path / "transforms.json").write_text(json.dumps(about))
    (remark,) = open_sequence(tmp_path).findings
    assert any(word in remark.evidence for word in ("fisheye", "EQUIRECTANGULAR", "0.3, which"))


# Arrays and floats -----------------------------------------------------------------------------


def test_an_npz_file_can_be_given_itself(tmp_path):
    write_npz(tmp_path, SEEN)
    (tmp_path / "notes.txt").write_text("")
    assert open_sequence(tmp_path / "scan.npz").layout == "npz"
    assert "holds no recording" in fault_of(tmp_path)


def test_the_camera_of_arrays_may_lie_beside_them(tmp_path):
    np.savez(tmp_path / "scan.npz", depth=SEEN.depth)
    assert f"expected the 3x3 camera matrix in {tmp_path}" in fault_of(tmp_path / "scan.npz")
    np.savetxt(tmp_path / "cam_K.txt", OPENCV)
    np.testing.assert_allclose(open_sequence(tmp_path / "scan.npz").intrinsics, SEEN.K[0])


def test_arrays_that_may_be_poses_are_named(tmp_path):
    path = tmp_path / "scan.npz"
    np.savez(path, depth=SEEN.depth, K=OPENCV, extrinsics=SEEN.T_world_camera, gain=1)
    (remark,) = open_sequence(path).findings
    assert "scan.npz holds extrinsics, which are not read" in remark.evidence


def test_a_lens_and_a_depth_scale_beside_arrays_are_named(tmp_path):
    arrays = {"depth": SEEN.depth, "K": SEEN.opencv, "poses": SEEN.T_world_camera}
    np.savez(tmp_path / "scan.npz", **arrays, dist_coeffs=np.ones(5), depth_scale=1000.0)
    (remark,) = open_sequence(tmp_path).findings
    assert "holds depth_scale, dist_coeffs, which are not read" in remark.evidence


def test_arrays_that_do_not_fit_are_named(tmp_path):
    path = tmp_path / "scan.npz"
    for arrays, word in (
        ({"K": OPENCV}, "depth"),
        ({"depth": SEEN.depth, "K": OPENCV[:2]}, "(2, 3)"),
        ({"depth": SEEN.depth, "K": OPENCV, "poses": np.eye(4)}, "poses"),
        ({"depth": SEEN.depth, "K": OPENCV, "color": SEEN.color[:2]}, "color"),
        ({"depth": np.array([{}], object), "K": OPENCV}, "pickle"),
    ):
        np.savez(path, **arrays)
        assert word in fault_of(path)


@pytest.mark.parametrize("folder", ["depth", "depths", "Depth", "aligned_depth_to_color"])
@pytest.mark.parametrize("suffix", [".tif", ".npy"])
def test_floats_are_metres_in_folders_of_any_usual_name(tmp_path, folder, suffix):
    (tmp_path / folder).mkdir()
    for i, depth in enumerate(SEEN.depth):
        depth = depth.copy()
        depth[:2, :3] = np.nan, 0, np.inf
        if suffix == ".npy":
            np.save(tmp_path / folder / f"{i}.npy", depth)
        else:
            save_float_tiff(tmp_path / folder / f"{i}.tif", depth)
    np.savetxt(tmp_path / "cam_K.txt", OPENCV)
    frame = open_sequence(tmp_path)[3]
    assert (frame.depth[:2, :3] == 0).all()
    np.testing.assert_allclose(frame.depth[2:], SEEN.depth[3][2:], rtol=1e-6)


@pytest.mark.parametrize("kind", ["<u2", ">u2", "<i2", "<i4", "<u4", "<i8", "<u8"])
def test_whole_numbers_of_any_kind_are_millimetres(tmp_path, kind):
    (tmp_path / "depth").mkdir()
    np.savetxt(tmp_path / "cam_K.txt", OPENCV)
    np.save(tmp_path / "depth/0.npy", raw(SEEN.depth[0], 1000).astype(kind))
    np.testing.assert_allclose(open_sequence(tmp_path)[0].depth, SEEN.depth[0], rtol=1e-6)


@pytest.mark.parametrize("most", [4095, 10_000, 65_535])
@pytest.mark.parametrize("kind", [b"P2", b"P5"])
def test_a_pgm_file_holds_numbers_whatever_the_largest_may_be(tmp_path, kind, most):
    (tmp_path / "depth").mkdir()
    np.savetxt(tmp_path / "cam_K.txt", OPENCV)
    deep = raw(SEEN.depth[0], 1000)
    plain = " ".join(map(str, deep.ravel())).encode()
    body = deep.astype(">u2").tobytes() if kind == b"P5" else plain
    (tmp_path / "depth/0.pgm").write_bytes(b"%s\n%d %d\n%d\n" % (kind, W, H, most) + body)
    np.testing.assert_allclose(open_sequence(tmp_path)[0].depth, SEEN.depth[0], rtol=1e-6)


@pytest.mark.parametrize("array", [np.zeros(5), np.zeros((2, 3, 4, 5)), np.array([["a"]])])
def test_arrays_that_are_no_images_are_refused(tmp_path, array):
    (tmp_path / "depth").mkdir()
    np.save(tmp_path / "depth/0.npy", array)
    np.savetxt(tmp_path / "cam_K.txt", OPENCV)
    assert "cannot be read as an image" in fault_of(tmp_path)


def test_exr_is_read_or_refused_by_name(tmp_path):
    (tmp_path / "depth").mkdir()
    np.savetxt(tmp_path / "cam_K.txt", OPENCV)
    path = tmp_path / "depth/0.exr"
    try:
        import OpenEXR
    except ImportError:
        path.write_bytes(b"\x76\x2f\x31\x01")
        assert "jaxshape[exr]" in fault_of(tmp_path)
        return
    depth = SEEN.depth[0].astype(np.float32)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"Y": depth}).write(str(path))
    np.testing.assert_array_equal(open_sequence(tmp_path)[0].depth, depth)


@pytest.mark.parametrize(
    "names, chosen",
    [
        ("A B G R Z", "Z"),
        ("B G R", "R"),
        ("V", "V"),
        ("B G R depth.V", "depth.V"),
        ("ViewLayer.Combined.A ViewLayer.Combined.R ViewLayer.Depth.Z", "ViewLayer.Depth.Z"),
        ("View.Combined.R View.Depth.Z View.Normal.X View.Normal.Z", "View.Depth.Z"),
        ("Image.B Image.G Image.R", "Image.R"),
        ("distance", "distance"),
    ],
)
def test_depth_is_never_another_channel_of_exr(names, chosen):
    assert depth_channel(names.split()) == chosen


def test_channels_without_depth_are_refused_by_name():
    for names in (["A", "U"], ["a.Z", "b.Z"], []):
        with pytest.raises(ValueError, match="none of its channels"):
            depth_channel(names)


# RealSense -------------------------------------------------------------------------------------


def test_raw_depth_of_a_realsense_is_read_with_its_colours_and_times(tmp_path):
    write_realsense(tmp_path, SEEN)
    sequence = open_sequence(tmp_path)
    assert sequence.layout == "realsense" and not sequence.has_poses
    np.testing.assert_allclose(np.diff(sequence.times), 0.033333, atol=1e-6)
    np.testing.assert_allclose(sequence.color_delays, 0.004, atol=1e-6)
    for frame, depth, color in zip(sequence, SEEN.depth, SEEN.color, strict=True):
        np.testing.assert_allclose(frame.depth, depth, atol=1e-6)
        np.testing.assert_array_equal(frame.color, color)
        np.testing.assert_allclose(frame.intrinsics, SEEN.K[0], atol=1e-6)


def test_the_size_of_raw_depth_without_colour_is_one_of_the_camera(tmp_path):
    deep = (np.arange(240 * 424) % 5000).astype("<u2").reshape(240, 424)
    deep.tofile(tmp_path / "a_Depth_10.raw")
    np.savetxt(tmp_path / "cam_K.txt", [[300, 0, 212], [0, 300, 120], [0, 0, 1]])
    (frame,) = open_sequence(tmp_path)
    np.testing.assert_allclose(frame.depth, deep / 1000, rtol=1e-6)


def test_raw_depth_of_another_length_costs_its_frame_alone(tmp_path):
    write_realsense(tmp_path, SEEN)
    first, second, *_ = sorted(tmp_path.glob("*_Depth_*.raw"))
    first.write_bytes(b"")
    second.write_bytes(2 * second.read_bytes())
    sequence = open_sequence(tmp_path)
    for index in (0, 1):
        with pytest.raises(SequenceError, match="cannot be read as an image"):
            sequence.read_depth(index)
    np.testing.assert_allclose(sequence.read_depth(2), SEEN.depth[2], atol=1e-6)


@pytest.mark.parametrize("name, folder", [("stray-scanner", "rgb"), ("nerfstudio", "images")])
def test_a_first_colour_that_is_damaged_costs_its_frame_alone(tmp_path, name, folder):
    WRITERS[name](tmp_path, SEEN)
    if name == "nerfstudio":
        about = json.loads((tmp_path / "transforms.json").read_text())
        edit(tmp_path, frames=[one | {"w": None, "h": None} for one in about["frames"]])
        for path in (tmp_path / folder).iterdir():  # the camera is that of larger images
            save(path, np.zeros((2 * H, 2 * W, 3), np.uint8))
    before = open_sequence(tmp_path)
    sorted((tmp_path / folder).iterdir())[0].write_bytes(b"")
    after = open_sequence(tmp_path)
    np.testing.assert_array_equal(after[1].intrinsics, before[1].intrinsics)
    np.testing.assert_array_equal(after[1].color, before[1].color)


def test_depth_images_without_their_folder_are_not_taken_for_painted_ones(tmp_path):
    write_scannet(tmp_path / "scan", SEEN)
    for path in (tmp_path / "scan/depth").iterdir():
        path.rename(path.with_stem(f"depth_{path.stem}"))
    assert f"give {tmp_path / 'scan'}, which fits" in fault_of(tmp_path / "scan/depth")


def test_raw_depth_that_cannot_be_read_ends_in_one_sentence(tmp_path):
    (tmp_path / "a_Depth_10.png").write_bytes(b"")
    assert "rs-convert -r" in fault_of(tmp_path)
    (tmp_path / "a_Depth_10.raw").write_bytes(bytes(1234))
    assert "1,234 bytes" in fault_of(tmp_path)
    np.savetxt(tmp_path / "cam_K.txt", [[300, 0, 212], [0, 300, 120], [0, 0, 1]])
    (tmp_path / "a_Depth_10.raw").write_bytes(bytes(240 * 424 * 2))
    (tmp_path / "a_Depth_20.raw").write_bytes(bytes(7))
    assert "a_Depth_20.raw" in fault_of(tmp_path)
