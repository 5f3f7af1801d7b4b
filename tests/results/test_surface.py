import json

import numpy as np
import pytest
import trimesh

from jaxshape.geometry.grid import GridFrame
from jaxshape.results.glb import Node, write_glb
from jaxshape.results.surface import read_ply, surface, voxel_surface, write_mesh

UNIT = GridFrame(np.zeros(3), np.ones(3))


def distance_from_centre(resolution=32):
    axis = np.arange(resolution) + 0.5 - resolution / 2
    return np.linalg.norm(np.stack(np.meshgrid(axis, axis, axis, indexing="ij")), axis=0)


def ball(radius):
    """Probability 0.5 exactly on the sphere, falling by 1 over four voxels."""
    return np.clip(0.5 + (radius - distance_from_centre()) / 4, 0, 1)


def test_sphere_is_where_it_should_be():
    mesh = surface(ball(10.0), UNIT)
    radius = np.linalg.norm(mesh.vertices - 16, axis=1)
    np.testing.assert_allclose(radius, 10, atol=0.03)
    assert mesh.is_watertight
    np.testing.assert_allclose(mesh.volume, 4 / 3 * np.pi * 10**3, rtol=0.01)


def test_normals_point_from_occupied_to_free_on_both_sheets_of_a_shell():
    probability = np.minimum(ball(13.0), 1 - ball(7.0))
    mesh = surface(probability, UNIT)
    outward = np.einsum("ij,ij->i", mesh.face_normals, mesh.triangles_center - 16)
    outer = np.linalg.norm(mesh.triangles_center - 16, axis=1) > 10
    assert (outward[outer] > 0).all() and (outward[~outer] < 0).all()
    assert len(mesh.split(only_watertight=True)) == 2
    np.testing.assert_allclose(mesh.volume, 4 / 3 * np.pi * (13**3 - 7**3), rtol=0.01)


@pytest.mark.parametrize("seed", range(10))
def test_any_boolean_grid_gives_a_closed_surface_of_positive_volume(seed):
    occupied = np.random.default_rng(seed).random((8, 9, 10)) < (seed + 1) / 11
    mesh = surface(occupied, UNIT)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume > 0


def test_a_full_grid_closes_at_its_border():
    mesh = surface(np.ones((4, 4, 4), bool), UNIT)
    assert mesh.is_watertight
    np.testing.assert_allclose(mesh.bounds, [[0, 0, 0], [4, 4, 4]], atol=1e-5)


def test_one_voxel_is_centred_on_its_centre():
    occupied = np.zeros((4, 5, 6), bool)
    occupied[1, 2, 4] = True
    mesh = voxel_surface(occupied)
    np.testing.assert_allclose(mesh.bounds.mean(axis=0), [1.5, 2.5, 4.5], atol=1e-5)
    np.testing.assert_allclose(mesh.extents, 1, atol=1e-5)


def test_frame_scales_each_axis_and_the_pose_moves_to_the_world():
    frame = GridFrame(np.array([1.0, 2.0, 3.0]), np.array([0.1, 0.2, 0.3]))
    T_world_object = np.eye(4)
    T_world_object[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    T_world_object[:3, 3] = [5, 6, 7]
    unit, placed = surface(ball(9.0), UNIT), surface(ball(9.0), frame)
    np.testing.assert_allclose(placed.vertices, unit.vertices * [0.1, 0.2, 0.3] + [1, 2, 3])
    world = surface(ball(9.0), frame, T_world_object=T_world_object)
    expected = np.stack(
        [5 - placed.vertices[:, 1], 6 + placed.vertices[:, 0], 7 + placed.vertices[:, 2]], axis=1
    )
    np.testing.assert_allclose(world.vertices, expected)
    np.testing.assert_allclose(world.volume, placed.volume)


def test_smoothing_brings_a_boolean_ball_closer_to_the_sphere_and_keeps_its_volume():
    occupied = distance_from_centre() < 10
    rough, smooth = (surface(occupied, UNIT, smoothing=rounds) for rounds in (0, 20))

    def roughness(mesh):
        return np.linalg.norm(mesh.vertices - 16, axis=1).std()

    assert roughness(smooth) < 0.6 * roughness(rough)
    np.testing.assert_allclose(smooth.volume, rough.volume, rtol=0.01)
    assert smooth.is_watertight


def test_smoothing_keeps_a_leg_one_voxel_thin():
    occupied = np.zeros((16, 16, 16), bool)
    occupied[8, 1:15, 8] = True
    mesh = surface(occupied, UNIT, smoothing=20)
    assert mesh.is_watertight and len(mesh.split()) == 1
    assert mesh.extents[1] > 13


@pytest.mark.parametrize(
    ("grid", "message"),
    [
        (np.zeros((4, 4, 4), bool), "No voxel"),
        (np.full((4, 4, 4), 0.5), "No voxel"),
        (np.full((4, 4, 4), np.nan), "not finite"),
    ],
)
def test_grids_without_a_surface_say_so(grid, message):
    with pytest.raises(ValueError, match=message):
        surface(grid, UNIT)


def test_level_must_be_a_probability():
    with pytest.raises(ValueError, match="between 0 and 1"):
        surface(ball(5.0), UNIT, level=0.0)


@pytest.mark.parametrize("suffix", [".ply", ".glb", ".obj", ".PLY"])
def test_written_meshes_read_back(tmp_path, suffix):
    mesh = surface(ball(10.0), GridFrame(np.zeros(3), np.full(3, 0.03)))
    path = tmp_path / "new folder" / f"chair{suffix}"
    write_mesh(mesh, path)
    again = trimesh.load_mesh(path, process=False)
    np.testing.assert_allclose(again.triangles, mesh.triangles, atol=1e-6)
    assert [file.name for file in path.parent.iterdir()] == [path.name]


def test_unknown_suffix_names_the_three(tmp_path):
    with pytest.raises(ValueError, match=r"\.ply, \.glb, \.obj.*\.stl"):
        write_mesh(surface(ball(5.0), UNIT), tmp_path / "chair.stl")


def test_a_failed_write_leaves_the_earlier_file(tmp_path, monkeypatch):
    path = tmp_path / "chair.ply"
    path.write_bytes(b"earlier")

    def fail(*_, **__):
        raise OSError("disk full")

    monkeypatch.setattr(trimesh.Trimesh, "export", fail)
    with pytest.raises(OSError, match="disk full"):
        write_mesh(trimesh.creation.box(), path)
    assert path.read_bytes() == b"earlier"
    assert list(tmp_path.iterdir()) == [path]


# ------------------------------------------------------------------ flags and colours


@pytest.fixture(scope="module")
def painted():
    """A ball whose upper half was measured and has colours, dark ones too."""
    mesh = surface(ball(10.0), GridFrame(np.array([1.0, 2, 3]), np.full(3, 0.03)))
    measured = mesh.vertices[:, 1] > mesh.centroid[1]
    color = np.random.default_rng(0).integers(0, 256, (len(mesh.vertices), 3), dtype=np.uint8)
    color[:256] = np.arange(256)[:, None]
    return mesh, measured, color


def test_ply_tells_what_was_measured_and_its_colours(tmp_path, painted):
    mesh, measured, color = painted
    sure = np.linspace(0, 1, len(measured), dtype=np.float32)
    write_mesh(mesh, tmp_path / "ball.ply", measured=measured, color=color, confidence=sure)
    found = read_ply(tmp_path / "ball.ply")
    np.testing.assert_array_equal(found.confidence, sure)
    np.testing.assert_allclose(found.mesh.vertices, mesh.vertices, atol=1e-6)
    np.testing.assert_array_equal(found.mesh.faces, mesh.faces)
    np.testing.assert_array_equal(found.measured, measured)
    np.testing.assert_array_equal(found.color, color)
    header = (tmp_path / "ball.ply").read_bytes().split(b"end_header")[0].decode()
    assert "property uchar measured" in header and "property uchar red" in header
    write_mesh(mesh, tmp_path / "ball.ply")
    plain = read_ply(tmp_path / "ball.ply")
    assert plain.measured is None and plain.color is None and plain.confidence is None


def content_of_glb(path):
    """The JSON of a GLB, and a reader of its accessors, by the letter of the standard."""
    data = path.read_bytes()
    assert data[:4] == b"glTF" and data[16:20] == b"JSON"
    length = int.from_bytes(data[12:16], "little")
    tree, binary = json.loads(data[20 : 20 + length]), data[28 + length :]
    parts = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}

    def read(number):
        accessor = tree["accessors"][number]
        view = tree["bufferViews"][accessor["bufferView"]]
        assert "byteStride" not in view
        kind = {5126: "<f4", 5125: "<u4"}[accessor["componentType"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        count = accessor["count"] * parts[accessor["type"]]
        return np.frombuffer(binary, kind, count, start).reshape(accessor["count"], -1)

    return tree, read


def test_glb_holds_flags_linear_colours_and_normals_and_no_turned_node(tmp_path, painted):
    """What three.js and Blender read: POSITION as given, +y up, below nodes that turn nothing."""
    mesh, measured, color = painted
    write_mesh(mesh, tmp_path / "ball.glb", measured=measured, color=color)
    tree, read = content_of_glb(tmp_path / "ball.glb")
    assert not any({"matrix", "rotation", "scale"} & set(node) for node in tree["nodes"])
    ((part,),) = (one["primitives"] for one in tree["meshes"])
    values = {name: read(number) for name, number in part["attributes"].items()}
    assert set(values) == {"POSITION", "NORMAL", "COLOR_0", "_MEASURED"}
    np.testing.assert_allclose(values["POSITION"], mesh.vertices, atol=1e-6)
    np.testing.assert_array_equal(read(part["indices"]).reshape(-1, 3), mesh.faces)
    outwards = ((values["POSITION"] - mesh.centroid) * values["NORMAL"]).sum(axis=1)
    assert (outwards > 0).all()
    np.testing.assert_array_equal(values["_MEASURED"][:, 0], measured)
    linear = values["COLOR_0"][:, :3].astype(float)
    again = np.where(linear > 0.0031308, 1.055 * linear ** (1 / 2.4) - 0.055, 12.92 * linear)
    np.testing.assert_allclose(255 * again, color, atol=0.01)
    assert tree["materials"][part["material"]]["pbrMetallicRoughness"]["metallicFactor"] == 0
    loaded = trimesh.load_mesh(tmp_path / "ball.glb", process=False)
    np.testing.assert_array_equal(loaded.vertex_attributes["_MEASURED"][:, 0], measured)


@pytest.mark.parametrize("damage", ["no faces", "not finite"])
def test_a_ply_of_no_surface_is_refused(tmp_path, damage):
    mesh = trimesh.creation.box()
    vertices = np.full_like(mesh.vertices, np.nan) if damage == "not finite" else mesh.vertices
    faces = mesh.faces[:0] if damage == "no faces" else mesh.faces
    trimesh.Trimesh(vertices, faces, process=False).export(tmp_path / "bad.ply")
    with pytest.raises(ValueError):
        read_ply(tmp_path / "bad.ply")


def test_a_glb_of_several_objects_has_a_node_for_each(tmp_path):
    T = np.eye(4)
    T[:3, 3] = 1, 2, 3
    boxes = [trimesh.creation.box((1, 1, 1)), trimesh.creation.box((2, 2, 2))]
    nodes = [
        Node("chair-1", boxes[0], T_world_object=T, extras={"class": "chair", "sure": 0.9}),
        Node("object-2", boxes[1]),
    ]
    write_glb(tmp_path / "scene.glb", nodes)
    read = trimesh.load_scene(tmp_path / "scene.glb")
    placed, name = read.graph["chair-1"]
    np.testing.assert_allclose(placed, T)
    np.testing.assert_allclose(read.geometry[name].extents, 1)
    np.testing.assert_allclose(read.geometry[read.graph["object-2"][1]].extents, 2)
    content = (tmp_path / "scene.glb").read_bytes()
    assert b'"sure":0.9' in content and b'"class":"chair"' in content
