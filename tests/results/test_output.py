"""The files of one reconstruction."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from made_result import T_WORLD_OBJECT, observation, reconstruction, solid

from jaxshape.geometry.distance import DistanceField
from jaxshape.geometry.grid import GridFrame
from jaxshape.geometry.overlap import iou
from jaxshape.results import output
from jaxshape.results.output import write_result
from jaxshape.results.surface import read_ply
from jaxshape.results.traces import read_trace

OCCUPIED, OCCLUDED = solid((4, 4, 4), (8, 28, 28)), solid((8, 4, 4), (28, 28, 28))
COMPLETED, FIRST = solid((4, 4, 4), (20, 28, 28)), solid((4, 4, 4), (12, 28, 28))
TRUTH = solid((4, 4, 4), (24, 28, 28))
FRAME = GridFrame(jnp.array([-0.32, -0.64, -0.32]), jnp.array([0.02, 0.04, 0.02]))
OBSERVATION = observation(OCCUPIED, OCCLUDED, TRUTH, FRAME)
RECONSTRUCTION = reconstruction(OBSERVATION, FIRST, COMPLETED, steps=5)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("out") / "made" / "on demand"
    return folder, write_result(folder, OBSERVATION, RECONSTRUCTION, {"seed": 4, "frames": 1})


def test_the_files_are_there_and_nothing_else(written):
    names = {path.name for path in written[0].iterdir()}
    files = {"mesh.glb", "mesh.ply", "grid.npz", "trace.npz", "result.json"}
    assert names == files


def test_the_result_holds_the_figures_and_the_scores(written):
    folder, result = written
    assert json.loads((folder / "result.json").read_text()) == result
    assert result["seed"] == 4 and result["frames"] == 1
    assert (result["objective_encoder"], result["objective_refined"]) == (0.5, 0.25)
    assert (result["voxels_measured"], result["voxels_occluded"]) == (4 * 24**2, 20 * 24**2)
    assert (result["iterations"], result["evaluations"], result["stop"]) == (3, 31, "tolx")
    assert result["iou_encoder"] == pytest.approx(8 / 20)
    assert result["iou_refined"] == pytest.approx(float(iou(COMPLETED, TRUTH))) == 16 / 20
    assert result["iou_composed"] == pytest.approx(16 / 20)


def test_the_grids_load_without_pickle_and_agree(written):
    with np.load(written[0] / "grid.npz", allow_pickle=False) as grids:
        np.testing.assert_array_equal(grids["occupied"], OCCUPIED)
        np.testing.assert_array_equal(grids["occluded"], OCCLUDED)
        np.testing.assert_array_equal(grids["encoder"], FIRST)
        np.testing.assert_array_equal(grids["refined"], grids["logits"] > 0)
        expected = np.where(OCCLUDED, grids["refined"], grids["occupied"])
        np.testing.assert_array_equal(grids["composed"], expected)
        np.testing.assert_array_equal(grids["truth"], TRUTH)
        np.testing.assert_array_equal(grids["code"], np.arange(10.0))
        np.testing.assert_array_equal(grids["T_world_object"], T_WORLD_OBJECT)
        np.testing.assert_array_equal(grids["voxel_size"], OBSERVATION.frame.voxel_size)
        np.testing.assert_array_equal(grids["origin"], OBSERVATION.frame.origin)


def test_the_trace_ends_where_the_search_did(written):
    trace = read_trace(written[0] / "trace.npz")
    np.testing.assert_array_equal(trace.evaluations, [11, 21, 31])
    np.testing.assert_array_equal(trace.best_loss, [5, 4, 3])


def test_the_encoder_alone_leaves_no_trace_of_an_earlier_search(tmp_path):
    (tmp_path / "trace.npz").write_bytes(b"earlier")
    alone = RECONSTRUCTION._replace(trace=None, iterations=None, stop=None)
    result = write_result(tmp_path, OBSERVATION, alone, {})
    assert (result["iterations"], result["evaluations"], result["stop"]) == (0, 1, None)
    assert not (tmp_path / "trace.npz").exists()


def test_the_mesh_is_closed_and_lies_in_the_world(written):
    mesh = trimesh.load_mesh(written[0] / "mesh.ply")
    assert mesh.is_watertight and mesh.volume > 0
    # Voxels 4 to 20, 28 and 28, in metres, carried to the world.
    corners = np.array([[4, 4, 4], [20, 28, 28]]) * [0.02, 0.04, 0.02] - [0.32, 0.64, 0.32]
    world = corners @ T_WORLD_OBJECT[:3, :3].T + T_WORLD_OBJECT[:3, 3]
    np.testing.assert_allclose(mesh.bounds, np.sort(world, axis=0), atol=0.03)
    np.testing.assert_allclose(mesh.volume, 16 * 24 * 24 * 0.02 * 0.04 * 0.02, rtol=0.1)


def test_the_glb_stands_upright_in_the_object_frame(written):
    """Whatever the world is: +y is up in GLB, and in the object frame."""
    mesh = trimesh.load_mesh(written[0] / "mesh.glb")
    low, high = np.array([[4, 4, 4], [20, 28, 28]]) * [0.02, 0.04, 0.02] - [0.32, 0.64, 0.32]
    np.testing.assert_allclose(mesh.bounds, [low, high], atol=0.03)


def test_a_measured_surface_is_told_apart_and_counted(tmp_path):
    """A wall measured half way through the box, before a decoded block, and a speck in the air."""
    frame = GridFrame(jnp.full(3, -0.32), jnp.full(3, 0.02))
    x = (np.arange(128) + 0.5) / 4 * 0.02 - 0.32
    ahead = np.broadcast_to(x[:, None, None], (128,) * 3)  # the wall looks along +x, at x = 0
    inside = np.abs(x[:, None]) < 0.2
    beside = (np.abs(ahead) < 0.01) & inside[None] & inside[:, 0]
    weight = np.where(beside, 5.0, 0.0)
    field = DistanceField(*map(jnp.float32, (weight * ahead, weight, np.where(ahead > 0.01, 5, 0))))
    block = solid((4, 6, 6), (16, 26, 26))
    speck = solid((2, 28, 28), (4, 30, 30))
    logits = np.where(block | speck, 6.0, -6.0).astype(np.float32)
    found = RECONSTRUCTION._replace(fill_logits=jnp.asarray(logits)[None])
    seen = OBSERVATION._replace(frame=frame, field=field, truth=None)
    result = write_result(tmp_path, seen, found, {})
    again = read_ply(tmp_path / "mesh.ply")
    mesh = again.mesh.apply_transform(np.linalg.inv(T_WORLD_OBJECT))
    assert np.abs(mesh.vertices[again.measured, 0]).max() < 0.004
    assert (mesh.vertices[~again.measured, 0] < 0.012).all()
    area = mesh.area_faces[again.measured[mesh.faces].all(axis=1)].sum()
    assert result["mesh_measured"] == pytest.approx(area / mesh.area, abs=0.03)
    assert area == pytest.approx(0.4**2, rel=0.15)
    assert result["mesh_pieces_dropped"] == 1 and again.color is None
    assert mesh.vertices[:, 1].max() < 0.23  # the speck is gone


def test_without_the_truth_no_iou_is_claimed(tmp_path):
    result = write_result(tmp_path, OBSERVATION._replace(truth=None), RECONSTRUCTION, {})
    assert not any(name.startswith("iou") for name in result)
    with np.load(tmp_path / "grid.npz") as grids:
        assert "truth" not in grids


def test_a_failure_leaves_the_earlier_result_and_no_debris(tmp_path, monkeypatch):
    (tmp_path / "result.json").write_text("earlier")

    def fail(*args, **settings):
        raise OSError("disk full")

    monkeypatch.setattr(output, "write_trace", fail)
    with pytest.raises(OSError, match="disk full"):
        write_result(tmp_path, OBSERVATION, RECONSTRUCTION, {})
    assert (tmp_path / "result.json").read_text() == "earlier"
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


def test_an_empty_shape_is_refused_before_anything_is_written(tmp_path):
    empty = RECONSTRUCTION._replace(composed=jnp.zeros((1, 32, 32, 32), bool))
    with pytest.raises(ValueError, match="no surface"):
        write_result(tmp_path / "new", OBSERVATION, empty, {})
    assert not (tmp_path / "new").exists()
