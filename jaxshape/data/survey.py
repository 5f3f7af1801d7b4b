"""A survey of many meshes before any of them is used, in parallel. [host]

Sizes show the unit, shapes show duplicates in any format, and seats show the axis that points up.
No geometry is kept.
"""

import os
from collections.abc import Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import trimesh

from jaxshape.data.archives import MeshSource
from jaxshape.data.config import UNITS, UnitName
from jaxshape.data.meshes import Skipped, load, lying_on_its_side
from jaxshape.data.pool import Died, in_processes

PLAUSIBLE = 0.05, 5.0
"""Range of median diagonals, in metres, of a plausible collection of objects in a room."""

IN_A_PROCESS = 8
"""Number of meshes from which starting processes pays off."""


class Surveyed(NamedTuple):
    """Size, shape and stance of a mesh.

    Attributes:
        source: The mesh file.
        size: Diagonal of its box, in metres if the unit is right; 0 if the mesh cannot be used.
        signature: Numbers that identify its shape, see `signature_of`; empty if it cannot be used.
        lies: Whether it is a seat that seems to lie on its side.
        skipped: Why the mesh cannot be used; None if it can.
        digest: Digest of the content of its files; empty if it cannot be used.
        notes: Sentences on parts of the file that are not the object and were left out.
    """

    source: MeshSource
    size: float
    signature: tuple[float, ...]
    lies: bool
    skipped: Skipped | None
    digest: str = ""
    notes: tuple[str, ...] = ()


def survey(
    sources: Sequence[MeshSource],
    *,
    up: str = "y",
    front: str = "z",
    unit: UnitName = "m",
    workers: int | None = None,
) -> Iterator[tuple[int, Surveyed]]:
    """Examine each mesh once.

    Args:
        sources: The meshes.
        up: Axis of the files that points up.
        front: Axis of the files towards which the object faces.
        unit: Unit of the files.
        workers: Processes, 1 or more; None for one for each CPU core.

    Yields:
        The index of a mesh in `sources`, and its survey, in the order in which they finish.
    """
    workers = workers or os.cpu_count() or 1
    if len(sources) < IN_A_PROCESS:
        workers = 1
    look_at = partial(look, up=up, front=front, unit=unit)
    for number, found in in_processes(look_at, sources, workers):
        source = sources[number]
        if isinstance(found, Died):
            found = Surveyed(source, 0.0, (), False, Skipped(source.name, "killed", str(found)))
        yield number, found


def look(source: MeshSource, *, up: str, front: str, unit: UnitName) -> Surveyed:
    """Examine one mesh.

    Args:
        source: The mesh.
        up: Axis of the file that points up.
        front: Axis of the file towards which the object faces.
        unit: Unit of the file.
    """
    model = load(source, up=up, front=front, unit=unit)
    if isinstance(model, Skipped):
        return Surveyed(source, 0.0, (), False, model)
    mesh = model.mesh
    lies, size = lying_on_its_side(mesh), float(mesh.scale)
    return Surveyed(source, size, signature_of(mesh), lies, None, model.digest, model.notes)


def signature_of(mesh: trimesh.Trimesh) -> tuple[float, ...]:
    """Thirteen numbers of a shape that do not change when it is scaled, moved, turned to other
    axes, divided into other triangles, or written in another format.

    They are integrals over the surface, as shares of the diagonal: area, extents, centre and second
    moments, in an order that does not depend on the axes.

    Args:
        mesh: The mesh.
    """
    corners = np.asarray(mesh.triangles, np.float64)
    corners = (corners - mesh.bounds.mean(axis=0)) / mesh.scale
    area = trimesh.triangles.area(corners)
    total, around = area.sum(), corners.sum(axis=1)
    center = np.einsum("f,fd->d", area, around) / 3 / total
    second = np.einsum("f,fcd,fce->de", area, corners, corners)
    second = (second + np.einsum("f,fd,fe->de", area, around, around)) / 12 / total
    second -= np.outer(center, center)
    values = [
        mesh.extents / mesh.scale,
        np.abs(center),
        np.sqrt(np.maximum(np.diag(second), 0)),
        np.abs(second[np.triu_indices(3, 1)]),
    ]
    return (float(np.sqrt(total)), *(float(x) for group in values for x in np.sort(group)))


def doubted_size(sizes: Sequence[float], unit: UnitName) -> str | None:
    """A sentence on the unit of a collection, if its sizes are implausible for objects in a room.

    Args:
        sizes: Diagonals of its meshes, in metres if the unit is right.
        unit: The unit in which they were read.

    Returns:
        A sentence with the problem and a remedy; None without a problem.
    """
    median = float(np.median(sizes)) if len(sizes) else 1.0
    low, high = PLAUSIBLE
    if low <= median <= high:
        return None
    sizes_in = {name: median / UNITS[unit] * scale for name, scale in UNITS.items()}
    fitting = [f"--unit {n} ({size:.2g} m)" for n, size in sizes_in.items() if low <= size <= high]
    remedy = f"give {' or '.join(fitting)}" if fitting else "scale the files"
    return (
        f"The {len(sizes)} meshes have a median size of {median:.3g} m if their unit is {unit}, "
        f"a size that nothing in a room has; {remedy}. The noise of a depth camera depends on "
        "sizes: meshes below 5 cm or above 10 m are filmed as if they were 1 m large."
    )


def evenly(sources: Sequence[MeshSource], count: int) -> list[MeshSource]:
    """Some of the meshes, spread evenly over the collection.

    Args:
        sources: All meshes.
        count: Largest number of meshes, 1 or more.
    """
    chosen = np.unique(np.linspace(0, len(sources) - 1, min(count, len(sources))).astype(int))
    return [sources[i] for i in chosen]
