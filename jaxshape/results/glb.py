"""Write meshes to one GLB file: a node for each object, with its pose and its data. [host]"""

import os
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import trimesh
from jaxtyping import Bool, Float, UInt8

from jaxshape.files import atomic_path


class Node(NamedTuple):
    """An object in a GLB file.

    Attributes:
        name: Name of its node and of its mesh.
        mesh: Its mesh in its own frame, in metres.
        measured: True for vertices on a measured surface, which become `_MEASURED`; None for no
            such flags.
        color: Colours of the vertices, sRGB; None for none.
        confidence: Probability of each vertex, from 0 to 1, which becomes `_CONFIDENCE`; None for
            none.
        T_world_object: Pose of the object `[4 4]`; None for a file of one object in its own frame.
        extras: Further entries of the node, as JSON can hold them; None for none.
    """

    name: str
    mesh: trimesh.Trimesh
    measured: Bool[np.ndarray, " n"] | None = None
    color: UInt8[np.ndarray, "n 3"] | None = None
    confidence: Float[np.ndarray, " n"] | None = None
    T_world_object: Float[np.ndarray, "4 4"] | None = None
    extras: dict[str, Any] | None = None


def write_glb(path: str | os.PathLike[str], nodes: Sequence[Node]) -> None:
    """Write a GLB with normals, so that viewers shade it smoothly, and a dull material.

    Args:
        path: The file to write.
        nodes: The objects, one or more.
    """
    scene = trimesh.Scene()
    for node in nodes:
        T = np.eye(4) if node.T_world_object is None else node.T_world_object
        scene.add_geometry(_flagged(node), geom_name=node.name, node_name=node.name, transform=T)

    known = {node.name: node.extras for node in nodes}

    def finish(tree: dict[str, Any]) -> None:
        for mesh in tree["meshes"]:
            for part in mesh["primitives"]:
                part["material"] = 0
                if "_COLOR_0" in part["attributes"]:
                    part["attributes"]["COLOR_0"] = part["attributes"].pop("_COLOR_0")
        for entry in tree["nodes"]:
            if extras := known.get(entry.get("name")):
                entry["extras"] = extras
        dull = {"metallicFactor": 0.0, "roughnessFactor": 0.9}
        tree["materials"] = [{"pbrMetallicRoughness": dull, "doubleSided": True}]

    with atomic_path(path) as temporary:
        scene.export(temporary, include_normals=True, tree_postprocessor=finish)


def _flagged(node: Node) -> trimesh.Trimesh:
    """The mesh with its flags and its colours, the latter as linear light, as GLB asks."""
    mesh = trimesh.Trimesh(node.mesh.vertices, node.mesh.faces, process=False)
    if node.measured is not None:
        mesh.vertex_attributes["_MEASURED"] = node.measured.astype(np.float32)
    if node.confidence is not None:
        mesh.vertex_attributes["_CONFIDENCE"] = node.confidence.astype(np.float32)
    if node.color is not None:
        linear = _linear_light(node.color)
        mesh.vertex_attributes["_COLOR_0"] = np.insert(linear, 3, 1, axis=1).astype(np.float32)
    return mesh


def _linear_light(color: UInt8[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """sRGB as linear light, 0 to 1 (IEC 61966-2-1)."""
    share = color / 255
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
