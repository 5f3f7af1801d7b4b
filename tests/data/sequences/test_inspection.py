"""Each fault of a recording is noticed, with its evidence; a good recording is not accused."""

import re

import numpy as np
import pytest
from PIL import ExifTags, Image
from recordings import (
    WRITERS,
    H,
    K,
    W,
    record,
    save,
    write_7_scenes,
    write_open3d,
    write_redwood,
    write_tum,
)
from scipy.spatial.transform import Rotation

from jaxshape.data.sequences import SequenceError, open_sequence
from jaxshape.data.sequences.figures import Gap
from jaxshape.data.sequences.inspection import inspect_sequence

SEEN = record(12)


def inspect(folder, **settings):
    return inspect_sequence(open_sequence(folder, **settings))


def warnings_of(folder, **settings):
    return [" ".join(warning) for warning in inspect(folder, **settings).warnings]


@pytest.mark.parametrize("name", WRITERS)
def test_a_good_recording(tmp_path, name):
    WRITERS[name](tmp_path, SEEN)
    found = inspect(tmp_path)
    assert found.warnings == () and found.gaps == ()
    assert (found.colors, found.masks) == (12, 12)
    assert found.depths.median == pytest.approx(np.median(SEEN.depth))
    assert found.depths[1:] == (0, 0, 12, 0, (), None, 0)
    steps = np.diff(SEEN.T_world_camera[:, :3, 3], axis=0)
    assert found.poses.known == 12 and found.poses.damaged == ()
    assert found.poses.length == pytest.approx(np.linalg.norm(steps, axis=1).sum(), rel=1e-4)
    assert found.poses.agreement > 0.8 and found.poses.reading.best is None
    assert found.rate == (pytest.approx(30, rel=1e-3) if name in ("tum", "redwood") else None)


@pytest.mark.parametrize("written, read", [(1000, 1.0), (5000, 1000.0), (1000, 5000.0)])
def test_poses_tell_a_wrong_depth_scale(tmp_path, written, read):
    write_7_scenes(tmp_path, SEEN, scale=written)
    sequence = open_sequence(tmp_path, depth_scale=read)
    (warning,) = inspect_sequence(sequence, keep_scale=True).warnings
    said = rf"a metre has {written} depth units: then 9\d% .* as written \d+%"
    assert re.search(said, warning.evidence)
    assert warning.advice == f"Is --depth-scale {written} meant?"
    assert inspect_sequence(sequence).sequence.depth_scale == written


@pytest.mark.parametrize(
    "written, read, said",
    [
        (1000, 1.0, "3 km at depth scale 1; expected 0.1 to 20 m Is --depth-scale 1000 meant"),
        (
            4000,
            1000.0,
            "12 m at depth scale 1000; .* 0.3 to 7 m .* 4000, 5000, 6553.5 or 10000 meant",
        ),
        (1000, 5000.0, None),
    ],
)
def test_without_poses_the_median_depth_tells_or_not(tmp_path, written, read, said):
    write_redwood(tmp_path, SEEN, scale=written, poses=False)
    warnings = warnings_of(tmp_path, depth_scale=read)
    assert len(warnings) == (said is not None)
    assert said is None or re.search(said, warnings[0])


def test_poses_of_another_recording(tmp_path):
    turned = Rotation.from_euler("y", np.arange(12)[:, None] ** 2).as_matrix()
    T = SEEN.T_world_camera.copy()
    T[:, :3, :3] = turned
    write_7_scenes(tmp_path, SEEN._replace(T_world_camera=T))
    assert any("fit the depth images badly" in warning for warning in warnings_of(tmp_path))


def test_poses_that_are_missing_or_not_rigid(tmp_path):
    write_7_scenes(tmp_path, SEEN)
    (tmp_path / "frame-000004.pose.txt").unlink()
    assert any("1 of 12 frames have no pose" in warning for warning in warnings_of(tmp_path))
    np.savetxt(tmp_path / "frame-000005.pose.txt", np.diag([2.0, 1, 1, 1]))
    found = inspect(tmp_path)
    assert found.poses.known == 10 and len(found.poses.damaged) == 1
    assert any("frame-000005.pose.txt" in warning.evidence for warning in found.warnings)


def test_gaps_of_numbers_and_of_times(tmp_path):
    write_7_scenes(tmp_path / "a", SEEN)
    for number in (3, 4, 8):
        (tmp_path / f"a/frame-{number:06d}.depth.png").unlink()
        (tmp_path / f"a/frame-{number:06d}.pose.txt").unlink()
    assert inspect(tmp_path / "a").gaps == (
        Gap("frame-000002", "frame-000005", 2),
        Gap("frame-000007", "frame-000009", 1),
    )
    assert any(
        "missing frames: 3, the most (2) between" in warning
        for warning in warnings_of(tmp_path / "a")
    )
    write_redwood(tmp_path / "b", SEEN, poses=False)
    for path in sorted((tmp_path / "b/depth").iterdir())[4:6]:
        path.unlink()
    (gap,) = inspect(tmp_path / "b").gaps
    assert gap.missing == 2 and gap.after.startswith("0000004-")


def test_every_fifth_frame_is_no_gap(tmp_path):
    write_7_scenes(tmp_path, SEEN)
    for path in sorted(tmp_path.glob("frame-*"), reverse=True):
        stem, end = path.name.split(".", 1)
        path.rename(tmp_path / f"frame-{5 * int(stem[6:]):06d}.{end}")
    assert inspect(tmp_path).gaps == ()


def test_damaged_black_and_saturated_images(tmp_path):
    write_7_scenes(tmp_path, SEEN)
    (tmp_path / "frame-000002.depth.png").write_bytes(b"")
    save(tmp_path / "frame-000003.depth.png", np.zeros((H, W), np.uint16))
    for number in range(4, 10):
        save(tmp_path / f"frame-{number:06d}.depth.png", np.full((H, W), 65535, np.uint16))
    found = inspect(tmp_path)
    assert found.depths.invalid == pytest.approx(7 / 11)
    assert found.depths.saturated == pytest.approx(6 / 11)
    warnings = " ".join(warning.evidence for warning in found.warnings)
    assert "sampled depth images that cannot be used: 1; " in warnings
    assert "7 of 11 sampled depth images hold no valid depth" in warnings
    assert "64% of the depth pixels hold nothing, 55% are saturated" in warnings


def test_depth_of_the_other_sign_is_named(tmp_path):
    write_open3d(tmp_path, SEEN)
    for i, depth in enumerate(SEEN.depth):
        (tmp_path / f"depth/depth_{i}.png").unlink()
        np.save(tmp_path / f"depth/depth_{i}.npy", -depth.astype(np.float32))
    found = inspect_sequence(open_sequence(tmp_path))
    assert found.depths.negative > 0.5
    said = [one for one in found.warnings if "are negative" in one.evidence]
    assert len(said) == 1 and "absolute values" in said[0].sentence
    assert not any("out of the sun" in one.sentence for one in found.warnings)


@pytest.mark.parametrize("kind", [np.int32, np.float32])
def test_micrometres_are_not_saturated(tmp_path, kind):
    write_open3d(tmp_path, SEEN)
    (tmp_path / "trajectory.log").unlink()
    for i, depth in enumerate(SEEN.depth):
        (tmp_path / f"depth/depth_{i}.png").unlink()
        np.save(tmp_path / f"depth/depth_{i}.npy", (depth * 1e6).astype(kind))
    found = inspect_sequence(open_sequence(tmp_path))
    assert found.depths.saturated == found.depths.invalid == 0
    (warning,) = [one for one in found.warnings if "median depth" in one.evidence]
    assert warning.advice == "Is --depth-scale 1e+06 meant?"
    sequence = open_sequence(tmp_path, depth_scale=1e6)
    np.testing.assert_allclose(sequence[2].depth, SEEN.depth[2], rtol=1e-6)
    np.save(tmp_path / "depth/depth_2.npy", np.float32([[65535, np.inf, 1e10, 2e6]] * H).repeat(
        W // 4, axis=1))  # fmt: skip
    assert np.unique(sequence[2].depth).tolist() == [0, 2]


def test_a_recording_without_any_depth_is_inspected(tmp_path):
    write_7_scenes(tmp_path, SEEN._replace(depth=0 * SEEN.depth))
    assert "12 of 12 sampled depth images hold no valid depth" in " ".join(warnings_of(tmp_path))


def test_single_images_of_another_unit_are_named(tmp_path):
    write_7_scenes(tmp_path, SEEN)
    save(tmp_path / "frame-000003.depth.png", (SEEN.depth[3] * 20).astype(np.uint16))
    found = inspect_sequence(open_sequence(tmp_path))
    assert (
        len(found.depths.damaged) == 1 and "frame-000003.depth.png: the" in found.depths.damaged[0]
    )
    assert any(
        "sampled depth images that cannot be used: 1" in one.evidence for one in found.warnings
    )


@pytest.mark.parametrize("number, share", [(32767, 0.05), (32767, 0.7), (10000, 0.3), (4000, 0.3)])
def test_a_number_for_nothing_measured_is_named(tmp_path, number, share):
    write_7_scenes(tmp_path, SEEN)
    assert inspect_sequence(open_sequence(tmp_path)).depths.beyond is None
    rng = np.random.default_rng(0)
    for path in tmp_path.glob("*.depth.png"):
        depth = np.array(Image.open(path))
        save(path, np.where(rng.random(depth.shape) < share, np.uint16(number), depth))
    found = inspect_sequence(open_sequence(tmp_path))
    said = [one.evidence for one in found.warnings if f"the number {number}" in one.evidence]
    assert len(said) == (number > 4000)  # the depths are 1.5 to 3.3 m


def test_damaged_colours_and_masks(tmp_path):
    write_7_scenes(tmp_path, SEEN)
    (tmp_path / "frame-000002.color.png").write_bytes(b"")
    (tmp_path / "frame-000003.mask.png").write_bytes(b"")
    (warning,) = warnings_of(tmp_path)
    assert "cannot be used: 2; " in warning and "frame-000002.color.png" in warning


@pytest.mark.parametrize(
    "orientation, said",
    [(1, None), (3, "shown turned by 180"), (6, "turned clockwise by 90"), (9, None)],
)
def test_an_exif_orientation_is_named_and_not_applied(tmp_path, orientation, said):
    write_7_scenes(tmp_path, SEEN)
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    for path in sorted(tmp_path.glob("*.color.png")):
        stored = Image.open(path)
        path.unlink()
        stored.save(path.with_suffix(".jpg"), exif=exif, quality=95)
    np.testing.assert_array_equal(open_sequence(tmp_path)[3].color, np.array(Image.open(
        tmp_path / "frame-000003.color.jpg")))  # fmt: skip
    warnings = warnings_of(tmp_path)
    assert len(warnings) == (said is not None)
    assert said is None or re.search(
        f"12 sampled .* {said} degrees .* without the tag", warnings[0]
    )


def test_images_that_cannot_be_read_at_all(tmp_path):
    for number in range(3):
        save(tmp_path / f"frame-{number}.depth.png", np.full((H, W), 200, np.uint8))
    np.savetxt(tmp_path / "camera-intrinsics.txt", K)
    with pytest.raises(SequenceError, match="frame-0.depth.png has Pillow mode L"):
        inspect(tmp_path)


@pytest.mark.parametrize(
    "change, said",
    [
        ([[1, 1, 0.6], [1, 1, 1], [1, 1, 1]], "principal point 19.2, 24.0 is far from the centre"),
        ([[4, 1, 1], [1, 4, 1], [1, 1, 1]], "makes the images 15 degrees wide"),
        ([[1, 1, 1], [1, 1.2, 1], [1, 1, 1]], "focal lengths 60.0 and 72.0 differ"),
    ],
)
def test_cameras_that_are_unlikely(tmp_path, change, said):
    write_7_scenes(tmp_path, SEEN)
    np.savetxt(tmp_path / "camera-intrinsics.txt", K * change)
    assert any(said in warning for warning in warnings_of(tmp_path))


def test_colours_of_other_times_and_without_depth(tmp_path):
    write_tum(tmp_path, SEEN)
    lines = (tmp_path / "rgb.txt").read_text().splitlines()
    (tmp_path / "rgb.txt").write_text("\n".join(lines[:6]))
    assert any(
        "8 of 12 depth images have no colour" in warning for warning in warnings_of(tmp_path)
    )


@pytest.mark.parametrize("per_second, said", [(1e3, "33 s"), (1e9, "3.33e+07 s")])
def test_times_in_other_units_than_seconds(tmp_path, per_second, said):
    write_tum(tmp_path, SEEN)
    for name in ("depth.txt", "rgb.txt", "groundtruth.txt"):
        lines = [line.split(" ", 1) for line in (tmp_path / name).read_text().splitlines()]
        text = [f"{float(t) * per_second:.0f} {rest}" for t, rest in lines if t != "#"]
        (tmp_path / name).write_text("\n".join(text))
    assert any(f"two depth images is {said}" in warning for warning in warnings_of(tmp_path))
