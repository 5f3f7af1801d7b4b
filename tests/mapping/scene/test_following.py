"""A room with a chair and a table, each known by a prior of its own."""

import jax
import numpy as np
import pytest
import trimesh
from analytic_room import CHAIR, CRATE, FLOOR, TABLE, WALLS, K, room
from known_shape import known_shape
from PIL import Image

from jaxshape.data.boxes import Box
from jaxshape.data.sequences import open_sequence
from jaxshape.mapping.config import MappingConfig, TrackingConfig
from jaxshape.mapping.map.mapper import build_mapper
from jaxshape.mapping.map.recording import Followed, advance, follow
from jaxshape.mapping.placement.finding import find_start
from jaxshape.mapping.placement.placing import PlacementConfig
from jaxshape.mapping.scene.classes import build_classes
from jaxshape.mapping.scene.following import finish_scene, follow_scene
from jaxshape.mapping.segmentation.segment import Prompt
from jaxshape.results.folder import object_boxes, read_folder
from jaxshape.results.scene_files import write_scene, write_scene_progress
from jaxshape.results.summary import objects_in_words
from jaxshape.search.config import RefineConfig

MAPPING = MappingConfig(fusion="points", min_hits=1)
AZIMUTHS = (-50, -25, 0, 25, 50)


def mesh_of(group):
    """The boxes of a group, about the middle of the box around them, and that middle."""
    boxes = [trimesh.creation.box(bounds=np.array(one, float)) for one in group]
    mesh = trimesh.util.concatenate(boxes)
    middle = mesh.bounds.mean(axis=0)
    return mesh.apply_translation(-middle), middle


@pytest.fixture(scope="module")
def priors():
    meshes = {"chair": mesh_of(CHAIR)[0], "table": mesh_of(TABLE)[0]}
    return {name: known_shape(mesh, mesh.extents) for name, mesh in meshes.items()}


def record(folder, *shown):
    """Film a room of groups of boxes; each view has groups of its own."""
    folder.mkdir()
    for i, (azimuth, groups) in enumerate(zip(AZIMUTHS, shown, strict=True)):
        angle = np.deg2rad(azimuth)
        eye = 2.6 * np.sin(angle), 1.7, 2.6 * np.cos(angle)
        one = room([FLOOR, WALLS, *groups], eye, (0.2, 0.4, 0), seed=i)
        depth = np.where(np.isfinite(one.depth), np.rint(1000 * one.depth), 0)
        Image.fromarray(depth.astype(np.uint16)).save(folder / f"frame-{i:06d}.depth.png")
        np.savetxt(folder / f"frame-{i:06d}.pose.txt", one.T_world_camera)
    np.savetxt(folder / "camera-intrinsics.txt", K)
    return open_sequence(folder)


@pytest.fixture(scope="module")
def classes(priors, compile_quickly):
    """With a short search of the boxes: the cells tell where they are."""
    found = build_classes(priors, mapping=MAPPING)
    short = PlacementConfig(yaws=4, overhangs=(0.0,), kept=1, steps=2, steps_again=2)
    return found._replace(known=tuple(one._replace(sizes=short) for one in found.known))


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    return record(tmp_path_factory.mktemp("room") / "a", *[(CHAIR, TABLE, CRATE)] * 5)


@pytest.fixture(scope="module")
def followed(sequence, classes):
    """The room after its last frame, before it is decided what its objects are."""
    *_, last = follow_scene(sequence, classes, use_poses=True)
    return last


@pytest.fixture(scope="module")
def scene(followed, classes):
    return finish_scene(followed, classes)


def test_each_object_is_of_its_class_and_the_crate_of_none(scene):
    names = {one.name.split("-")[0] for one in scene.objects}
    assert len(scene.objects) == 3 and names == {"chair", "table", "object"}


def test_boxes_are_where_the_objects_are(scene):
    for name, group in (("chair", CHAIR), ("table", TABLE), ("object", CRATE)):
        mesh, middle = mesh_of(group)
        (box,) = [one.progress.start.box for one in scene.objects if one.name.startswith(name)]
        assert np.abs(box.T_world_object[:3, 3] - middle).max() < 0.06
        R = np.abs(box.T_world_object[:3, :3])
        assert np.abs(R @ box.size - mesh.extents).max() < 0.25
        if name == "chair":  # its back is on the far side
            assert box.T_world_object[2, 2] > 0.95


def test_nothing_is_added_to_the_crate(scene):
    (crate,) = [one for one in scene.objects if one.name.startswith("object")]
    shape = crate.progress.shape
    assert not shape.completed.any() and shape.composed.any()


def test_a_room_can_be_watched_while_it_is_followed(followed, sequence, tmp_path):
    write_scene_progress(tmp_path, sequence, followed, {"object": "a room"})
    found = read_folder(tmp_path)
    assert found.result["running"] and not found.problems
    assert [one.name for one in object_boxes(found)] == ["object-1", "object-2", "object-3"]
    assert np.isclose(found.T_object_world[1], [0, 1, 0, -0.4], atol=0.2).all()  # it stands upright
    (x, _, z), (X, Y, Z) = found.mesh.bounds
    for group in (CHAIR, TABLE, CRATE):  # something of each is in the mesh
        middle = mesh_of(group)[1]
        assert x - 0.1 < middle[0] < X + 0.1 and z - 0.1 < middle[2] < Z + 0.1 and Y < 1.3
    assert all("not decided yet" in line for line in objects_in_words(found.result))


def test_a_finished_room_is_written_with_its_classes(scene, sequence, tmp_path):
    write_scene_progress(tmp_path, sequence, scene, {})
    write_scene(tmp_path, sequence, scene, {"object": "a room"})
    found = read_folder(tmp_path)
    assert "running" not in found.result and not found.problems
    kinds = {one["name"]: one["class"] for one in found.result["objects"]}
    assert sorted(map(str, kinds.values())) == ["None", "chair", "table"]
    assert {path.name for path in (tmp_path / "objects").iterdir()} == set(kinds)
    (chair,) = [one for one in object_boxes(found) if one.name.startswith("chair")]
    own = trimesh.load(tmp_path / "objects" / chair.name / "mesh.glb", force="mesh")
    assert (np.abs(own.vertices) <= chair.size / 2 + 0.02).all()
    lines = list(objects_in_words(found.result))
    assert any(line.startswith(f"{chair.name}: chair (") and " m, " in line for line in lines)


def test_an_object_that_is_moved_is_left_out(tmp_path, classes):
    shown = [(CHAIR, CRATE)] * 2 + [(CHAIR,)] * 3
    *_, scene = follow_scene(record(tmp_path / "moved", *shown), classes, use_poses=True)
    assert len(scene.objects) == 1
    assert any("moved" in event for event in scene.tracks.events)


def test_an_empty_room_is_followed_to_its_end(tmp_path, classes):
    *_, scene = follow_scene(record(tmp_path / "empty", *[()] * 5), classes, use_poses=True)
    assert finish_scene(scene, classes).objects == () and len(scene.logs) == 5


@pytest.mark.slow
@pytest.mark.parametrize("use_poses", [True, False])
def test_a_map_among_others_is_the_map_of_one_object_alone(sequence, priors, use_poses):
    """`follow`, of one object, against the same object beside another one."""
    mappers, starts = [], []
    for name, group in (("chair", CHAIR), ("table", TABLE)):
        mesh, middle = mesh_of(group)
        T = np.eye(4)
        T[:3, 3] = middle
        prior, search = priors[name], RefineConfig()
        mappers.append(build_mapper(prior, None, search, MAPPING, TrackingConfig()))
        box = Box(T, np.asarray(mesh.extents, float))
        starts.append(find_start(sequence, prior, Prompt(), box=box))
    alone, other = (
        list(follow(sequence, start, mapper, priors["chair"], use_poses=True))
        for start, mapper in zip(starts, mappers, strict=True)
    )
    both = [alone[0], other[0]]
    for index in range(1, len(sequence)):
        followed = [Followed(one, m.parts) for one, m in zip(both, mappers, strict=True)]
        both = advance(sequence, index, followed, use_poses, lambda *_: None)
    if use_poses:
        jax.tree.map(np.testing.assert_array_equal, both[0].state.code, alone[-1].state.code)
        jax.tree.map(
            np.testing.assert_array_equal, both[0].state.measurement, alone[-1].state.measurement
        )
        return
    # Tracked, both maps have one camera, near the true one.
    for one, two in zip(*(progress.state.keyframes for progress in both), strict=True):
        np.testing.assert_array_equal(one.T_world_camera.wxyz_xyz, two.T_world_camera.wxyz_xyz)
    true = sequence[len(sequence) - 1].T_world_camera
    found = np.asarray(both[0].state.T_world_camera.as_matrix())
    assert both[0].logs[-1].status != "lost"
    assert np.abs(found[:3, 3] - true[:3, 3]).max() < 0.03
