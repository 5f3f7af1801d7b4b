"""CAD meshes in the canonical object frame, read from files, folders, archives and catalogues.

    for model in read_meshes("chairs/"):       # Model or Skipped, sorted by name
        ...

`list_meshes` finds meshes without opening any, and `load` opens one, so that processes can share
the work.
"""

import hashlib
import os
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float

from jaxshape.data.archives import MeshSource, TooLarge, list_meshes, read_bytes
from jaxshape.data.config import UNITS, UnitName, check_axes
from jaxshape.data.formats import read_parts
from jaxshape.data.formats.gltf_data import read_buffer, referred
from jaxshape.data.formats.parts import NotSupported, TooManyFaces, Unreadable
from jaxshape.data.helpers import without_helpers
from jaxshape.data.orientation import SEAT, apparent_up, up_scores

__all__ = [
    "MeshSource", "Model", "Skipped", "axes_to_canonical", "canonical", "list_meshes", "load",
    "lying_on_its_side", "read_meshes", "sample_oriented", "sample_surface",
]  # fmt: skip

FLAT = 1e-6
"""An object is flat when its smallest extent is below this fraction of its largest."""


SMALLEST, LARGEST = 0.05, 10.0
"""Range of plausible diagonals of an object, in metres."""


class Model(NamedTuple):
    """A CAD model in the canonical object frame.

    Attributes:
        name: Stable identifier: the path below the root that was read, without suffix.
        mesh: Triangles only, +y up, front along +z, bounding box centred at the origin, in the
            units of the file (metres if the file is in metres, like glTF, or if a catalogue gives
            sizes).
        metadata: Entries of a furniture catalogue: name, creator, license, and so on; empty without
            a catalogue.
        notes: Sentences on parts of the file that are not the object and were left out.
        digest: Digest of the content of the file and of the files that it refers to.
    """

    name: str
    mesh: trimesh.Trimesh
    metadata: dict[str, str]
    notes: tuple[str, ...] = ()
    digest: str = ""


class Skipped(NamedTuple):
    """A mesh that cannot be used, and why.

    Attributes:
        name: Identifier of the mesh, as in `Model`.
        reason: One of `unreadable`, `not supported` (a feature of the format), `too large`, `empty`
            (no vertices), `no faces` (none with an area), `not finite`, `flat` (an axis with no
            extent), `nothing measured` (by the virtual camera), `killed` (with its process).
        detail: A sentence that describes the problem.
    """

    name: str
    reason: str
    detail: str


class _Unusable(ValueError):
    def __init__(self, reason: str, detail: str):
        super().__init__(reason, detail)


def read_meshes(
    path: str | os.PathLike[str], *, up: str = "y", front: str = "z", unit: UnitName = "m"
) -> Iterator[Model | Skipped]:
    """Load every mesh at a path in turn, sorted by name. [host]

    Args:
        path: A mesh, an archive (`.zip`, or Sweet Home 3D's `.sh3f`), or a folder of both, searched
            recursively.
        up: Axis of the files that points up: `x`, `y`, `z`, or one of these with a minus.
        front: Axis of the files along which the object's front looks, perpendicular to `up`.
        unit: Unit of the files: "m", "cm", "mm" or "inch".

    Returns:
        An iterator over the meshes: a `Model`, or `Skipped` if the mesh cannot be used.

    Raises:
        FileNotFoundError: There is nothing at the path.
        ValueError: The path holds no mesh, or the axes are not perpendicular axes.
    """
    sources = list_meshes(path)
    axes_to_canonical(up, front)  # a wrong axis is reported once, not for every mesh
    return (load(source, up=up, front=front, unit=unit) for source in sources)


def load(
    source: MeshSource, *, up: str = "y", front: str = "z", unit: UnitName = "m"
) -> Model | Skipped:
    """Load one mesh, flattened and turned so that `up` becomes +y and `front` becomes +z. [host]

    Materials, textures and parts that are not the object (`helpers`) are left out. If a furniture
    catalogue describes the mesh, its rotation and its size in centimetres are applied first, as in
    Sweet Home 3D.

    Args:
        source: The mesh, from `jaxshape.data.archives.list_meshes`.
        up: Axis of the file that points up, unless the source gives it: `x`, `y`, `z`, or one of
            these with a minus.
        front: Axis of the file along which the object's front looks, perpendicular to `up`.
        unit: Unit of the file: "m", "cm", "mm" or "inch".

    Returns:
        The mesh; `Skipped`, never an exception, for a file that is broken or holds nothing to use.

    Raises:
        ValueError: The axes are not perpendicular axes.
    """
    up, front = source.axes or (up, front)
    axes_to_canonical(up, front)
    try:
        parsed, notes = _parse(source, up)
        mesh, lost = _usable(parsed)
        mesh.vertices *= UNITS[unit]
        _apply_catalogue(mesh, source.metadata)
        turned = canonical(mesh, up=up, front=front)
        return Model(source.name, turned, dict(source.metadata), notes + lost, digest(source))
    except _Unusable as problem:
        return Skipped(source.name, *problem.args)
    except (TooLarge, TooManyFaces) as problem:
        return Skipped(source.name, "too large", str(problem))
    except NotSupported as problem:
        return Skipped(source.name, "not supported", str(problem))
    except (Unreadable, FileNotFoundError) as problem:
        return Skipped(source.name, "unreadable", str(problem))
    except Exception as problem:  # parsers of foreign files may raise anything
        detail = " ".join(f"{type(problem).__name__}: {problem}".split())
        return Skipped(source.name, "unreadable", detail[:300])


def _parse(source: MeshSource, up: str) -> tuple[trimesh.Trimesh, tuple[str, ...]]:
    """All triangles of a file as one mesh, and sentences on the parts that were left out."""
    content = read_bytes(source)
    if not content.strip(b"\0 \t\r\n"):
        raise _Unusable("empty", "The file has no content.")
    suffix = os.path.splitext(source.member or source.path)[1].lower()
    parts = read_parts(suffix, content, partial(read_bytes, source))
    if not any(len(part.vertices) for part in parts):
        raise _Unusable("empty", "The file holds no vertices of a triangle mesh.")
    parts, notes = without_helpers(parts, up)
    if not parts:
        raise _Unusable("no faces", "The file holds vertices and no triangle.")
    _, vertices, faces = zip(*parts, strict=True)
    vertices, faces = trimesh.util.append_faces(vertices, faces)
    return trimesh.Trimesh(vertices, faces, process=False), notes


def _usable(mesh: trimesh.Trimesh) -> tuple[trimesh.Trimesh, tuple[str, ...]]:
    """The triangles with a finite, nonzero area, and a note on those with corners not finite.

    Raises:
        _Unusable: Nothing is left, or it has no extent along an axis.
    """
    vertices = np.asarray(mesh.vertices, np.float64)
    faces = np.asarray(mesh.faces, np.int64).reshape(-1, 3)
    total, faces = len(faces), faces[np.all(np.isfinite(vertices[faces]), axis=(1, 2))]
    lost = total - len(faces)
    if not len(faces):
        raise _Unusable("not finite", "Every face has a vertex that is not a finite number.")
    with np.errstate(over="ignore", invalid="ignore"):
        area = trimesh.triangles.area(vertices[faces])
    if not np.isfinite(area.sum()):
        raise _Unusable("not finite", "The vertices are too far apart for areas to be finite.")
    faces = faces[area > 0]
    if not len(faces):
        raise _Unusable("no faces", "Every face has zero area.")
    usable = trimesh.Trimesh(vertices, faces, process=False)
    usable.remove_unreferenced_vertices()
    if usable.extents.min() <= FLAT * usable.extents.max():
        size = " x ".join(f"{extent:.3g}" for extent in usable.extents)
        raise _Unusable("flat", f"The mesh measures {size}: one axis has no extent.")
    return usable, (f"faces left out: {lost} have a corner that is not finite.",) if lost else ()


def digest(source: MeshSource) -> str:
    """A digest of everything in a file that determines the shape; name and folder do not count.

    Args:
        source: The mesh. Files that it refers to and that are missing count as empty.
    """
    content = read_bytes(source)
    found = hashlib.sha256(content)
    for uri in referred(content):
        with suppress(Exception):  # missing or broken files are reported when they are read
            found.update(read_buffer(uri, partial(read_bytes, source)))
    about = sorted(source.metadata.items()), source.axes
    found.update(repr(about).encode("utf-8", "surrogateescape"))
    return found.hexdigest()


def _apply_catalogue(mesh: trimesh.Trimesh, metadata: dict[str, str]) -> None:
    """Rotate and scale a catalogue's model: +y up, front +z, `width` x `height` x `depth` cm.

    Raises:
        _Unusable: Its rotation or its size leaves it without a finite extent along an axis.
    """
    if "modelRotation" in metadata:
        rotation = np.array(metadata["modelRotation"].split(), float).reshape(3, 3)
        mesh.vertices = mesh.vertices @ rotation.T
    sizes = [metadata.get(field) for field in ("width", "height", "depth")]
    with np.errstate(divide="ignore", invalid="ignore"):
        if all(sizes):
            mesh.vertices *= np.array(sizes, float).clip(min=0) / 100 / mesh.extents
        extents = mesh.extents
    if not FLAT * extents.max() < extents.min() < np.inf:
        size = " x ".join(f"{extent:.3g}" for extent in extents)
        raise _Unusable("flat", f"By its catalogue, the mesh measures {size} m.")


def canonical(mesh: trimesh.Trimesh, *, up: str = "y", front: str = "z") -> trimesh.Trimesh:
    """Rotate a mesh so that `up` becomes +y and `front` +z, and centre its box, at the same scale.

    Args:
        mesh: The mesh.
        up: Axis that points up: `x`, `y`, `z`, or one of these with a minus.
        front: Axis along which the object's front looks.

    Raises:
        ValueError: The axes are not perpendicular axes.
    """
    vertices = np.asarray(mesh.vertices) @ axes_to_canonical(up, front).T
    turned = trimesh.Trimesh(vertices, mesh.faces, process=False)
    turned.vertices -= turned.bounds.mean(axis=0)
    return turned


def in_metres(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh, at a size that a depth camera can film.

    Many files are in millimetres, inches or no unit at all, and the noise of a depth camera grows
    with the square of the distance in metres.

    Args:
        mesh: A mesh in any unit, its box centred at the origin.

    Returns:
        The mesh itself if its diagonal in metres is plausible for an object in a room; otherwise
        the mesh scaled to a diagonal of 1 m.
    """
    if SMALLEST <= mesh.scale <= LARGEST:
        return mesh
    return trimesh.Trimesh(np.asarray(mesh.vertices) / mesh.scale, mesh.faces, process=False)


def axes_to_canonical(up: str, front: str) -> Float[np.ndarray, "3 3"]:
    """Return the rotation that maps the axis named `up` to +y and the one named `front` to +z."""
    check_axes(up, front)
    y, z = axis_named(up), axis_named(front)
    return np.stack([np.cross(y, z), y, z])


def axis_named(name: str) -> Float[np.ndarray, " 3"]:
    """The direction of an axis, as "y" or "-z"."""
    return (-1.0 if name[0] == "-" else 1.0) * np.eye(3)["xyz".index(name[-1])]


def sample_surface(mesh: trimesh.Trimesh, count: int, seed: int) -> Float[np.ndarray, "n 3"]:
    """Sample points on the surface, uniformly in area; the same seed gives the same points.

    The area is divided into equal strata with one point in each, so that every part whose area is
    at least that of two points is hit, however thin it is.

    Args:
        mesh: The mesh.
        count: Number of points.
        seed: Seed of the points.
    """
    return sample_oriented(mesh, count, seed)[0]


def sample_oriented(
    mesh: trimesh.Trimesh, count: int, seed: int
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """The points of `sample_surface`, and the normals of their triangles, of length 1.

    Args:
        mesh: The mesh.
        count: Number of points.
        seed: Seed of the points.
    """
    random = np.random.default_rng(seed)
    area = np.cumsum(trimesh.triangles.area(mesh.triangles))
    position = (np.arange(count) + random.random(count)) / count * area[-1]
    face = np.minimum(np.searchsorted(area, position, side="right"), len(area) - 1)
    # the square root makes points uniform over a triangle with corners a, b, c
    s, t = np.sqrt(random.random(count))[:, None], random.random(count)[:, None]
    a, b, c = np.moveaxis(mesh.triangles[face], 1, 0)
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return (1 - s) * a + s * (1 - t) * b + s * t * c, normals


def lying_on_its_side(mesh: trimesh.Trimesh) -> bool:
    """Return whether a seat in the canonical frame seems to lie on its side or upside down.

    This is a heuristic for seats only. It raised no false alarm on 78 upright seats, and 2 in 100
    on upright chairs made of boxes. Of seats turned on their sides, backs, fronts or heads, it
    recognised 8 to 10 of 10. So trust only its majority over a set of meshes; stools and poufs look
    much the same either way.
    """
    return apparent_up(sample_surface(mesh, 6000, seed=0)) != "y"


def resembles_a_seat(mesh: trimesh.Trimesh) -> bool:
    """Whether a mesh stands like a seat or a table in one of the directions along its axes.

    Args:
        mesh: The mesh, in any orientation.
    """
    return max(up_scores(sample_surface(mesh, 6000, seed=0)).values()) > SEAT
