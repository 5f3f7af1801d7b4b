"""From a grid of occupancy to a closed triangle mesh, in metres, and to a file."""

import io
import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh
from jaxtyping import Array, Bool, Float, UInt8
from skimage.measure import marching_cubes
from trimesh.visual import ColorVisuals

from jaxshape import limits, reading
from jaxshape.files import atomic_path
from jaxshape.geometry.grid import GridFrame
from jaxshape.results.glb import Node, write_glb

MESH_SUFFIXES = (".ply", ".glb", ".obj")


def surface(
    probability: Float[Array | np.ndarray, "x y z"] | Bool[Array | np.ndarray, "x y z"],
    frame: GridFrame,
    *,
    level: float = 0.5,
    smoothing: int = 0,
    T_world_object: Float[Array | np.ndarray, "4 4"] | None = None,
) -> trimesh.Trimesh:
    """The closed surface around the voxels more probable than a level, in metres. [host]

    Marching cubes runs between voxel centres (at +0.5), with free space all around the grid.
    Normals point from occupied to free. Occupancy is a shell that may be hollow inside, so the mesh
    has outer sheets and, around a cavity, inner ones whose normals point into the cavity: the
    signed volume is that of the shell alone, and positive.

    Args:
        probability: Probability of each voxel `[x y z]`, from 0 to 1, or booleans.
        frame: Voxel frame of the grid, which maps it to the object frame.
        level: Probability at the surface, between 0 and 1.
        smoothing: Rounds of Taubin's filter, 0 or more, that smooth the steps of a boolean grid;
            about 20 are enough. Unlike a blur of the grid, they cannot lose a leg that is one voxel
            thin.
        T_world_object: Rigid motion from the object frame to the world `[4 4]`; None leaves the
            mesh in the object frame.

    Returns:
        A closed triangle mesh whose vertices are in metres.

    Raises:
        ValueError: No voxel is above the level, values are not finite, or the level is outside (0,
            1).
    """
    mesh = voxel_surface(probability, level=level)
    if smoothing:
        trimesh.smoothing.filter_taubin(mesh, lamb=0.5, nu=0.525, iterations=smoothing)
    mesh.vertices = np.asarray(frame.origin) + mesh.vertices * np.asarray(frame.voxel_size)
    if T_world_object is not None:
        mesh.apply_transform(np.asarray(T_world_object, np.float64))
    return mesh


def voxel_surface(
    probability: Float[Array | np.ndarray, "x y z"] | Bool[Array | np.ndarray, "x y z"],
    *,
    level: float = 0.5,
) -> trimesh.Trimesh:
    """The closed surface at a level, in voxel coordinates; see `surface`."""
    values = np.asarray(probability, np.float64)
    if not 0 < level < 1:
        raise ValueError(f"level must lie between 0 and 1, but is {level}.")
    if not np.isfinite(values).all():
        raise ValueError("The grid holds values that are not finite; a surface needs a number "
                         "in every voxel.")  # fmt: skip
    if values.max(initial=0.0) <= level:
        raise ValueError(
            f"No voxel of the grid is above the level {level}, so there is no surface: the "
            f"highest value is {values.max(initial=0.0):.3g}."
        )
    padded = np.pad(values, 1)  # free space around, so that the surface closes at the border
    # At a level exactly half way between 0 and 1, scikit-image joins diagonal neighbours in one
    # cell and separates them in the next, which leaves edges with four faces. At a slightly lower
    # level, they are always joined.
    vertices, faces, _, _ = marching_cubes(padded, level * (1 - 1e-6))
    mesh = trimesh.Trimesh(vertices - 1 + 0.5, faces, process=False)
    if mesh.volume < 0:  # scikit-image has returned inside-out faces
        mesh.invert()
    return mesh


def write_mesh(
    mesh: trimesh.Trimesh,
    path: str | os.PathLike[str],
    *,
    measured: Bool[np.ndarray, " n"] | None = None,
    color: UInt8[np.ndarray, "n 3"] | None = None,
    confidence: Float[np.ndarray, " n"] | None = None,
) -> None:
    """Write a mesh as PLY, GLB or OBJ; an earlier file is replaced only by a complete one. [host]

    Args:
        mesh: The mesh to write.
        path: The file to write; its suffix names the format, `.ply`, `.glb` or `.obj`.
        measured: True for vertices on a measured surface: `measured` in PLY, `_MEASURED` in GLB, 1
            or 0 for each vertex. None for no such flags; OBJ has none.
        color: Colours of the vertices, sRGB; None for none. GLB holds them as linear light, as its
            standard asks.
        confidence: Probability that there is surface at each vertex, from 0 to 1: `confidence` in
            PLY, `_CONFIDENCE` in GLB. None for none; OBJ has none.

    Raises:
        ValueError: The suffix is another one.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise ValueError(
            f"A mesh is written as one of {', '.join(MESH_SUFFIXES)}, but {str(path)!r} ends in "
            f"{suffix or 'no suffix'!r}."
        )
    if suffix == ".glb":
        write_glb(path, [Node("object", mesh, measured, color, confidence)])
        return
    copy = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    with atomic_path(path) as temporary:
        if color is not None:
            copy.visual = ColorVisuals(copy, vertex_colors=color)
        if measured is not None and suffix == ".ply":
            copy.vertex_attributes["measured"] = measured.astype(np.uint8)
        if confidence is not None and suffix == ".ply":
            copy.vertex_attributes["confidence"] = confidence.astype(np.float32)
        copy.export(temporary)


class MeshFile(NamedTuple):
    """The content of a mesh file.

    Attributes:
        mesh: Its vertices and faces.
        measured: True for vertices on a measured surface; None where the file does not tell.
        color: Colours of the vertices, sRGB; None where there are none.
        confidence: Probability that there is surface at each vertex; None where the file does not
            tell.
    """

    mesh: trimesh.Trimesh
    measured: Bool[np.ndarray, " n"] | None
    color: UInt8[np.ndarray, "n 3"] | None
    confidence: Float[np.ndarray, " n"] | None = None


def read_ply(path: str | os.PathLike[str]) -> MeshFile:
    """Read a PLY file that `write_mesh` wrote.

    Args:
        path: The file.

    Raises:
        ValueError: It has no faces, or vertices that are not finite or far away.
    """
    content = io.BytesIO(reading.read_bytes(path, limits.MESH_BYTES))
    # Processing would change the vertices.
    mesh: Any = trimesh.load_mesh(content, file_type="ply", process=False)
    if len(mesh.faces) == 0 or not (np.abs(mesh.vertices) <= limits.FAR).all():
        raise ValueError(f"it has no faces, or vertices farther than {limits.FAR:g} m")
    if not 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices):
        raise ValueError("its faces have vertices that are not there")
    vertex = mesh.metadata["_ply_raw"]["vertex"]
    measured = vertex["data"]["measured"] > 0 if "measured" in vertex["properties"] else None
    sure = None
    if "confidence" in vertex["properties"]:
        sure = np.clip(np.nan_to_num(vertex["data"]["confidence"].astype(np.float32)), 0, 1)
    visual: Any = mesh.visual
    color = visual.vertex_colors[:, :3] if visual.kind == "vertex" else None
    plain = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    return MeshFile(plain, measured, None if color is None else np.asarray(color), sure)
