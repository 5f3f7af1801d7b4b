import os
import pickle
import re
import tracemalloc
import zipfile

import numpy as np
import pytest
import trimesh

from jaxshape.data import archives
from jaxshape.data.archives import passed_over
from jaxshape.data.meshes import (
    Model,
    Skipped,
    canonical,
    digest,
    in_metres,
    list_meshes,
    load,
    lying_on_its_side,
    read_meshes,
    sample_surface,
)

SIZE = (0.4, 0.9, 0.5)
OFF = trimesh.creation.box(SIZE).export(file_type="off")
OBJ = trimesh.creation.box(SIZE).export(file_type="obj")


def asymmetric():
    """Four corners: the origin and one on each axis, at 1 on x, 2 on y, 3 on z."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], float)
    return trimesh.Trimesh(vertices, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], process=False)


def one(path, **axes):
    (source,) = list_meshes(path)
    return load(source, **axes)


def archive(path, members):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in members.items():
            file.writestr(name, content)
    return path


# Formats


@pytest.mark.parametrize("suffix", ["obj", "off", "ply", "glb", "stl", "OBJ"])
def test_every_format_gives_the_same_centred_triangles(tmp_path, suffix):
    mesh = asymmetric()
    (tmp_path / f"part.{suffix}").write_bytes(_bytes(mesh.export(file_type=suffix.lower())))
    model = one(tmp_path / f"part.{suffix}")
    assert isinstance(model, Model) and model.name == "part"
    np.testing.assert_allclose(model.mesh.triangles, mesh.triangles - [0.5, 1, 1.5], atol=1e-6)


def _bytes(content):
    return content.encode() if isinstance(content, str) else content


def test_gltf_finds_its_buffer_beside_it_on_disk_and_in_an_archive(tmp_path):
    files = trimesh.Scene(asymmetric()).export(file_type="gltf")
    assert len(files) > 1  # the header and its buffers
    (tmp_path / "disk").mkdir()
    for name, content in files.items():
        (tmp_path / "disk" / name).write_bytes(content)
    archive(tmp_path / "all.zip", {f"kit/{name}": content for name, content in files.items()})
    for path in (tmp_path / "disk", tmp_path / "all.zip"):
        np.testing.assert_allclose(one(path).mesh.extents, [1, 2, 3], atol=1e-6)


def test_a_scene_is_flattened_with_its_transforms(tmp_path):
    scene = trimesh.Scene()
    seat = trimesh.creation.box((0.4, 0.1, 0.4))
    scene.add_geometry(seat, transform=trimesh.transformations.translation_matrix([0, 0.5, 0]))
    scene.add_geometry(seat, transform=trimesh.transformations.translation_matrix([0, 1.5, 0]))
    scene.export(tmp_path / "two.glb")
    model = one(tmp_path / "two.glb")
    assert len(model.mesh.faces) == 24
    np.testing.assert_allclose(model.mesh.extents, [0.4, 1.1, 0.4], atol=1e-6)


@pytest.mark.parametrize("header", ["OFF\n", "OFF", "OFF ", "# comment\nOFF\n"])
def test_modelnet_headers(tmp_path, header):
    (tmp_path / "chair_0001.off").write_text(header + OFF.removeprefix("OFF").lstrip())
    np.testing.assert_allclose(one(tmp_path).mesh.extents, SIZE)


# Trees and archives


@pytest.mark.parametrize(
    "member",
    [
        "03001627/1a6f615e8b1b5ae4dbbc9440457e303e/model.obj",
        "03001627/1a6f615e8b1b5ae4dbbc9440457e303e/models/model_normalized.obj",
        "chair/train/chair_0001.off",
    ],
)
def test_known_trees_are_named_by_their_paths_in_folders_and_zips(tmp_path, member):
    content = OFF if member.endswith("off") else OBJ
    file = tmp_path / "tree" / member
    file.parent.mkdir(parents=True)
    file.write_text(content)
    archive(tmp_path / "tree.zip", {member: content})
    name = member.rsplit(".", 1)[0]
    assert one(tmp_path / "tree").name == one(tmp_path / "tree.zip").name == name
    both = {source.name for source in list_meshes(tmp_path)}
    assert both == {f"tree/{member}", f"tree.zip/{member}"}


def test_listing_is_sorted_picklable_and_opens_nothing(tmp_path):
    for name in ("b.obj", "a.off", "c/a.ply", ".hidden.obj", "notes.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("not a mesh")
    sources = list_meshes(tmp_path)
    assert [source.name for source in sources] == ["a", "b", "c/a"]
    assert pickle.loads(pickle.dumps(sources)) == sources
    assert len(pickle.dumps(sources[0])) < 1000


def test_names_that_are_not_utf_8_can_be_written_and_their_files_be_read(tmp_path):
    (tmp_path / "sub").mkdir()
    place = os.fsencode(tmp_path / "sub")
    for name in (b"caf\xe9.obj", "caf\u00e9.obj".encode()):
        with open(os.path.join(place, name), "w") as file:
            file.write(OBJ)
    models = list(read_meshes(tmp_path))
    assert [model.name for model in models] == ["sub/caf\\xe9", "sub/caf\u00e9"]
    assert all(isinstance(model, Model) and model.name.encode() for model in models)


def test_a_folder_that_cannot_be_opened_is_reported(tmp_path, monkeypatch):
    for name in ("a.obj", "closed/b.obj"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(OBJ)

    def refusing(function):
        def refuse(path="."):
            if os.fspath(path).endswith("closed"):
                raise PermissionError(13, "Permission denied", os.fspath(path))
            return function(path)

        return refuse

    monkeypatch.setattr(os, "scandir", refusing(os.scandir))  # root may open any folder
    monkeypatch.setattr(os, "listdir", refusing(os.listdir))
    good, closed = read_meshes(tmp_path)
    assert isinstance(good, Model) and (closed.name, closed.reason) == ("closed", "unreadable")
    assert "Permission denied" in closed.detail


def test_what_is_passed_over_is_counted(tmp_path):
    for name in ("a.obj", "b.fbx", "c.FBX", "d.blend", "e.png", ".hidden.fbx"):
        (tmp_path / name).write_text("x")
    (tmp_path / "link").symlink_to(tmp_path)
    assert passed_over(tmp_path) == {".fbx": 2, ".blend": 1, "linked folders": 1}
    assert not passed_over(tmp_path / "a.obj")


def test_what_archives_hold_beside_meshes_is_counted_too(tmp_path):
    names = ("a.obj", "b.FBX", "c/d.fbx", "e.zip", "f.png", "__MACOSX/._g.fbx", "h.fbx/")
    path = archive(tmp_path / "kit.zip", dict.fromkeys(names, OBJ))
    (tmp_path / "broken.zip").write_text("no archive")
    assert passed_over(path) == passed_over(tmp_path) == {".fbx": 2, "archives inside archives": 1}


def test_equal_names_keep_their_suffix(tmp_path):
    for name in ("a.obj", "a.ply", "b.obj"):
        (tmp_path / name).write_text(OBJ)
    assert [source.name for source in list_meshes(tmp_path)] == ["a.obj", "a.ply", "b"]


CATALOGUE = """
# A comment
license=CC-BY \\
    3.0
name#1=Oak \\u00e9 chair
creator#1=Somebody
model#1=/oak/oak.obj
modelRotation#1=0 0 1 0 1 0 -1 0 0
width#1=300
height#1=400
depth#1=100
name#2=Plain
model#2=/plain.obj
"""


def test_a_furniture_catalogue_turns_scales_and_credits(tmp_path):
    obj = asymmetric().export(file_type="obj")
    members = {"PluginFurnitureCatalog.properties": CATALOGUE, "oak/oak.obj": obj}
    path = archive(tmp_path / "kit.sh3f", members | {"plain.obj": obj, "oak/icon.png": "x"})
    oak, plain = read_meshes(path)
    assert (oak.name, plain.name) == ("oak/oak", "plain")
    assert oak.metadata["name"] == "Oak é chair" and oak.metadata["creator"] == "Somebody"
    assert oak.metadata["license"] == plain.metadata["license"] == "CC-BY 3.0"
    np.testing.assert_allclose(plain.mesh.extents, [1, 2, 3])
    # the rotation takes x to -z and z to x; 3 x 2 x 1 is then stretched to 3 x 4 x 1 metres
    np.testing.assert_allclose(oak.mesh.extents, [3, 4, 1])
    np.testing.assert_allclose(
        oak.mesh.vertices, [[-1.5, -2, 0.5], [-1.5, -2, -0.5], [-1.5, 2, 0.5], [1.5, -2, 0.5]]
    )


@pytest.mark.parametrize(
    "line",
    [
        "width#1=0",
        "depth#1=NaN",
        "height#1=-4",
        "height#1=inf",
        "modelRotation#1=0 0 0 0 1 0 0 0 1",
    ],
)
def test_a_size_of_a_catalogue_that_nothing_has_is_refused(tmp_path, line):
    obj = asymmetric().export(file_type="obj")
    properties = CATALOGUE + line + "\n"  # the last line of a name counts
    members = {"PluginFurnitureCatalog.properties": properties, "oak/oak.obj": obj}
    skipped = one(archive(tmp_path / "kit.sh3f", members))
    assert skipped.reason == "flat"
    assert skipped.detail.startswith("By its catalogue, the mesh measures")


# Axes


def test_axes_are_turned_to_up_y_and_front_z():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], float)
    for up, front, expected in [
        ("y", "z", [(1, 0, 0), (0, 2, 0), (0, 0, 3)]),
        ("z", "-y", [(1, 0, 0), (0, 0, -2), (0, 3, 0)]),  # Blender, ModelNet
        ("y", "-z", [(-1, 0, 0), (0, 2, 0), (0, 0, -3)]),
        ("x", "z", [(0, 1, 0), (-2, 0, 0), (0, 0, 3)]),
    ]:
        mesh = canonical(trimesh.Trimesh(vertices, [[1, 2, 3], [0, 1, 2]], process=False),
                         up=up, front=front)  # fmt: skip
        np.testing.assert_allclose(mesh.vertices[1:] - mesh.vertices[0], expected, atol=1e-12)


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
@pytest.mark.parametrize("front", ["x", "y", "z", "-x", "-y", "-z"])
def test_turning_is_a_rotation_that_centres_or_an_error(up, front):
    mesh = asymmetric()
    if up[-1] == front[-1]:
        with pytest.raises(ValueError, match="perpendicular"):
            canonical(mesh, up=up, front=front)
        return
    turned = canonical(mesh, up=up, front=front)
    np.testing.assert_allclose(turned.volume, mesh.volume)  # not mirrored, not scaled
    np.testing.assert_allclose(turned.bounds.sum(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(turned.extents[1], mesh.extents["xyz".index(up[-1])])


def test_an_axis_that_is_none_is_an_error(tmp_path):
    (tmp_path / "a.obj").write_text(OBJ)
    with pytest.raises(ValueError, match="up is 'up'; give 'x' or"):
        canonical(asymmetric(), up="up")
    with pytest.raises(ValueError, match="perpendicular"):
        read_meshes(tmp_path, up="z")


# What is broken


def stl(triangles):
    return trimesh.Trimesh(**trimesh.triangles.to_kwargs(triangles)).export(file_type="stl")


PLATE = "OFF\n4 2 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n3 0 2 3\n"


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("a.obj", "", "empty"),
        ("a.obj", "\n\n", "empty"),
        ("a.obj", "# only words\n", None),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 1\n", None),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 1\nf 1 2 9\n", "unreadable"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 1\nf 1 1 2\n", "no faces"),
        ("a.off", "OFF\n3 1 0\nnan nan nan\n1 0 0\n0 1 1\n3 0 1 2\n", "not finite"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1e200 0 0\n0 1e200 1\n3 0 1 2\n", "not finite"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 1\n3 0 1 5\n", "unreadable"),
        ("a.off", "OFF\n900000000 9 0\n0 0 0\n", "unreadable"),
        ("a.off", OFF[: len(OFF) // 3], "unreadable"),
        ("a.off", "FOO\n1 2 3\n", "unreadable"),
        ("a.off", PLATE, "flat"),
        ("a.ply", trimesh.creation.box().export(file_type="ply")[:300], "unreadable"),
        ("a.ply", b"\x89PNG\r\n", "unreadable"),
        ("a.glb", trimesh.creation.box().export(file_type="glb")[:500], "unreadable"),
        ("a.glb", b"glTF" + bytes(40), "unreadable"),
        ("a.gltf", '{"asset": {"version": "2.0"}}', None),
        # Without a library that guesses encodings this is no text either; with one, empty text.
        ("a.stl", trimesh.creation.box().export(file_type="stl")[:300], None),
        ("a.zip", b"PK\x03\x04 and then junk", "unreadable"),
        ("a.sh3f", b"", "unreadable"),
    ],
)
def test_broken_files_are_skipped_with_a_reason(tmp_path, name, content, reason):
    (tmp_path / name).write_bytes(_bytes(content))
    skipped = one(tmp_path)
    assert isinstance(skipped, Skipped)
    assert skipped.reason == reason or reason is None
    assert skipped.reason in {"unreadable", "empty", "no faces", "not finite", "flat"}
    assert skipped.name == "a" and skipped.detail


def test_faces_with_a_vertex_that_is_not_a_number_are_dropped_alone(tmp_path):
    lines = OFF.rstrip().splitlines()
    lines[1] = "9 13 0"
    lines.insert(2 + 8, "nan nan nan")
    lines.append("3 0 1 8")
    (tmp_path / "a.off").write_text("\n".join(lines))
    model = one(tmp_path)
    assert len(model.mesh.faces) == 12
    np.testing.assert_allclose(model.mesh.extents, SIZE)


def test_one_broken_mesh_does_not_stop_the_others(tmp_path):
    path = archive(tmp_path / "a.zip", {"a.obj": OBJ, "b.obj": "junk", "c.obj": OBJ, "d.txt": "x"})
    with zipfile.ZipFile(path) as file:
        position = file.getinfo("c.obj").header_offset + 60
    content = bytearray(path.read_bytes())
    content[position : position + 20] = bytes(20)  # the member no longer inflates to its checksum
    path.write_bytes(content)
    kinds = [type(result) for result in read_meshes(path)]
    assert kinds == [Model, Skipped, Skipped]


def test_names_from_archives_stay_below_the_folder_they_are_joined_to(tmp_path):
    names = ["../../evil.obj", "/etc/evil.obj", "c:\\evil.obj", "../evil.obj"]
    path = archive(tmp_path / "a.zip", dict.fromkeys(names, OBJ))
    models = list(read_meshes(path))
    assert len({model.name for model in models}) == len(models) == 4
    for model in models:
        assert isinstance(model, Model)
        target = (tmp_path / "out" / model.name).resolve()
        assert target.is_relative_to(tmp_path / "out")
    assert list(tmp_path.iterdir()) == [path]  # nothing was unpacked


def test_a_mesh_cannot_refer_to_files_outside_its_folder(tmp_path):
    files = trimesh.Scene(asymmetric()).export(file_type="gltf")
    (tmp_path / "inside").mkdir()
    header = files.pop("model.gltf")
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
        header = header.replace(f'"{name}"'.encode(), f'"../{name}"'.encode())
    (tmp_path / "inside" / "model.gltf").write_bytes(header)
    skipped = one(tmp_path / "inside")
    assert skipped.reason == "unreadable" and "outside its own folder" in skipped.detail
    assert skipped.detail.startswith("The mesh refers to")


@pytest.mark.parametrize("is_packed", [False, True])
def test_a_buffer_that_is_missing_is_named(tmp_path, is_packed):
    header = trimesh.Scene(asymmetric()).export(file_type="gltf")["model.gltf"]
    if is_packed:
        archive(tmp_path / "a.zip", {"inside/model.gltf": header})
    else:
        (tmp_path / "model.gltf").write_bytes(header)
    skipped = one(tmp_path)
    assert skipped.reason == "unreadable"
    assert re.fullmatch(r"There is no file '[^']*\.bin' (next to|in) the \w+\.", skipped.detail)


def test_members_that_inflate_too_far_are_too_large(tmp_path, monkeypatch):
    monkeypatch.setattr(archives, "MAX_BYTES", 100_000)
    bomb = archive(tmp_path / "bomb.zip", {"a.obj": "\n" * 10_000_000, "b.obj": OBJ})
    assert bomb.stat().st_size < 100_000
    large, good = read_meshes(bomb)
    assert large.reason == "too large" and isinstance(good, Model)
    (tmp_path / "c.obj").write_bytes(bytes(200_000))
    assert one(tmp_path / "c.obj").reason == "too large"


def test_nothing_to_read_says_what_was_looked_for(tmp_path):
    with pytest.raises(FileNotFoundError, match="no file or folder .*nowhere"):
        list_meshes(tmp_path / "nowhere")
    with pytest.raises(ValueError, match=r"no mesh: looked for .*\.obj"):
        list_meshes(tmp_path)
    (tmp_path / "a.blend").write_text("x")
    with pytest.raises(ValueError, match="no mesh"):
        list_meshes(tmp_path / "a.blend")


# What is not the object


def test_colliders_shadows_and_the_ground_are_left_out_and_named(tmp_path):
    chair, wide = trimesh.creation.box(SIZE), trimesh.creation.box((3, 3, 3))
    plane = trimesh.Trimesh([[-1, -0.45, -1], [1, -0.45, -1], [1, -0.45, 1], [-1, -0.45, 1]],
                            [[0, 2, 1], [0, 3, 2]], process=False)  # fmt: skip
    for name in ("chair_collider", "UCX_chair_01", "chair-colonly", "ContactShadow", "floor.001"):
        scene = trimesh.Scene({"seat": chair, name: wide})
        scene.export(tmp_path / "a.glb")
        model = one(tmp_path / "a.glb")
        np.testing.assert_allclose(model.mesh.extents, SIZE, atol=1e-6)
        assert len(model.notes) == 1 and name in model.notes[0]
    trimesh.Scene({"seat": chair, "Plane": plane}).export(tmp_path / "a.glb")
    np.testing.assert_allclose(one(tmp_path / "a.glb").mesh.extents, SIZE, atol=1e-6)
    lamp = trimesh.Scene({"seat": chair, "floor_lamp": wide})
    lamp.export(tmp_path / "a.glb")
    np.testing.assert_allclose(one(tmp_path / "a.glb").mesh.extents, [3, 3, 3], atol=1e-6)


def test_memory_does_not_grow_with_the_number_of_parts(tmp_path, monkeypatch):
    """SketchUp exports thousands of groups, which share one list of vertices."""
    block = "g part{0}\nv {0} 0 0\nv {0} 1 0\nv {0} 0 1\nf -3 -2 -1\n"
    (tmp_path / "a.obj").write_text("".join(map(block.format, range(3000))))
    monkeypatch.setattr(archives, "MAX_BYTES", 10**6)  # reserved for the content of a file
    tracemalloc.start()
    model = one(tmp_path / "a.obj")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(model.mesh.faces) == 3000 and peak < 50e6


def test_a_file_of_nothing_but_a_collider_is_kept(tmp_path):
    trimesh.Scene({"collider": trimesh.creation.box(SIZE)}).export(tmp_path / "a.glb")
    assert one(tmp_path / "a.glb").notes == ()


def test_a_unit_scales_what_has_no_size_of_a_catalogue(tmp_path):
    (tmp_path / "a.obj").write_text(OBJ)
    for unit, scale in (("cm", 0.01), ("mm", 0.001), ("inch", 0.0254)):
        np.testing.assert_allclose(one(tmp_path, unit=unit).mesh.extents, scale * np.array(SIZE))


# Content


def test_a_digest_knows_the_content_and_not_the_name(tmp_path):
    for folder, name in (("one", "a"), ("two", "b")):
        for file, content in trimesh.Scene(asymmetric()).export(file_type="gltf").items():
            (tmp_path / folder).mkdir(exist_ok=True)
            (tmp_path / folder / file.replace("model", name)).write_bytes(content)
    ((one_,), (two,)) = (list_meshes(tmp_path / folder) for folder in ("one", "two"))
    assert digest(one_) == digest(two) == load(two).digest and len(digest(one_)) == 64
    buffer = min((tmp_path / "two").glob("*.bin"))
    buffer.write_bytes(buffer.read_bytes()[:-1] + b"\x01")
    assert digest(one_) != digest(two)


@pytest.mark.parametrize("kind", ["blank", "glb", "encoded"])
def test_a_digest_knows_every_buffer(tmp_path, kind):
    files = trimesh.Scene(asymmetric()).export(file_type="gltf")
    header = b" " * (kind == "blank") + files.pop("model.gltf")
    for name, content in files.items():
        uri = name.replace("_", "%20")
        header = header.replace(name.encode(), uri.encode())
        (tmp_path / (uri if kind == "encoded" else uri.replace("%20", " "))).write_bytes(content)
    if kind == "glb":
        header += b" " * (-len(header) % 4)
        sizes = np.array([2, 20 + len(header), len(header)], "<u4").tobytes()
        header = b"glTF" + sizes + b"JSON" + header
    (tmp_path / f"model.{'glb' if kind == 'glb' else 'gltf'}").write_bytes(header)
    (source,) = list_meshes(tmp_path)
    assert isinstance(load(source), Model)
    before, buffer = digest(source), min(tmp_path.glob("*.bin"))
    buffer.write_bytes(buffer.read_bytes() + b"more")
    assert digest(source) != before


# Sampling


def test_samples_lie_on_the_surface_in_proportion_to_area():
    mesh = trimesh.creation.box((1, 2, 3))
    points = sample_surface(mesh, 6000, seed=0)
    on_face = np.isclose(np.abs(points), mesh.extents / 2)
    assert points.shape == (6000, 3) and (on_face.sum(axis=1) == 1).all()
    np.testing.assert_allclose(on_face.sum(axis=0) / 6000 * 22, [12, 6, 4], atol=0.02)
    inside = points[on_face[:, 0], 1]  # uniform over a face: mean 0, variance of a 2 m interval
    assert abs(inside.mean()) < 0.03 and abs(inside.var() - 1 / 3) < 0.02


def test_samples_depend_on_the_seed_alone():
    mesh = trimesh.creation.icosphere()
    np.testing.assert_array_equal(sample_surface(mesh, 100, 3), sample_surface(mesh, 100, 3))
    assert not np.array_equal(sample_surface(mesh, 100, 3), sample_surface(mesh, 100, 4))


def test_a_wire_with_two_points_worth_of_area_is_always_hit():
    plate = trimesh.creation.box((1, 0.01, 1))
    wire = trimesh.creation.box((0.001, 0.3, 0.001)).apply_translation([0, 1, 0])
    both = trimesh.util.concatenate([plate, wire])
    count = int(np.ceil(2 * both.area / wire.area))
    for seed in range(10):
        assert (sample_surface(both, count, seed)[:, 1] > 0.5).any()


# Orientation


def box_chair():
    def part(size, at):
        return trimesh.creation.box(size).apply_translation(at)

    legs = [part((0.04, 0.45, 0.04), (x, 0.225, z)) for x in (-0.2, 0.2) for z in (-0.2, 0.2)]
    seat, back = part((0.44, 0.04, 0.44), (0, 0.47, 0)), part((0.44, 0.45, 0.03), (0, 0.72, -0.2))
    return canonical(trimesh.util.concatenate([*legs, seat, back]))


@pytest.mark.parametrize("front", ["z", "-z", "x", "-x"])
def test_a_standing_chair_is_left_alone_whichever_way_it_looks(front):
    assert not lying_on_its_side(canonical(box_chair(), front=front))


@pytest.mark.parametrize("up", ["-y", "x", "-x", "z", "-z"])
@pytest.mark.parametrize("front", ["x", "y", "z"])
def test_a_chair_with_a_wrong_up_axis_is_noticed(up, front):
    if up[-1] != front:
        assert lying_on_its_side(canonical(box_chair(), up=up, front=front))


@pytest.mark.parametrize("mesh", [trimesh.creation.box((1, 1, 1)), trimesh.creation.icosphere()])
def test_shapes_without_a_clear_up_are_left_alone(mesh):
    assert not lying_on_its_side(mesh)


def test_sizes_that_nothing_in_a_room_has_are_not_taken_for_metres():
    chair = trimesh.creation.box(SIZE)
    assert in_metres(chair) is chair
    for scale in (1e-3, 39.4, 1000):
        other = in_metres(chair.copy().apply_scale(scale))
        assert other.scale == pytest.approx(1)
        np.testing.assert_allclose(other.vertices * chair.scale, chair.vertices, atol=1e-9)
