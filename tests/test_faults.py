"""Recordings with faults: each ends with a result or a sentence, and nothing earlier is lost."""

import json
import os
import signal
import subprocess
import sys
import time
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from marks import slow
from orbit_recording import (
    FOCAL,
    depth_path,
    pose_errors,
    record,
    write_camera,
    write_depth,
    write_recording,
)

from jaxshape.cli import recording as command
from jaxshape.data.sequences import read_trajectory
from jaxshape.geometry.grids import binary
from jaxshape.mapping.map import mapper as module
from jaxshape.mapping.map import recording
from jaxshape.mapping.map.recording import trajectory
from jaxshape.mapping.map.state import grids_of
from jaxshape.report import page, panels
from jaxshape.results.checkpoint import STATE

TESTS = Path(__file__).parent


@pytest.fixture
def folder(tmp_path, walk):
    """A recording to break."""
    return write_recording(tmp_path / "frames", walk)


@pytest.fixture(scope="module")
def whole(tmp_path_factory, walk, followed):
    """What is made of the recording without a fault."""
    return followed(write_recording(tmp_path_factory.mktemp("whole") / "frames", walk))


def statuses(progress):
    return {int(log.name[-6:]): log.status for log in progress.logs}


def worst_errors(progress, walk):
    """Centimetres and degrees of the worst of the poses that were believed."""
    found, names = trajectory(progress), {log.index: int(log.name[-6:]) for log in progress.logs}
    errors = [pose_errors(T, walk.T_world_camera[names[i]]) for i, T in found.items()]
    return tuple(np.max(errors, axis=0))


def assert_tracked(progress, walk, *, but=()):
    """All frames but some have a pose, and every pose is right."""
    left_out = {i for i, status in statuses(progress).items() if status in ("lost", "unreadable")}
    assert left_out == set(but)
    centimetres, degrees = worst_errors(progress, walk)
    assert centimetres < 2 and degrees < 2
    assert progress.shape is not None


# Frames -----------------------------------------------------------------------------------------


def test_a_recording_without_faults(whole, walk):
    assert_tracked(whole, walk)


@pytest.mark.parametrize(
    "missing", [range(2, 14, 3), slow(range(4, 9)), slow(range(3, 10)), range(1, 13)]
)
def test_frames_are_missing(folder, walk, followed, missing):
    """Every third; a jump of 30, 40 and 65 degrees."""
    for i in missing:
        depth_path(folder, i).unlink()
    progress = followed(folder)
    assert_tracked(progress, walk)
    assert len(progress.logs) == len(walk.depth) - len(missing)


def test_depth_is_black_or_saturated(folder, walk, followed, whole):
    """Such frames are left out, and nothing of them is fused."""
    for i, value in ((4, 0), (5, 0), (8, 65535)):
        write_depth(folder, i, np.full_like(walk.depth[0], value))
    progress = followed(folder)
    assert_tracked(progress, walk, but=(4, 5, 8))
    assert all("seen again" in log.reason for log in progress.logs if log.status == "lost")
    assert same_shape(progress, whole) > 0.8


def test_depth_is_saturated_where_the_object_is(folder, walk, followed):
    for i in (5, 6):
        depth = walk.depth[i].copy()
        depth[30:100, 40:90] = 65535
        write_depth(folder, i, depth)
    assert_tracked(followed(folder), walk)


def test_something_is_held_before_the_camera(folder, walk, followed):
    """It hides four fifths of the image and moves with the camera."""
    for i in (5, 6, 7):
        depth = walk.depth[i].copy()
        across, down = np.arange(102), np.arange(128)[:, None]
        depth[:, :102] = 500 + across / 2 + down / 3 + 60 * np.sin(across / 15)
        write_depth(folder, i, depth)
    assert_tracked(followed(folder), walk, but=(5, 6, 7))


def test_files_are_damaged(folder, walk, followed):
    path = depth_path(folder, 6)
    path.write_bytes(path.read_bytes()[:900])
    (folder / "frame-000007.pose.txt").write_text("1 0 0")
    progress = followed(folder)
    assert_tracked(progress, walk, but=(6, 7))
    said = {log.index: log.reason for log in progress.logs if log.status == "unreadable"}
    assert "image file is truncated" in said[6] and "is not a matrix" in said[7]


def test_the_first_frame_is_damaged(folder, walk, followed):
    depth_path(folder, 0).write_bytes(b"")
    progress = followed(folder)
    assert_tracked(progress, walk)
    assert progress.start.index == 1 and len(progress.logs) == len(walk.depth) - 1


def test_there_is_one_frame(folder, walk, followed):
    for i in range(1, len(walk.depth)):
        depth_path(folder, i).unlink()
    progress = followed(folder)
    assert_tracked(progress, walk)
    assert len(progress.logs) == len(progress.state.keyframes) == 1


# The scene and the camera -----------------------------------------------------------------------


def same_shape(ours, theirs):
    """Share of the voxels occupied in one that lie on or beside one occupied in the other."""
    occupied, other = (np.asarray(binary(grids_of(x.state)).occupied) for x in (ours, theirs))
    padded = np.pad(other, 1)
    around = [padded[1 + i : 33 + i, 1 + j : 33 + j, 1 + k : 33 + k]
              for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)]  # fmt: skip
    return (occupied & np.any(around, axis=0)).sum() / occupied.sum()


@pytest.mark.slow
def test_something_moves_in_front_of_the_object(tmp_path, walk, followed, whole):
    progress = followed(write_recording(tmp_path / "frames", record(occluder=True)))
    assert_tracked(progress, walk)
    least = min(log.figures["inlier_fraction"] for log in progress.logs[4:10])
    assert 0.8 < least < 0.95  # it is noticed, and does not agree
    assert same_shape(progress, whole) > 0.97


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.95, 1.05])
def test_the_focal_length_is_wrong(folder, walk, followed, whole, factor):
    """The map is then a little larger or smaller, which nothing in it contradicts."""
    write_camera(folder, factor * FOCAL)
    progress = followed(folder)
    assert "lost" not in statuses(progress).values() and progress.shape is not None
    centimetres, degrees = worst_errors(progress, walk)
    assert worst_errors(whole, walk)[0] < centimetres < 8 and degrees < 3
    rmse, right = (np.mean([log.figures["rmse"] for log in one.logs[1:]])
                   for one in (progress, whole))  # fmt: skip
    assert 1.0 < rmse / right < 1.5


# The run ----------------------------------------------------------------------------------------

OPTIONS = ("--iterations", "3", "--keyframe-iterations", "2", "--min-hits", "1")


@pytest.fixture
def run(run, monkeypatch, known_weights):
    """Run `reconstruct` in this process; returns its exit status, its answer and its complaint."""
    monkeypatch.setattr(panels, "write_overview", lambda *_: None)
    monkeypatch.setattr(page, "write_report", lambda *_: None)
    given = ("--weights", known_weights, *OPTIONS)
    return lambda folder, *options: run("reconstruct", folder, *given, *options)


@pytest.fixture
def compiled(monkeypatch, mapper):
    """The mapper of all tests in place of one to be compiled; its settings are its own."""
    monkeypatch.setattr(module, "build_mapper", lambda *_, **__: mapper)


def test_no_frame_can_be_read(run, folder, tmp_path, compiled):
    for path in folder.glob("*.depth.png"):
        path.write_bytes(path.read_bytes()[:200])
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "result.json").write_text("earlier")
    for box in ((), ("--box", folder / "box.json")):
        status, out, err = run(folder, *box, "--output", tmp_path / "out")
        assert status == 2 and not out and "cannot be read as an image" in err
    assert [path.read_text() for path in (tmp_path / "out").iterdir()] == ["earlier"]


@pytest.mark.slow
def test_a_run_can_be_watched_killed_and_gone_on_with(
    run, folder, tmp_path, walk, compiled, monkeypatch
):
    """Whoever asks for something else meanwhile is told so."""
    there = tmp_path / "out"
    given = (folder, "--box", folder / "box.json", "--poses", "first", "--output", there)
    monkeypatch.setattr(command, "_SECONDS_BETWEEN_WRITES", 0.0)
    follow, seen = recording.follow, []

    def killed(*arguments, **settings):
        for progress in islice(follow(*arguments, **settings), 6):
            yield progress
            seen.append(json.loads((there / "result.json").read_text()))
        raise OSError("killed.")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recording, "follow", killed)
        status, _, err = run(*given)
    assert status == 2 and "killed" in err
    assert all(result["running"] for result in seen) and 1 < seen[-1]["keyframes"] < 6
    assert (there / STATE).is_file() and (there / "mesh.glb").is_file()

    status, _, err = run(*given, "--seed", 1)
    assert status == 2 and "unfinished reconstruction with other settings" in err
    status, _, err = run(*given, "--every", 2)
    assert status == 2 and "--fresh to start over" in err

    status, out, err = run(*given)
    assert status == 0 and "resuming after frame" in err, err
    result = json.loads((there / "result.json").read_text())
    assert "running" not in result and not (there / STATE).exists()
    assert result["frames"] == result["frames_tracked"] == len(walk.depth)
    found = read_trajectory(there / "trajectory.log")
    for index, T in zip(found.frames, found.T_world_camera, strict=True):
        centimetres, degrees = pose_errors(T, walk.T_world_camera[index])
        assert centimetres < 2 and degrees < 2


def test_fresh_begins_anew(run, folder, tmp_path, compiled, monkeypatch):
    given = (folder, "--box", folder / "box.json", "--every", 5, "--output", tmp_path / "out")
    follow = recording.follow

    def killed(*arguments, **settings):
        yield from islice(follow(*arguments, **settings), 1)
        raise OSError("killed.")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recording, "follow", killed)
        assert run(*given)[0] == 2
    status, out, err = run(*given, "--seed", 3, "--fresh")
    assert status == 0 and "going on" not in err, err
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert result["seed"] == 3 and result["frames"] == 3
    assert not (tmp_path / "out" / STATE).exists()


PROGRAM = """
from jaxshape.report import page, panels
panels.write_overview = page.write_report = lambda *_: None
from jaxshape import cli
cli.main()
"""


@pytest.mark.slow
@pytest.mark.parametrize("poses", ["given", "first"])
def test_a_process_is_killed(run, folder, tmp_path, known_weights, poses):
    """What the same command, given again, ends with is what it ends with undisturbed."""
    given = (folder, "--box", folder / "box.json", "--poses", poses)
    assert run(*given, "--output", tmp_path / "undisturbed")[0] == 0

    there = tmp_path / "killed"
    given = ("--weights", known_weights, *given)
    arguments = ("reconstruct", *given, *OPTIONS, "--output", there)
    argv = [sys.executable, "-c", PROGRAM, *map(str, arguments)]
    cache = {
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path / "compiled"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    environment = cache | dict(os.environ)
    with subprocess.Popen(argv, env=environment, stderr=subprocess.DEVNULL) as process:
        while process.poll() is None and frames_kept(there) < 4:
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL and frames_kept(there) < 14
    again = subprocess.run(argv, env=environment, capture_output=True, text=True)
    assert again.returncode == 0 and "resuming after frame" in again.stderr, again.stderr

    for name in ("grid.npz", "trace.npz"):
        with np.load(there / name) as ours, np.load(tmp_path / "undisturbed" / name) as whole:
            assert set(ours) == set(whole)
            for key in whole:
                np.testing.assert_array_equal(ours[key], whole[key], err_msg=key)
    results = [json.loads((at / "result.json").read_text())
               for at in (there, tmp_path / "undisturbed")]  # fmt: skip
    for result in results:
        del result["seconds"]
    assert results[0] == results[1]
    for name in ("trajectory.log", "mesh.ply"):
        assert (there / name).read_bytes() == (tmp_path / "undisturbed" / name).read_bytes()


def frames_kept(folder):
    """How many frames a killed run need not look at again."""
    if not (folder / STATE).is_file():
        return 0
    with np.load(folder / STATE) as file:
        return len(json.loads(str(file["about"]))["logs"])
