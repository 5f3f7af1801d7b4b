"""What a run leaves on disk, while it runs and when it ends."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from jaxshape import files
from jaxshape.data.sequences import read_trajectory
from jaxshape.mapping.config import MappingConfig
from jaxshape.mapping.map.recording import trajectory
from jaxshape.mapping.map.state import assemble
from jaxshape.report.tables import COLUMNS, keyframe_table
from jaxshape.results import progress as module
from jaxshape.results.coloring import NEUTRAL
from jaxshape.results.folder import read_folder
from jaxshape.results.progress import color_views, counts, observation_of, write_progress
from jaxshape.results.surface import read_ply

LAST = 8


@pytest.fixture(scope="module")
def written(tmp_path_factory, sequence, steps):
    folder = tmp_path_factory.mktemp("written")
    result = write_progress(folder, sequence, steps[-1], {"object": "chair"}, running=True)
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


def test_a_frame_that_vanishes_costs_its_colour_alone(sequence, steps):
    files = tuple(one._replace(color=one.depth) for one in sequence.files)
    whole = replace(sequence, files=files)
    views = list(color_views(whole, steps[-1]))
    gone = next(log.index for log in steps[-1].logs if log.status == "keyframe")
    files = (*files[:gone], files[gone]._replace(depth=Path("gone.png")), *files[gone + 1 :])
    left = list(color_views(replace(whole, files=files), steps[-1]))
    assert len(left) == len(views) - 1 > 0


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
        result = write_progress(tmp_path, sequence, steps[-1], {}, running=running)
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
    write_progress(tmp_path, sequence, steps[-1], {"object": "earlier"}, running=True)
    assert replaced[-1] == "result.json" and replaced.count("result.json") == 1
    assert set(replaced) == {path.name for path in tmp_path.rglob("*") if path.is_file()}

    def full(*_):
        raise OSError("No space left on device.")

    monkeypatch.setattr(module, "keyframe_entries", full)
    with pytest.raises(OSError, match="No space"):
        write_progress(tmp_path, sequence, steps[-1], {"object": "later"}, running=False)
    assert json.loads((tmp_path / "result.json").read_text())["object"] == "earlier"
    assert not [path for path in tmp_path.rglob(".*")]


def test_the_mesh_tells_what_was_measured_and_has_no_colours_without_colour_images(written):
    folder, result = written
    found = read_ply(folder / "mesh.ply")
    assert found.color is None and 0.05 < found.measured.mean() < 0.95
    assert 0.05 < result["mesh_measured"] < 0.95 and result["mesh_pieces_dropped"] >= 0


def test_the_colours_of_the_keyframes_end_on_the_mesh(tmp_path, sequence, steps, walk):
    """All images are of one colour; so is all that was measured."""
    files = []
    for one in sequence.files:
        path = tmp_path / f"{one.name}.png"
        Image.fromarray(np.full((*walk.depth.shape[1:], 3), (150, 90, 30), np.uint8)).save(path)
        files.append(one._replace(color=path))
    colored = replace(sequence, files=tuple(files))
    views = list(color_views(colored, steps[-1]))
    assert len(views) == len(steps[-1].state.keyframes)
    T_world_object = steps[-1].state.place.box.T_world_object
    for view, keyframe in zip(views, steps[-1].state.keyframes, strict=True):
        np.testing.assert_allclose(
            T_world_object @ view.T_object_camera, keyframe.T_world_camera.as_matrix(), atol=1e-5
        )
    write_progress(tmp_path / "out", colored, steps[-1], {}, running=False)
    found = read_ply(tmp_path / "out" / "mesh.ply")
    is_painted = (found.color == (150, 90, 30)).all(axis=1)
    assert is_painted[found.measured].mean() > 0.8
    assert (found.color[~is_painted] == NEUTRAL).all()


def test_depth_frames_to_show_are_cut_to_the_object(steps):
    observation = observation_of(steps[-1].state)
    assert len(observation.depth) == min(6, len(steps[-1].state.keyframes))
    for shown, keyframe in zip(observation.depth, steps[-1].state.keyframes, strict=False):
        assert np.isfinite(shown).any(axis=0)[[0, -1]].all()
        assert np.isfinite(shown).any(axis=1)[[0, -1]].all()
        segmented = np.asarray(keyframe.segmented)
        np.testing.assert_array_equal(shown[np.isfinite(shown)],
                                      np.asarray(keyframe.depth)[segmented])  # fmt: skip


def test_more_hits_are_asked_of_a_voxel(steps, known):
    state = steps[-1].state

    def occupied(hits):
        mapping = MappingConfig(fusion="points", min_hits=hits)
        return observation_of(assemble(known, state.place, state.keyframes, state.view, mapping))

    one, three = occupied(1), occupied(3)
    assert one.field is None and observation_of(state).field is not None
    assert 0 < three.occupied.sum() < one.occupied.sum()
    assert not np.any(three.occupied & ~one.occupied)
