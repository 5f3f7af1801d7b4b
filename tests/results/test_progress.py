"""What a run leaves on disk: going on after a kill is as if nothing had happened."""

import json

import jax
import numpy as np
import pytest
from orbit_recording import write_recording
from PIL import Image

from jaxshape import files
from jaxshape.data.boxes import read_box
from jaxshape.data.sequences import SequenceError, open_sequence, read_trajectory
from jaxshape.mapping.map.recording import follow, trajectory
from jaxshape.mapping.placement.finding import find_start
from jaxshape.mapping.segmentation.segment import Prompt
from jaxshape.report.tables import COLUMNS, keyframe_table
from jaxshape.results import progress as module
from jaxshape.results.folder import read_folder
from jaxshape.results.progress import (
    STATE,
    counts,
    load_state,
    observation_of,
    remove_state,
    save_state,
    write_progress,
)

CUT, LAST = 5, 8
SETTINGS = {"method": "cma", "seed": 0, "box": [1.0, 2.0]}


@pytest.fixture(scope="module")
def sequence(tmp_path_factory, walk):
    folder = write_recording(tmp_path_factory.mktemp("progress") / "frames", walk)
    black = np.zeros_like(walk.depth[0])
    Image.fromarray(black).save(folder / "frame-000003.depth.png")
    (folder / "frame-000004.depth.png").write_bytes(b"")
    return open_sequence(folder)


@pytest.fixture(scope="module")
def steps(sequence, known, mapper, tmp_path_factory):
    """The progress after each frame of a run that is not interrupted."""
    box = read_box(sequence.files[0].depth.parent / "box.json")
    start = find_start(sequence, known, Prompt(), box=box)
    return list(follow(sequence, start, mapper, known, chosen=range(LAST)))


@pytest.fixture(scope="module")
def last_keyframe(steps):
    """The last progress after a keyframe before frame CUT + 1, when a run is saved."""
    return [one for one in steps[: CUT + 1] if one.logs[-1].status == "keyframe"][-1]


def load(folder, sequence, prior, settings=SETTINGS):
    return load_state(folder, sequence, prior, settings, isotropic=False)


def assert_identical(ours, theirs):
    """Bit by bit, but for the seconds that things took."""
    for one in (ours, theirs):
        assert one.state.poses_are_given == theirs.state.poses_are_given
    jax.tree.map(np.testing.assert_array_equal, ours.state, theirs.state)
    for ours_log, log in zip(ours.logs, theirs.logs, strict=True):
        assert ours_log[:5] == log[:5]
        if log.T_keyframe_camera is None:
            assert ours_log.T_keyframe_camera is None
        else:
            np.testing.assert_array_equal(ours_log.T_keyframe_camera, log.T_keyframe_camera)
        for name in ("inlier_fraction", "overlap", "rmse", "conditioning"):
            assert ours_log.figures.get(name) == log.figures.get(name)


# The checkpoint ---------------------------------------------------------------------------------


def test_what_is_read_is_what_was_saved(tmp_path, sequence, known, last_keyframe):
    save_state(tmp_path, last_keyframe, SETTINGS)
    found = load(tmp_path, sequence, known)
    assert_identical(found, last_keyframe)
    assert found.start.notes == last_keyframe.start.notes and found.shape is None


def test_going_on_gives_what_an_uninterrupted_run_gives(
    tmp_path, sequence, known, mapper, steps, last_keyframe
):
    save_state(tmp_path, last_keyframe, SETTINGS)
    earlier = load(tmp_path, sequence, known)
    rest = list(follow(sequence, earlier.start, mapper, known, chosen=range(LAST), earlier=earlier))
    assert [one.logs[-1].index for one in rest] == list(range(earlier.logs[-1].index + 1, LAST))
    assert_identical(rest[-1], steps[-1])
    states = [mapper.finish(one.state)[0] for one in (rest[-1], steps[-1])]
    np.testing.assert_array_equal(states[0].logits, states[1].logits)


def test_a_checkpoint_is_small_and_forgotten_at_the_end(tmp_path, sequence, known, last_keyframe):
    assert load(tmp_path, sequence, known) is None
    save_state(tmp_path, last_keyframe, SETTINGS)
    keyframes = len(last_keyframe.state.keyframes)
    assert (tmp_path / STATE).stat().st_size < 200_000 + 10_000 * keyframes
    remove_state(tmp_path)
    remove_state(tmp_path)
    assert not list(tmp_path.iterdir())


def test_other_settings_are_refused(tmp_path, sequence, known, last_keyframe):
    save_state(tmp_path, last_keyframe, SETTINGS)
    with pytest.raises(SequenceError, match="with other settings; give the same ones .* --fresh"):
        load(tmp_path, sequence, known, SETTINGS | {"seed": 1})
    assert load(tmp_path, sequence, known) is not None


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 not one", None])
def test_a_damaged_checkpoint_is_refused(tmp_path, sequence, known, last_keyframe, content):
    save_state(tmp_path, last_keyframe, SETTINGS)
    path = tmp_path / STATE
    path.write_bytes(path.read_bytes()[:3000] if content is None else content)
    with pytest.raises(SequenceError, match="cannot be read .* remove it, or add --fresh"):
        load(tmp_path, sequence, known)


# The files --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def written(tmp_path_factory, sequence, steps):
    folder = tmp_path_factory.mktemp("written")
    result = write_progress(folder, sequence, steps[-1], {"object": "chair"}, 1, running=True)
    return folder, result


def test_every_frame_is_listed_with_what_became_of_it(written, steps, walk):
    folder, _ = written
    content = json.loads((folder / "keyframes.json").read_text())
    assert [frame["index"] for frame in content["frames"]] == list(range(LAST))
    statuses = {frame["name"][-1]: frame["status"] for frame in content["frames"]}
    assert statuses["0"] == "keyframe" and statuses["4"] == "unreadable"
    assert statuses["3"] == "lost" and content["frames"][3]["reason"]
    poses = trajectory(steps[-1])
    for frame in content["frames"]:
        T = frame["T_world_camera"]
        assert (T is None) == (frame["status"] in ("lost", "unreadable"))
        if T is not None:
            np.testing.assert_allclose(T, poses[frame["index"]])
    assert content["shape"] == list(walk.depth.shape[1:])
    for keyframe in content["keyframes"]:
        with Image.open(folder / keyframe["mask"]) as image:
            assert keyframe["object_pixels"] == np.count_nonzero(image) > 100
        with Image.open(folder / keyframe["depth"]) as image:
            millimetres = np.asarray(image)
        expected = walk.depth[keyframe["index"]]
        np.testing.assert_array_equal(millimetres, expected)
        assert (folder / keyframe["mask"]).is_file() and "image" not in keyframe


def test_the_report_has_a_column_for_every_figure_of_a_keyframe(written):
    """But for what tells which frame it is, and where its pictures lie."""
    folder, _ = written
    keyframes = json.loads((folder / "keyframes.json").read_text())["keyframes"]
    figures = {name for keyframe in keyframes for name in keyframe}
    figures -= {"index", "name", "status", "reason", "T_world_camera", "depth", "mask"}
    assert figures <= {column.figure for column in COLUMNS}
    assert {"inlier_fraction", "rmse", "seconds_track", "seconds_fuse"} < figures
    first, *others = keyframe_table(read_folder(folder).keyframes).split("<tr><td>")[1:]
    assert len(others) == len(keyframes) - 1 > 1
    assert "<td></td>" in first  # nothing was there to track it against
    of_others = set.intersection(*map(set, keyframes[1:])) & figures
    for row in others:
        cells = row.split("</tr>")[0].split("</td><td>")[1:]
        assert len(cells) == len(figures) and len(list(filter(None, cells))) >= len(of_others)


def test_trajectories_can_be_read_back(written, steps):
    folder, _ = written
    poses = trajectory(steps[-1])
    for name in ("trajectory.txt", "trajectory.log"):
        found = read_trajectory(folder / name)
        np.testing.assert_allclose(found.T_world_camera, [poses[i] for i in sorted(poses)],
                                   atol=1e-6)  # fmt: skip
    assert found.frames.tolist() == sorted(poses) == [0, 1, 2, 5, 6, 7]


def test_a_result_runs_until_it_is_done(tmp_path, sequence, steps):
    for running in (True, False):
        result = write_progress(tmp_path, sequence, steps[-1], {}, 1, running=running)
        assert json.loads(json.dumps(result)) == json.loads((tmp_path / "result.json").read_text())
        assert result.get("running", False) == running
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {
        "grid.npz", "keyframes", "keyframes.json", "mesh.glb", "mesh.ply", "result.json",
        "trace.npz", "trajectory.log", "trajectory.txt",
    }  # fmt: skip


def test_a_result_says_what_became_of_the_frames(written, steps):
    _, result = written
    assert (result["frames"], result["frames_lost"], result["frames_unreadable"]) == (LAST, 1, 1)
    assert result["frames_tracked"] == LAST - 2
    assert result["keyframes"] == len(steps[-1].state.keyframes) > 2
    assert counts(steps[0]) == {
        "frames": 1, "frames_tracked": 1, "frames_lost": 0, "frames_unreadable": 0, "keyframes": 1
    }  # fmt: skip


def test_each_file_is_replaced_when_whole_and_the_result_last(
    tmp_path, sequence, steps, monkeypatch
):
    """Who watches result.json finds all that it speaks of; a write that fails loses nothing."""
    replaced, replace = [], files.os.replace

    def watch(source, target):
        replaced.append(target.name)
        replace(source, target)

    monkeypatch.setattr(files.os, "replace", watch)
    write_progress(tmp_path, sequence, steps[-1], {"object": "earlier"}, 1, running=True)
    assert replaced[-1] == "result.json" and replaced.count("result.json") == 1
    assert set(replaced) == {path.name for path in tmp_path.rglob("*") if path.is_file()}

    def full(*_):
        raise OSError("No space left on device.")

    monkeypatch.setattr(module, "_keyframes", full)
    with pytest.raises(OSError, match="No space"):
        write_progress(tmp_path, sequence, steps[-1], {"object": "later"}, 1, running=False)
    assert json.loads((tmp_path / "result.json").read_text())["object"] == "earlier"
    assert not [path for path in tmp_path.rglob(".*")]


def test_depth_frames_to_show_are_cut_to_the_object(steps):
    observation = observation_of(steps[-1].state, 1)
    assert len(observation.depth) == min(6, len(steps[-1].state.keyframes))
    for shown, keyframe in zip(observation.depth, steps[-1].state.keyframes, strict=False):
        assert np.isfinite(shown).any(axis=0)[[0, -1]].all()
        assert np.isfinite(shown).any(axis=1)[[0, -1]].all()
        segmented = np.asarray(keyframe.segmented)
        np.testing.assert_array_equal(shown[np.isfinite(shown)],
                                      np.asarray(keyframe.depth)[segmented])  # fmt: skip


def test_more_hits_are_asked_of_a_voxel(steps):
    one, three = (observation_of(steps[-1].state, hits).occupied for hits in (1, 3))
    assert 0 < three.sum() < one.sum() and not np.any(three & ~one)
