"""glTF 2.0: every triangle of the scene that a viewer would show, in its resting pose."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Num

from jaxshape.data.formats.gltf_data import GltfFile, draco_mesh, open_gltf
from jaxshape.data.formats.parts import (
    LETTERS,
    NotSupported,
    Part,
    Unreadable,
    check_faces,
    checked,
    damaged_at,
)
from jaxshape.data.formats.ply import strip_triangles

UNDERSTOOD = {
    "KHR_draco_mesh_compression", "KHR_mesh_quantization", "EXT_mesh_gpu_instancing",
    "KHR_node_visibility",
}  # fmt: skip
"""Extensions that change shapes and are supported."""

HARMLESS = (
    "KHR_materials_", "KHR_texture_", "EXT_texture_", "MSFT_texture_", "MSFT_packing_",
    "KHR_lights_", "EXT_lights_", "KHR_xmp", "KHR_animation_", "AGI_", "EXT_materials_",
    "ADOBE_materials_", "KHR_audio", "KHR_node_hoverability", "KHR_node_selectability",
    "KHR_interactivity", "CESIUM_primitive_outline", "EXT_structural_metadata",
)  # fmt: skip
"""Prefixes of the names of extensions that do not change shapes."""

_NAMES = 32
"""Number of nodes, the nearest ones above a mesh, that its parts are named after."""

_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_NO_SURFACE = (0, 1, 2, 3)
"""Modes of points and lines."""

_USUAL = np.zeros((1, 3)), np.array([[0.0, 0, 0, 1]]), np.ones((1, 3))
"""Translation, rotation and scale of a node that states none."""

Matrix = Float[np.ndarray, "4 4"]


def read_gltf(content: bytes, read_relative: Callable[[str], bytes]) -> list[Part]:
    """The triangles of a `.gltf` or `.glb` file, one part for each primitive of each node.

    Args:
        content: Content of the file.
        read_relative: Reads a file by its path relative to this one.

    Raises:
        Unreadable: The file is damaged.
        NotSupported: It needs an extension that is not read here.
        TooManyFaces: There are too many triangles.
    """
    file = open_gltf(content, read_relative)
    for name in map(str, file.list("extensionsRequired")):
        if name not in UNDERSTOOD and not name.startswith(HARMLESS):
            raise NotSupported(f"The file needs the glTF extension {name}; export it without.")
    placed = _matrices(file)
    with damaged_at("scenes"):
        shown = list(_shown(file))
    meshes: dict[Any, list[Part]] = {}
    parts, faces = [], 0
    for index, names in shown:
        node = file.list("nodes")[index]
        if "mesh" not in node:
            continue
        with damaged_at(f"nodes[{index}]"):
            key = index if "skin" in node or "weights" in node else ("mesh", node["mesh"])
            if key not in meshes:
                made = _primitives(file, node, placed)
                meshes[key] = [part for part in made if len(part.faces)]
            if not meshes[key]:
                continue
            is_bent = "skin" in node  # then its joints place it
            instances = _USUAL if is_bent else _instances(file, node)
            faces += len(instances[0]) * sum(len(part.faces) for part in meshes[key])
            check_faces(faces)
            copies = np.eye(4)[None] if is_bent else placed[index] @ _transform(*instances)
            parts += [_moved(part, names, copies) for part in meshes[key]]
    return parts


# ------------------------------------------------------------------ nodes


def _matrices(file: GltfFile) -> list[Matrix]:
    """Transforms from the frame of each node to the frame of the scene."""
    nodes = file.list("nodes")
    parents: dict[int, int] = {}
    placed = []
    for i, node in enumerate(nodes):
        with damaged_at(f"nodes[{i}]"):
            placed.append(_matrix(node))
            for child in node.get("children", []):
                is_there = isinstance(child, int) and 0 <= child < len(nodes)
                if child in parents or not is_there:
                    raise Unreadable(f"Node {child} is the child of two nodes, or is not there.")
                parents[child] = i
    waiting = [i for i in range(len(nodes)) if i not in parents]
    seen = 0
    while waiting:
        index = waiting.pop()
        seen += 1
        for child in nodes[index].get("children", []):
            placed[child] = placed[index] @ placed[child]
            waiting.append(child)
    if seen < len(nodes):
        raise Unreadable("Some nodes are their own descendants.")
    return placed


def _matrix(node: dict[str, Any]) -> Matrix:
    """Transform from the frame of a node to its parent's."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    return _transform(
        *(
            np.asarray(node.get(name, usual)).reshape(usual.shape[1])
            for name, usual in zip(("translation", "rotation", "scale"), _USUAL, strict=True)
        )
    )


def _transform(
    translation: Num[np.ndarray, "*batch 3"],
    xyzw: Num[np.ndarray, "*batch 4"],
    scale: Num[np.ndarray, "*batch 3"],
) -> Float[np.ndarray, "*batch 4 4"]:
    """Matrices that scale, then rotate, then translate."""
    xyzw = xyzw.astype(np.float64)
    length = np.linalg.norm(xyzw, axis=-1, keepdims=True)
    x, y, z, w = np.moveaxis(xyzw / np.where(length == 0, 1, length), -1, 0)
    rotation = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip
    matrix = np.zeros((*x.shape, 4, 4))
    matrix[..., :3, :3] = np.moveaxis(rotation, (0, 1), (-2, -1)) * scale[..., None, :]
    matrix[..., :3, 3] = translation
    matrix[..., 3, 3] = 1
    return matrix


def _shown(file: GltfFile) -> Iterator[tuple[int, list[str]]]:
    """Visible nodes of the scene, with the names of their ancestors."""
    nodes = file.list("nodes")
    if file.list("scenes"):
        roots = file.entry("scenes", file.header.get("scene", 0)).get("nodes", [])
    else:
        children = {child for node in nodes for child in node.get("children", [])}
        roots = [i for i in range(len(nodes)) if i not in children]
    waiting = [(root, []) for root in reversed(roots)]
    while waiting:
        index, above = waiting.pop()
        node = file.entry("nodes", index)
        with damaged_at(f"nodes[{index}]"):
            visibility = node.get("extensions", {}).get("KHR_node_visibility", {})
            if not visibility.get("visible", True):
                continue
        names = [*above, str(node.get("name", ""))[:LETTERS]][-_NAMES:]
        yield index, names
        waiting += [(child, names) for child in reversed(node.get("children", []))]


def _instances(file: GltfFile, node: dict[str, Any]) -> tuple[np.ndarray, ...]:
    """Translations, rotations and scales of the copies of a node's mesh, in the frame of the
    node."""
    about = node.get("extensions", {}).get("EXT_mesh_gpu_instancing")
    if about is None:
        return _USUAL
    given = {name: file.accessor(i) for name, i in about["attributes"].items()}
    count = max(map(len, given.values()), default=0)
    rows = []
    for name, usual in zip(("TRANSLATION", "ROTATION", "SCALE"), _USUAL, strict=True):
        rows.append(given.get(name, np.broadcast_to(usual, (count, usual.shape[1]))))
        if rows[-1].shape != (count, usual.shape[1]):
            raise Unreadable("The attributes of the instances of a mesh do not fit each other.")
    return tuple(rows)


# ------------------------------------------------------------------ meshes


def _primitives(file: GltfFile, node: dict[str, Any], placed: list[Matrix]) -> Iterator[Part]:
    """The parts of a node's mesh, in the frame of the node or, if it has a skin, of the scene."""
    mesh = file.entry("meshes", node["mesh"])
    with damaged_at(f"meshes[{node['mesh']}]"):
        weights = node.get("weights", mesh.get("weights", []))
        for primitive in mesh["primitives"]:
            if primitive.get("mode", _TRIANGLES) in _NO_SURFACE:
                continue
            attributes, faces = _arrays(file, primitive)
            vertices = attributes["POSITION"].astype(np.float64)
            for weight, target in zip(weights, primitive.get("targets", []), strict=False):
                if weight and "POSITION" in target:
                    vertices = vertices + weight * file.accessor(target["POSITION"])
            if "skin" in node:
                vertices = _bent(file, node["skin"], placed, attributes, vertices)
            yield checked(Part(str(mesh.get("name", ""))[:LETTERS], vertices, faces))


def _arrays(
    file: GltfFile, primitive: dict[str, Any]
) -> tuple[dict[str, np.ndarray], Int[np.ndarray, "f 3"]]:
    """Attributes of the vertices of a primitive, and its triangles."""
    given = primitive["attributes"]
    wanted = [n for n in given if n == "POSITION" or n.startswith(("JOINTS_", "WEIGHTS_"))]
    attributes, faces = draco_mesh(file, primitive) or ({}, None)
    attributes |= {n: file.accessor(given[n]) for n in wanted if n not in attributes}
    if "POSITION" not in attributes:
        raise Unreadable("A mesh of the file has no positions.")
    if faces is not None:  # Draco stores triangles, also where the mode is that of strips
        return attributes, faces
    corners = np.arange(len(attributes["POSITION"]))
    if "indices" in primitive:
        corners = file.accessor(primitive["indices"])[:, 0].astype(np.int64)
    return attributes, _triangles(corners, primitive.get("mode", _TRIANGLES))


def _triangles(corners: Int[np.ndarray, " n"], mode: int) -> Int[np.ndarray, "f 3"]:
    if mode == _STRIP:
        return strip_triangles(corners)
    if mode == _FAN:
        rim = corners[1:]
        return np.stack([rim[:-1], rim[1:], np.broadcast_to(corners[:1], len(rim[1:]))], axis=1)
    if mode != _TRIANGLES:
        raise NotSupported(f"The file holds primitives of mode {mode}, which glTF does not know.")
    if len(corners) % 3:
        raise Unreadable(f"A mesh has {len(corners)} corners, which make no triangles.")
    return corners.reshape(-1, 3)


def _bent(
    file: GltfFile,
    skin: int,
    placed: list[Matrix],
    attributes: dict[str, np.ndarray],
    vertices: Float[np.ndarray, "v 3"],
) -> Float[np.ndarray, "v 3"]:
    """Vertices moved by their joints, in the frame of the scene."""
    about = file.entry("skins", skin)
    joints = np.stack([placed[i] for i in about["joints"]])
    if "inverseBindMatrices" in about:
        inverse = file.accessor(about["inverseBindMatrices"]).reshape(-1, 4, 4)
        joints = joints @ np.swapaxes(inverse, 1, 2)[: len(joints)]
    sets = sorted(name.removeprefix("JOINTS_") for name in attributes if "JOINTS_" in name)
    if not sets:
        raise Unreadable("A mesh has a skin, but its vertices are bound to no joint.")
    joint = np.concatenate([attributes[f"JOINTS_{s}"] for s in sets], axis=1).astype(np.int64)
    weight = np.concatenate([attributes[f"WEIGHTS_{s}"] for s in sets], axis=1).astype(float)
    if joint.size and joint.max() >= len(joints):
        raise Unreadable("A vertex is bound to a joint that the skin does not have.")
    weight[weight.sum(axis=1) == 0, 0] = 1  # as in viewers: only its first joint moves the vertex
    weight /= weight.sum(axis=1, keepdims=True)
    homogeneous = np.append(vertices, np.ones((len(vertices), 1)), axis=1)
    moved = np.zeros((len(vertices), 3))
    for j, w in zip(joint.T, weight.T, strict=True):
        moved += w[:, None] * np.einsum("vij,vj->vi", joints[j][:, :3], homogeneous)
    return moved


def _moved(part: Part, names: list[str], matrices: Float[np.ndarray, "n 4 4"]) -> Part:
    """All copies of the part in the frame of the scene; their triangles keep the side that they
    face."""
    linear, count = matrices[:, :3, :3], len(part.vertices)
    vertices = part.vertices @ np.swapaxes(linear, 1, 2) + matrices[:, None, :3, 3]
    mirrored = (np.linalg.det(linear) < 0)[:, None, None]
    faces = np.where(mirrored, part.faces[:, ::-1], part.faces)
    faces += count * np.arange(len(matrices))[:, None, None]
    name = "/".join(filter(None, [*names, part.name]))
    return Part(name, vertices.reshape(-1, 3), faces.reshape(-1, 3))
