"""Choose the meshes of a collection that are kept out of training, by their shapes. [host]"""

import hashlib
from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from jaxshape.data.archives import MeshSource
from jaxshape.data.survey import Surveyed

SHARE = 0.1
"""Share of the meshes that are held out."""

SAME = 1e-3
"""Signatures whose numbers all differ by less than this belong to the same shape."""

COARSE = 2
"""Number of decimals of a signature that decide the side of a mesh."""


def hold_out(meshes: Sequence[Surveyed]) -> tuple[list[MeshSource], list[Surveyed]]:
    """Split meshes into training meshes and held-out ones: about every tenth, at least one.

    The side depends only on the shape, not on the name, the folder or the format. A mesh therefore
    stays on its side when others join the collection: training can continue from earlier weights
    and never uses a mesh that it is scored on. Copies of a mesh are on the same side.

    Args:
        meshes: Meshes of the collection, of which two or more are usable and differ.

    Returns:
        The meshes to train on, including unusable ones, and the held-out meshes.

    Raises:
        ValueError: There are fewer than two different meshes.
    """
    usable = [mesh for mesh in meshes if mesh.skipped is None]
    groups = same_shapes(usable)
    count = len(set(groups))
    if count < 2:
        raise ValueError(
            f"{'Only 1 mesh' if len(usable) == 1 else f'{len(usable)} meshes'} of {count} shape "
            "can be used; give meshes of two or more shapes, to train on some and score on others."
        )
    marks: dict[int, float] = {}
    for group, mesh in zip(groups, usable, strict=True):
        marks[group] = min(_mark(mesh), marks.get(group, 1.0))
    chosen = sorted(marks, key=lambda group: marks[group])
    marked = sum(mark < SHARE for mark in marks.values())
    kept_out = set(chosen[: min(max(marked, 1), count - 1)])
    held_out = [mesh for group, mesh in zip(groups, usable, strict=True) if group in kept_out]
    places = {(mesh.source.path, mesh.source.member) for mesh in held_out}
    training = [mesh.source for mesh in meshes]
    return [s for s in training if (s.path, s.member) not in places], held_out


def same_shapes(meshes: Sequence[Surveyed]) -> list[int]:
    """A number for each mesh, equal for meshes of the same shape.

    Args:
        meshes: Meshes that can be used.
    """
    if not meshes:
        return []
    tree = KDTree([mesh.signature for mesh in meshes])
    a, b = tree.query_pairs(SAME, p=np.inf, output_type="ndarray").T
    near = coo_matrix((np.ones(len(a)), (a, b)), (len(meshes), len(meshes)))
    return connected_components(near, directed=False)[1].tolist()


def _mark(mesh: Surveyed) -> float:
    """A pseudo-random number from 0 to 1, uniformly distributed over shapes."""
    rounded = " ".join(f"{value:.{COARSE}f}" for value in mesh.signature)
    return int.from_bytes(hashlib.sha256(rounded.encode()).digest()[:8]) / 2**64
