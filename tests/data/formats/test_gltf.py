"""What changes shapes in a glTF is read as the specification says, or refused by name."""

import json
import sys
import time
from contextlib import suppress

import numpy as np
import pytest
from changed_json import changed
from made_gltf import CORNERS, FACES, Gltf, triangles

from jaxshape.data.formats.gltf import read_gltf
from jaxshape.data.formats.parts import NotSupported, Part, TooManyFaces, Unreadable

WHOLE = triangles([Part("", CORNERS, FACES)])


def read(file, **files):
    return read_gltf(file.content(), lambda name: files[name])


def one(primitive, gltf, **node):
    gltf.header |= {"meshes": [{"primitives": [primitive]}], "nodes": [{"mesh": 0, **node}]}
    return gltf


@pytest.mark.parametrize(
    ("mode", "corners"), [(4, FACES.ravel()), (5, [0, 1, 2, 3]), (6, [0, 1, 2, 3])]
)
def test_triangles_strips_and_fans_are_whole(mode, corners):
    gltf = Gltf()
    primitive = gltf.tetrahedron(mode=mode, indices=gltf.array(np.array(corners, np.uint16)))
    parts = read(one(primitive, gltf))
    if mode == 4:
        np.testing.assert_array_equal(triangles(parts), WHOLE)
    strip, fan = [[0, 1, 2], [1, 3, 2]], [[1, 2, 0], [2, 3, 0]]
    if mode > 4:
        np.testing.assert_array_equal(parts[0].faces, strip if mode == 5 else fan)


def test_sparse_accessors_replace_entries():
    gltf = Gltf()
    moved = CORNERS.copy()
    moved[1], moved[3] = 0, 9
    rows, values = (
        gltf.view(np.array([1, 3], np.uint8).tobytes()),
        gltf.view(CORNERS[[1, 3]].tobytes()),
    )
    sparse = {
        "count": 2,
        "indices": {"bufferView": rows, "componentType": 5121},
        "values": {"bufferView": values},
    }
    primitive = gltf.tetrahedron()
    primitive["attributes"]["POSITION"] = gltf.array(moved, sparse=sparse)
    np.testing.assert_array_equal(triangles(read(one(primitive, gltf))), WHOLE)


@pytest.mark.parametrize("kind", [np.int8, np.int16, np.uint16])
def test_normalized_integers_are_fractions(kind):
    gltf = Gltf(extensionsRequired=["KHR_mesh_quantization"])
    whole = np.rint(CORNERS / 3 * np.iinfo(kind).max).astype(kind)
    primitive = gltf.tetrahedron(attributes={"POSITION": gltf.array(whole, normalized=True)})
    (part,) = read(one(primitive, gltf, scale=[3, 3, 3]))
    np.testing.assert_allclose(part.vertices, CORNERS, atol=2 / np.iinfo(kind).max)


def test_interleaved_vertices_are_read_by_their_stride():
    gltf = Gltf()
    both = np.concatenate([CORNERS, np.full((4, 3), 7, np.float32)], axis=1)
    view = gltf.view(both.tobytes())
    gltf.header["bufferViews"][view]["byteStride"] = 24
    primitive = gltf.tetrahedron()
    position = gltf.header["accessors"][primitive["attributes"]["POSITION"]]
    position["bufferView"] = view
    np.testing.assert_array_equal(triangles(read(one(primitive, gltf))), WHOLE)


def test_instances_stand_where_the_extension_puts_them():
    gltf = Gltf(extensionsRequired=["EXT_mesh_gpu_instancing"])
    places = np.array([[0, 0, 0], [5, 0, 0], [0, 5, 0]], np.float32)
    about = {"attributes": {"TRANSLATION": gltf.array(places)}}
    node = {"extensions": {"EXT_mesh_gpu_instancing": about}, "scale": [2, 2, 2]}
    parts = read(one(gltf.tetrahedron(), gltf, **node))
    expected = [Part("", 2 * (CORNERS + place), FACES) for place in places]
    np.testing.assert_array_equal(triangles(parts), triangles(expected))


def test_hundreds_of_thousands_of_instances_are_read_at_once():
    """A few hundred bytes can state them."""
    gltf = Gltf()
    about = {"attributes": {"TRANSLATION": gltf.origins(300_000)}}
    node = {"extensions": {"EXT_mesh_gpu_instancing": about}, "scale": [-1, 1, 1]}
    start = time.process_time()
    (part,) = read(one(gltf.tetrahedron(), gltf, **node))
    assert time.process_time() - start < 2
    assert part.vertices.shape == part.faces.shape == (1_200_000, 3)
    last = Part("", part.vertices[-4:] * [-1, 1, 1], part.faces[-4:, ::-1] - 1_199_996)
    np.testing.assert_array_equal(triangles([last]), WHOLE)


def test_attributes_of_instances_have_one_length():
    gltf = Gltf()
    attributes = {"TRANSLATION": gltf.array(CORNERS), "SCALE": gltf.array(CORNERS[:3])}
    node = {"extensions": {"EXT_mesh_gpu_instancing": {"attributes": attributes}}}
    with pytest.raises(Unreadable, match="instances of a mesh do not fit"):
        read(one(gltf.tetrahedron(), gltf, **node))


def test_too_many_instances_are_refused_before_they_are_made():
    gltf = Gltf()
    about = {"attributes": {"TRANSLATION": gltf.array(np.zeros((5000, 3), np.float32))}}
    node = {"extensions": {"EXT_mesh_gpu_instancing": about}}
    many = gltf.array(np.zeros(15_000, np.uint16))
    with pytest.raises(TooManyFaces, match="25000000 faces"):
        read(one(gltf.tetrahedron(indices=many), gltf, **node))


def test_instances_without_a_face_are_passed_over():
    """A few bytes can state millions of them."""
    gltf = Gltf()
    about = {"attributes": {"TRANSLATION": gltf.origins(40_000_000)}}
    node = {"extensions": {"EXT_mesh_gpu_instancing": about}}
    none = gltf.array(FACES.ravel(), count=0)
    assert read(one(gltf.tetrahedron(indices=none), gltf, **node)) == []


def test_parts_hold_the_vertices_of_their_faces_only():
    """Many exporters give all primitives one list of vertices."""
    gltf = Gltf()
    corners = np.concatenate([CORNERS + 9, CORNERS])
    primitive = gltf.tetrahedron(
        attributes={"POSITION": gltf.array(corners)}, indices=gltf.array(4 + FACES.ravel())
    )
    (part,) = read(one(primitive, gltf))
    np.testing.assert_array_equal(part.vertices, CORNERS)
    np.testing.assert_array_equal(triangles([part]), WHOLE)


def test_names_do_not_grow_with_the_depth_of_nodes():
    gltf = Gltf()
    gltf.header |= {
        "meshes": [{"primitives": [gltf.tetrahedron()], "name": "m" * 5000}],
        "nodes": [{"mesh": 0, "name": "n" * 5000, "children": [i + 1]} for i in range(99)]
        + [{"mesh": 0, "name": "UCX_chair"}],
    }
    names = [part.name for part in read(gltf)]
    assert max(map(len, names)) < 5000 and "UCX_chair" in names[-1].split("/")


def test_a_skin_bends_the_mesh_and_forgets_its_own_place():
    """Two corners hang on a joint that has moved by (0, 0, 4), one on another joint, and one has no
    weights."""
    gltf = Gltf()
    joints = np.zeros((4, 4), np.uint8)
    joints[2:, 0] = 1
    weights = np.tile(np.array([1, 0, 0, 0], np.float32), (4, 1))
    weights[1] = 0
    primitive = gltf.tetrahedron()
    primitive["attributes"] |= {"JOINTS_0": gltf.array(joints), "WEIGHTS_0": gltf.array(weights)}
    inverse = np.tile(np.eye(4, dtype=np.float32), (2, 1, 1))
    inverse[1, 3, 1] = -1  # columns come first: the joint was at (0, 1, 0) when bound
    skin = {"joints": [1, 2], "inverseBindMatrices": gltf.array(inverse.reshape(2, 16))}
    gltf.header |= {
        "meshes": [{"primitives": [primitive]}],
        "skins": [skin],
        "nodes": [
            {"mesh": 0, "skin": 0, "translation": [100, 0, 0]},
            {"children": [2]},
            {"translation": [0, 1, 4]},
        ],
    }
    (part,) = read(gltf)
    np.testing.assert_allclose(part.vertices, CORNERS + [[0] * 3, [0] * 3, [0, 0, 4], [0, 0, 4]])


def test_morph_targets_move_vertices_by_their_weights():
    gltf = Gltf()
    target = {"POSITION": gltf.array(np.full((4, 3), 2, np.float32))}
    (part,) = read(one(gltf.tetrahedron(targets=[target]), gltf, weights=[0.5]))
    np.testing.assert_allclose(part.vertices, CORNERS + 1)


def test_transforms_of_all_nodes_add_up_and_mirrored_nodes_keep_their_outside():
    gltf = Gltf(meshes=[{"primitives": []}])
    gltf.header["meshes"][0]["primitives"].append(gltf.tetrahedron())
    half = np.sqrt(0.5)
    gltf.header["nodes"] = [
        {"children": [1], "rotation": [0, 0, half, half]},  # x becomes y
        {"mesh": 0, "translation": [1, 0, 0], "scale": [-1, 1, 1], "name": "mirrored"},
    ]
    (part,) = read(gltf)
    np.testing.assert_allclose(
        part.vertices, [[0, 1, 0], [0, 0, 0], [-2, 1, 0], [0, 1, 3]], atol=1e-6
    )
    a, b, c = part.vertices[part.faces].transpose(1, 0, 2)
    volume = np.einsum("fd,fd->f", a - part.vertices[0], np.cross(b - a, c - a)).sum() / 6
    assert volume == pytest.approx(1) and part.name == "mirrored"


def test_only_the_scene_that_is_shown_counts():
    gltf = Gltf(scene=1, scenes=[{"nodes": [0]}, {"nodes": [1, 2]}])
    gltf.header["meshes"] = [{"primitives": [gltf.tetrahedron()]}]
    hidden = {"KHR_node_visibility": {"visible": False}}
    gltf.header["nodes"] = [
        {"mesh": 0, "name": "other"}, {"mesh": 0, "name": "shown"},
        {"mesh": 0, "name": "hidden", "extensions": hidden},
    ]  # fmt: skip
    assert [part.name for part in read(gltf)] == ["shown"]


@pytest.mark.parametrize(("mixed", "mode"), [(False, 4), (True, 4), (False, 5)])
def test_draco_is_decoded_beside_plain_primitives(mixed, mode, monkeypatch):
    draco = pytest.importorskip("DracoPy")
    gltf = Gltf(extensionsRequired=["KHR_draco_mesh_compression"])
    content = draco.encode(CORNERS, FACES.astype(np.uint32), preserve_order=True)
    about = {"bufferView": gltf.view(content), "attributes": {"POSITION": 0}}
    packed = gltf.tetrahedron(extensions={"KHR_draco_mesh_compression": about}, mode=mode)
    for number in (packed["attributes"]["POSITION"], packed["indices"]):
        del gltf.header["accessors"][number]["bufferView"]
    primitives = [packed, gltf.tetrahedron()] if mixed else [packed]
    gltf.header |= {"meshes": [{"primitives": primitives}], "nodes": [{"mesh": 0}]}
    parts = read(gltf)
    assert len(parts) == len(primitives)
    for part in parts:
        np.testing.assert_allclose(triangles([part]), WHOLE, atol=1e-3)
    monkeypatch.setitem(sys.modules, "DracoPy", None)
    with pytest.raises(NotSupported, match=r"Draco; pip install 'jaxshape\[draco\]'"):
        read(gltf)


@pytest.mark.parametrize("name", ["EXT_meshopt_compression", "EXT_new_geometry"])
def test_extensions_that_are_not_read_are_refused_by_name(name):
    gltf = Gltf(extensionsRequired=["KHR_materials_unlit", name])
    with pytest.raises(NotSupported, match=f"extension {name}"):
        read(one(gltf.tetrahedron(), gltf))
    gltf.header["extensionsRequired"].pop()
    assert len(read(gltf)) == 1


@pytest.mark.parametrize("uri", ["with%20space.bin", "with space.bin"])
def test_names_of_buffers_may_be_encoded(uri):
    gltf = Gltf()
    one(gltf.tetrahedron(), gltf)
    files = {"with space.bin": gltf.data}
    parts = read_gltf(gltf.content(uri), lambda name: files[name])
    np.testing.assert_array_equal(triangles(parts), WHOLE)


WORST = (None, True, "x", {}, [], [None], -1, 0.5, 1e300, float("nan"))
"""What stands in a header where something else should."""


def test_anything_in_place_of_anything_ends_in_a_sentence_or_parts():
    """Every entry, by everything that is none, one at a time."""
    gltf = Gltf(scenes=[{"nodes": [0]}], scene=0, extensionsRequired=["EXT_mesh_gpu_instancing"])
    target = {"POSITION": gltf.array(CORNERS)}
    mesh = {"name": "a", "primitives": [gltf.tetrahedron(targets=[target])], "weights": [0.5]}
    about = {"attributes": {"TRANSLATION": gltf.array(CORNERS)}}
    node = {"mesh": 0, "children": [1], "extensions": {"EXT_mesh_gpu_instancing": about}}
    gltf.header |= {"meshes": [mesh], "nodes": [node, {"translation": [1, 2, 3]}]}
    content = json.loads(gltf.content())
    for path in entries(content):
        for worst in WORST:
            text = json.dumps(changed(content, path, worst)).encode()
            with suppress(Unreadable, NotSupported, TooManyFaces), np.errstate(all="ignore"):
                read_gltf(text, lambda name: b"")


def entries(content, path=()):
    """Places of all entries of a JSON content."""
    inside = content.items() if isinstance(content, dict) else enumerate(content)
    for key, value in inside:
        yield (*path, key)
        if isinstance(value, dict | list):
            yield from entries(value, (*path, key))


def _null(gltf):
    gltf.header["nodes"] = None


def _text(gltf):
    gltf.header["asset"] = "x"


def _no_children(gltf):
    gltf.header["nodes"][0]["children"] = None


def _cut(gltf):
    gltf.data = gltf.data[:-8]


def _circle(gltf):
    gltf.header["nodes"] = [{"mesh": 0, "children": [1]}, {"children": [0]}]


def _two_parents(gltf):
    gltf.header["nodes"] = [{"children": [2]}, {"children": [2]}, {"mesh": 0}]


def _no_data(gltf):
    del gltf.header["accessors"][0]["bufferView"]


def _no_mesh(gltf):
    gltf.header["nodes"][0]["mesh"] = -1  # which Python counts from the end


def _deep(gltf):
    for _ in range(99):
        gltf.header["extras"] = [gltf.header.get("extras")]


def _odd(gltf):
    gltf.header["accessors"][1]["count"] = 11


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (_null, "The header of the file is damaged at nodes, which is no list."),
        (_text, "The header of the file is damaged at asset."),
        (_no_children, r"The header of the file is damaged at nodes\[0\]."),
        (_cut, "beyond its buffer"),
        (_circle, "their own descendants"),
        (_two_parents, "child of two nodes"),
        (_no_data, "no data"),
        (_odd, "11 corners"),
        (_deep, "nested more than 32 deep"),
        (_no_mesh, r"refers to meshes\[-1\], which it does not have"),
    ],
)
def test_files_that_break_the_rules_are_refused(damage, said):
    gltf = one({}, Gltf())
    gltf.header["meshes"][0]["primitives"] = [gltf.tetrahedron()]
    damage(gltf)
    with pytest.raises(Unreadable, match=said):
        read(gltf)
