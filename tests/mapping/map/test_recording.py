"""Following a recording: what is taken from the files, what is tracked, what becomes of frames."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from by_points import by_points
from orbit_recording import (
    INTRINSICS,
    T_WORLD_OBJECT,
    depth_path,
    pose_errors,
    write_depth,
    write_recording,
)
from PIL import Image

from jaxshape.data.boxes import read_box
from jaxshape.data.sequences import SequenceError, open_sequence
from jaxshape.geometry import fusion, grid
from jaxshape.geometry.grid import MARGIN, RESOLUTION
from jaxshape.geometry.overlap import iou
from jaxshape.mapping.map.doubts import doubts_of
from jaxshape.mapping.map.recording import FrameLog, Progress, trajectory
from jaxshape.mapping.placement import finding
from jaxshape.mapping.placement.finding import Start, find_start
from jaxshape.mapping.placement.placing import Placement
from jaxshape.mapping.segmentation.segment import Prompt
from jaxshape.mapping.tracking.keyframes import place_of

FEW, NOTHING_SAID = 5, Prompt()


@pytest.fixture(scope="module")
def folder(tmp_path_factory, walk):
    return write_recording(tmp_path_factory.mktemp("walk") / "frames", walk)


@pytest.fixture
def copy(folder, tmp_path):
    """The recording, to break."""
    copy = tmp_path / "frames"
    copy.mkdir()
    for path in folder.iterdir():
        (copy / path.name).write_bytes(path.read_bytes())
    return copy


@pytest.fixture(scope="module")
def begin(known):
    def begin(folder, prompt=NOTHING_SAID, *, box=True, **options):
        sequence = open_sequence(folder)
        given = read_box(folder / "box.json") if box else None
        return sequence, find_start(sequence, known, prompt, box=given, **options)

    return begin


@pytest.fixture(scope="module")
def tracked(followed, folder):
    """With the first pose given, and no other."""
    return followed(folder)


@pytest.fixture(scope="module")
def given(followed, folder):
    return followed(folder, chosen=range(FEW), use_poses=True)


# Poses ------------------------------------------------------------------------------------------


def test_the_first_pose_is_given_and_the_others_are_found(tracked, walk):
    poses = trajectory(tracked)
    assert sorted(poses) == list(range(len(walk.depth)))
    np.testing.assert_allclose(poses[0], walk.T_world_camera[0], atol=1e-5)
    for index, T in poses.items():
        centimetres, degrees = pose_errors(T, walk.T_world_camera[index])
        assert centimetres < 2 and degrees < 1, index
    assert {log.status for log in tracked.logs} == {"keyframe", "tracked"}
    assert all(log.figures["inlier_fraction"] > 0.9 for log in tracked.logs[1:])


def test_given_poses_are_taken_as_they_are(given, walk):
    for index, T in trajectory(given).items():
        np.testing.assert_allclose(T, walk.T_world_camera[index], atol=1e-5)
    assert all("inlier_fraction" not in log.figures for log in given.logs)


def drift(index):
    """The pose of a camera whose own map has slipped: farther to the side with every frame."""
    off = np.eye(4)
    off[:3, 3] = 0.008 * index * np.array([0.6, 0.0, 0.8])
    return off


def test_given_poses_that_drift_are_moved_to_where_the_frames_agree(followed, copy, walk):
    for i, T in enumerate(walk.T_world_camera):
        np.savetxt(copy / f"frame-{i:06d}.pose.txt", drift(i) @ T)
    progress = followed(copy, use_poses=True)
    moved = [log for log in progress.logs if "moved" in log.figures]
    assert moved and max(log.figures["moved"] for log in moved) > 0.01
    for log, keyframe in progress.of_keyframes():
        truth, T = walk.T_world_camera[log.index], np.asarray(keyframe.T_world_camera.as_matrix())
        given, found = pose_errors(drift(log.index) @ truth, truth), pose_errors(T, truth)
        assert found[0] < max(0.3 * given[0], 1.0)
    assert any("do not fit the depth images" in sentence for sentence in doubts_of(progress))


def test_frames_whose_pose_is_missing_are_tracked(followed, copy, walk):
    for i in (0, 2, 3):
        (copy / f"frame-{i:06d}.pose.txt").unlink()
    progress = followed(copy, chosen=range(FEW), use_poses=True)
    assert progress.start.index == 1 and [log.index for log in progress.logs] == [1, 2, 3, 4]
    poses, were_tracked = trajectory(progress), [2, 3]
    for log in progress.logs:
        centimetres, degrees = pose_errors(poses[log.index], walk.T_world_camera[log.index])
        assert ("inlier_fraction" in log.figures) == (log.index in were_tracked)
        assert centimetres < (2 if log.index in were_tracked else 0.01) and degrees < 1


def test_the_world_is_that_of_the_first_camera_where_no_pose_is_used(begin, folder, copy, known):
    _, start = begin(folder, use_pose=False)
    np.testing.assert_array_equal(start.T_world_camera, np.eye(4))
    for path in copy.glob("*.pose.txt"):
        path.unlink()
    _, start = begin(copy)
    np.testing.assert_array_equal(start.T_world_camera, np.eye(4))


def test_frames_move_with_their_keyframe():
    """A realignment moves keyframes alone; the frames tracked from them keep their place there."""

    def log(index, keyframe, T):
        return FrameLog(index, str(index), "tracked", "", keyframe, T, {})

    here, there = np.eye(4), np.eye(4)
    here[:3, 3], there[:3, 3] = (1, 2, 3), (-4, 0, 5)
    turn = jaxlie.SE3.from_rotation(jaxlie.SO3.from_y_radians(0.5))
    poses = (jaxlie.SE3.from_matrix(jnp.float32(here)), turn)
    state = SimpleNamespace(keyframes=[SimpleNamespace(T_world_camera=T) for T in poses])
    logs = (log(0, 0, np.eye(4)), log(1, 0, there), log(2, 0, None), log(4, 1, there))
    found = trajectory(Progress(state, None, logs))
    assert sorted(found) == [0, 1, 4]
    np.testing.assert_allclose(found[1], here @ there, atol=1e-6)
    np.testing.assert_allclose(found[4], np.asarray(turn.as_matrix()) @ there, atol=1e-6)


def test_keyframes_are_realigned_and_the_live_poses_of_others_follow(tracked):
    poses = trajectory(tracked)
    numbers = [log for log in tracked.logs if log.status == "keyframe"]
    for keyframe, log in zip(tracked.state.keyframes, numbers, strict=True):
        T = np.asarray(keyframe.T_world_camera.as_matrix(), np.float64)
        np.testing.assert_allclose(poses[log.index], T, atol=1e-5)


# What is fused ----------------------------------------------------------------------------------


def fused_in_the_object_frame(walk, chosen, frame, inside):
    """One view after the other, with the poses the camera really had."""
    measurement = fusion.nothing_measured()
    for i in chosen:
        T = np.linalg.inv(T_WORLD_OBJECT) @ walk.T_world_camera[i]
        pose, depth = jaxlie.SE3.from_matrix(jnp.float32(T)), jnp.float32(walk.depth[i] / 1000)
        new = fuse(depth, jnp.asarray(inside[i]), INTRINSICS, pose, frame)
        measurement = fusion.merge(measurement, new)
    return measurement


fuse = jax.jit(fusion.measure)


def agree(ours, expected):
    """Points on the border of two voxels may fall either way."""
    return expected.any() and iou(jnp.asarray(ours), expected) > 0.97


@pytest.fixture(scope="module")
def expected(given, walk):
    """Fused without the machinery, from the same pixels."""
    frame = grid.fit_box(jnp.float32(-walk.box.size / 2), jnp.float32(walk.box.size / 2))
    indices = [log.index for log in given.logs if log.status == "keyframe"]
    inside = {i: one.segmented for i, one in zip(indices, given.state.keyframes, strict=True)}
    return fused_in_the_object_frame(walk, indices, frame, inside)


def test_the_world_does_not_matter(given, expected, walk, known):
    ours, frame = by_points(known, given.state), given.state.place.frame
    assert agree(fusion.occupied(ours), fusion.occupied(expected))
    assert agree(fusion.occluded(ours), fusion.occluded(expected))
    assert agree(fusion.occupied(ours, 3), fusion.occupied(expected, 3))
    np.testing.assert_allclose(np.asarray(frame.origin) + 16 * np.asarray(frame.voxel_size), 0,
                               atol=1e-5)  # fmt: skip


def test_the_object_is_what_lies_in_the_box(given, walk):
    for keyframe in given.state.keyframes:
        T = np.linalg.inv(T_WORLD_OBJECT) @ np.asarray(keyframe.T_world_camera.as_matrix())
        depth = np.asarray(keyframe.depth)
        v, u = np.nonzero(np.asarray(keyframe.segmented))
        fx, fy, cx, cy = (float(x) for x in keyframe.intrinsics)
        z = depth[v, u]
        points = np.stack([(u + 0.5 - cx) / fx * z, (v + 0.5 - cy) / fy * z, z], axis=1)
        points = points @ T[:3, :3].T + T[:3, 3]
        assert len(points) > 300  # and a filter of the depth moves them by little
        assert (np.abs(points) < walk.box.size / 2 + 0.03).all()


def test_only_the_chosen_frames_count(followed, folder):
    progress = followed(folder, chosen=range(0, 14, 6), use_poses=True)
    assert [log.index for log in progress.logs] == [0, 6, 12]
    assert len(progress.state.keyframes) == 3


@pytest.mark.parametrize("chosen", [[0, 99], [-1], [0, 1.5]])
def test_a_chosen_frame_that_is_not_there_is_refused(unchecked_types, followed, folder, chosen):
    with pytest.raises(ValueError, match=r"chosen is [-\d.]+; give a whole number, 0 "):
        followed(folder, chosen=chosen, use_poses=True)


def test_points_outside_the_mask_are_not_the_object(followed, copy, given, known):
    """With half of the masks blacked out, what is left is what the masks show."""
    indices = [log.index for log in given.logs if log.status == "keyframe"]
    for index, keyframe in zip(indices, given.state.keyframes, strict=True):
        mask = np.array(keyframe.segmented)
        mask[:, : np.nonzero(mask)[1].mean().astype(int)] = False
        Image.fromarray(mask.astype(np.uint8) * 255).save(copy / f"frame-{index:06d}.mask.png")
    half = followed(copy, chosen=range(FEW), use_poses=True)
    ours, whole = (fusion.occupied(by_points(known, one.state)) for one in (half, given))
    assert 0 < ours.sum() < 0.8 * whole.sum()
    assert not np.any(ours & ~whole)


def test_isotropic_voxels_are_cubes_around_the_same_centre(walk):
    frame = place_of(walk.box, 32, isotropic=True).frame
    np.testing.assert_allclose(
        frame.voxel_size, walk.box.size.max() / (RESOLUTION - 2 * MARGIN), rtol=1e-5
    )
    np.testing.assert_allclose(frame.origin + 16 * frame.voxel_size, 0, atol=1e-5)
    assert np.ptp(np.asarray(place_of(walk.box, 32).frame.voxel_size)) > 1e-3


# The first frame --------------------------------------------------------------------------------


def test_with_a_box_the_first_frame_that_can_be_read_is_the_first(begin, copy):
    depth_path(copy, 0).write_bytes(b"")
    (copy / "frame-000001.pose.txt").unlink()
    _, start = begin(copy)
    assert start.index == 2 and start.T_level_world is None
    said = "The map begins with frame-000002: 2 frames before it cannot be read or have no pose."
    assert start.warnings == (said,)
    fifth = begin(copy, first=5)[1]
    assert fifth.index == 5 and not fifth.warnings
    with pytest.raises(ValueError, match="first is 99; give a whole number, 0 to 13"):
        begin(copy, first=99)
    for path in copy.glob("*.depth.png"):
        path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(SequenceError, match="cannot be read as an image"):
        begin(copy)


def test_nothing_to_be_found_is_said_in_a_sentence(begin, copy, walk):
    depth_path(copy, 0).write_bytes(b"")
    for i in range(1, len(walk.depth)):
        write_depth(copy, i, np.full_like(walk.depth[0], 1500))
    with pytest.raises(SequenceError, match="say where it is with --click, .*") as problem:
        begin(copy, box=False)
    said = str(problem.value)
    assert "frame-000000: " in said and "cannot be read" in said
    assert "frame-000001: Nothing but floor, walls and table tops" in said


def test_a_click_that_meets_nothing_ends_the_search(begin, copy, walk):
    """A place in one image means nothing in another."""
    write_depth(copy, 0, np.full_like(walk.depth[0], 1500))
    with pytest.raises(SequenceError, match="frame-000000: One cluster") as problem:
        begin(copy, Prompt(click=(64.0, 64.0)), box=False)
    assert "frame-000001" not in str(problem.value)


def test_a_found_object_stands_upright_and_without_the_floor(begin, copy, walk, monkeypatch):
    """The prior places it; what it gets and what becomes of its answer is ours."""
    asked = []

    def place(prior, seen, floor, known, config):
        asked.append((seen, float(floor)))
        return known._replace(
            T_world_object=jaxlie.SE3.from_translation(jnp.median(seen.surface, axis=0)),
            size=jnp.float32(walk.box.size),
            misfit=jnp.float32(0.1),
            margin=jnp.float32(0.1),
        )

    monkeypatch.setattr(finding, "_place", place)
    (copy / "frame-000000.pose.txt").unlink()  # in which world would it be?
    _, start = begin(copy, box=False)
    assert isinstance(start, Start) and isinstance(start.placement, Placement)
    assert start.index == 1 and not start.warnings
    ((seen, floor),) = asked
    level = start.T_level_world
    np.testing.assert_allclose(level @ [0, 1, 0, 0], [0, 1, 0, 0], atol=0.02)
    true_floor = (level @ T_WORLD_OBJECT @ [0, walk.chair.bounds[0, 1], 0, 1])[1]
    assert floor == pytest.approx(true_floor, abs=0.03)
    # The points are those of the chair.
    points = np.asarray(seen.surface, np.float64) @ level[:3, :3]
    points = (points - T_WORLD_OBJECT[:3, 3]) @ T_WORLD_OBJECT[:3, :3]
    assert (np.abs(points) < walk.box.size / 2 + 0.05).mean() > 0.97
    bottom = start.box.exclude[0, 1, 1] + start.box.size[1] / 2
    assert bottom == pytest.approx(0.02, abs=1e-6)
    assert "floor" in start.notes[1] and start.notes[0].startswith("frame-000001: ")


def test_a_box_that_is_not_sure_is_said_and_none_is_refused(begin, folder, monkeypatch):
    def symmetric(prior, seen, floor, known, config):
        return known._replace(misfit=jnp.float32(0.1), margin=jnp.float32(0.001))

    monkeypatch.setattr(finding, "_place", symmetric)
    _, start = begin(folder, box=False)
    assert any("front of the object is not sure" in warning for warning in start.warnings)

    monkeypatch.setattr(finding, "_place", lambda prior, seen, floor, known, config: known)
    with pytest.raises(SequenceError, match="too little of it was seen to find its box"):
        begin(folder, box=False)
