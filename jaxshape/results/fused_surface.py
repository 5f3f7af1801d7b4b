"""One mesh of the measured and the decoded surface, at the resolution of the fine grid. [host]

The measured surface is where the fused signed distance changes its sign. Where nothing was
measured, decoded logits serve as distances. Beyond the edge of the measured surface, its distances
continue and fade out over six fine voxels, so that both surfaces meet without a step. They fade out
much sooner where they would form a fin in space that the decoded shape leaves free.
"""

from functools import partial
from typing import NamedTuple

import jax
import numpy as np
import trimesh
from jaxtyping import Array, Bool, Float
from scipy import ndimage
from skimage.measure import label, marching_cubes

from jaxshape.geometry import evidence
from jaxshape.geometry.distance import DistanceField, mean_distance
from jaxshape.geometry.grid import GridFrame

REACH, FIN = 6.0, 1.6
"""Number of fine voxels over which measured distances fade out beyond the edge of the measured
surface; and the same number where they are solid and the decoded shape is free."""

ROUNDS = 30
"""Number of rounds of Taubin's filter, which removes the grain that the noise of few frames leaves.
On CAD seats it makes the measured surface more exact. Averaging the distances themselves makes the
surface less exact, because this moves the sides of thin parts."""

NATS = 0.25
"""Logit at the decoded surface: above 0, because occupied voxels reach beyond the surface in them.
"""

NATS_PER_VOXEL = 6.0
"""Slope of logits across a decoded surface."""

DEEP = 1.5
"""Depth behind a surface, in fine voxels, down to which measured distances are trusted."""

FAR, NEAR = 3.0, 0.5
"""Largest distance that is stored, and distance within which a vertex lies on the measured surface,
in fine voxels."""

LITTLE, LESS, AROUND = 0.03, 0.25, 7
"""Weight at which a measured distance counts as much as the smooth surface around it: the first
value, or, if that is more, the second value as a share of the greatest weight in a cube with the
third number of fine voxels per side. Edges are ragged where few frames agree."""

CRUMB = 0.01
"""Share of the largest piece's area below which a loose piece is dropped wherever it lies."""

FLOOR = 1.0
"""Voxels above the lowest occupied height within which a loose piece stands on the floor."""


class FusedSurface(NamedTuple):
    """A mesh, and the source of its vertices.

    Attributes:
        mesh: Mesh in the object frame, in metres; normals point outwards.
        measured: True for vertices on the measured surface, False for predicted ones.
        dropped: Number of loose pieces that were left out.
    """

    mesh: trimesh.Trimesh
    measured: Bool[np.ndarray, " n"]
    dropped: int


def fuse_surface(
    field: DistanceField, logits: Float[Array | np.ndarray, "x y z"], frame: GridFrame
) -> FusedSurface:
    """The measured surface, completed by the decoded shape where nothing was measured.

    Args:
        field: Field of one object, on a grid whose side is a multiple of the logits' side.
        logits: Logits of the decoded shape.
        frame: Frame of the decoded grid, in the object frame.

    Returns:
        A closed mesh, except for loose pieces that touch neither the largest piece nor the floor.

    Raises:
        ValueError: Where neither a surface was measured nor a shape decoded.
    """
    fine = field.weight.shape[-1]
    scale = logits.shape[-1] / fine * np.asarray(frame.voxel_size, np.float64)
    distance, seen = combine(field, np.asarray(logits), float(scale.max()))
    if not (distance < 0).any():
        raise ValueError(
            "There is no surface: nothing was measured inside the box and no logit is above "
            f"{NATS}. Check the box and the segmentation."
        )
    padded = np.pad(distance, 1, constant_values=max(distance.max(), 1e-3))  # closed at the border
    vertices, faces, _, _ = marching_cubes(padded, 0.0, gradient_direction="ascent")
    vertices -= 0.5  # of the padded grid, whose first centre is at -0.5
    away = ndimage.map_coordinates(seen, (vertices - 0.5).T, order=1, mode="nearest")
    mesh = trimesh.Trimesh(
        np.asarray(frame.origin, np.float64) + vertices * scale, faces, process=False
    )
    if mesh.volume < 0:
        mesh.invert()
    trimesh.smoothing.filter_taubin(mesh, lamb=0.5, nu=0.525, iterations=ROUNDS)
    measured = _settled(mesh, np.abs(away) < NEAR)
    return _without_loose_pieces(mesh, measured, float(frame.voxel_size[1]))


def combine(
    field: DistanceField, logits: Float[np.ndarray, "x y z"], voxel: float
) -> tuple[Float[np.ndarray, "X Y Z"], Float[np.ndarray, "X Y Z"]]:
    """Signed distances of the whole shape, and the measured signed distances.

    Args:
        field: Field of one object.
        logits: Logits of the decoded shape.
        voxel: Metres that count as 1 in the distances: the side of a fine voxel.

    Returns:
        Distances at the centres of fine voxels, and the measured ones, which are large where
        nothing was measured.
    """
    resolution = len(logits)
    measured, trusted, free, seen_free = jax.device_get(_measured(field, resolution))
    measured = measured / voxel
    scale = len(measured) // resolution
    trusted = _within_margin(trusted & (measured > -DEEP), 3 * scale // 4)
    decoded = _decoded(logits, seen_free, scale)
    if not trusted.any():
        return decoded, np.full_like(decoded, FAR)
    distance = _carried_on(measured, trusted, decoded)
    # Free space is smoothed as a whole, so that single rays leave neither holes nor spikes.
    passed = ndimage.gaussian_filter((free & ~trusted).astype(np.float32), 1.0)
    distance = np.maximum(ndimage.gaussian_filter(distance, 1.0), FAR * (2 * passed - 1))
    weight = np.where(trusted, np.asarray(field.weight), 0)
    little = np.maximum(LITTLE, LESS * ndimage.maximum_filter(weight, AROUND))
    certainty = weight**2 / (weight**2 + little**2)
    distance = certainty * measured + (1 - certainty) * distance
    return _filled(distance, free), np.where(trusted, measured, FAR).clip(-FAR, FAR)


@partial(jax.jit, static_argnums=1)
def _measured(field: DistanceField, resolution: int) -> tuple[Array, Array, Array, Array]:
    free = evidence.evidence(field, resolution).free
    return mean_distance(field), evidence.is_trusted(field), field.free > 0.5, free


def _within_margin(trusted: Bool[np.ndarray, "X Y Z"], width: int) -> Bool[np.ndarray, "X Y Z"]:
    """Trusted voxels, without the free margin of the box, in which only the floor is seen."""
    inner = slice(width, len(trusted) - width)
    kept = np.zeros_like(trusted)
    kept[inner, inner, inner] = trusted[inner, inner, inner]
    return kept


def _decoded(
    logits: Float[np.ndarray, "x y z"], free: Float[np.ndarray, "x y z"], scale: int
) -> Float[np.ndarray, "X Y Z"]:
    """Logits as distances, in fine voxels; voxels that were seen to be free are not filled."""
    occupied = ((1 - free) / (1 + np.exp(-logits))).clip(1e-6, 1 - 1e-6)
    logits = np.log(occupied / (1 - occupied))
    return _upsample((NATS - logits) / NATS_PER_VOXEL * scale, scale).clip(-FAR, FAR)


def _carried_on(
    measured: Float[np.ndarray, "X Y Z"],
    trusted: Bool[np.ndarray, "X Y Z"],
    decoded: Float[np.ndarray, "X Y Z"],
) -> Float[np.ndarray, "X Y Z"]:
    """Measured distances that fade into decoded ones beyond the edge of the measured surface."""
    nearest = np.asarray(
        ndimage.distance_transform_edt(~trusted, return_distances=False, return_indices=True)
    )
    away = np.sqrt(((nearest - np.indices(trusted.shape, np.int32)) ** 2).sum(axis=0))
    carried = measured[tuple(nearest)].clip(-FAR, FAR)
    reach = np.where((carried < 0) & (decoded > 0), FIN, REACH)
    share = np.clip(1 - away / reach, 0, 1)
    return share * carried + (1 - share) * decoded


def _upsample(coarse: Float[np.ndarray, "x y z"], scale: int) -> Float[np.ndarray, "X Y Z"]:
    """Upsample a grid: linear between voxel centres, constant beyond the outermost ones."""
    at = (np.arange(scale * len(coarse)) + 0.5) / scale - 0.5
    for axis in range(3):
        low = np.clip(np.floor(at).astype(int), 0, coarse.shape[axis] - 2)
        share = np.clip(at - low, 0, 1).reshape([-1 if i == axis else 1 for i in range(3)])
        coarse = (1 - share) * np.take(coarse, low, axis) + share * np.take(coarse, low + 1, axis)
    return coarse


def _filled(
    distance: Float[np.ndarray, "X Y Z"], free: Bool[np.ndarray, "X Y Z"]
) -> Float[np.ndarray, "X Y Z"]:
    """The shape without cavities: shells hide the inside of solids, which no frame sees."""
    outside = np.pad(distance > 0, 1, constant_values=True)
    labels = np.asarray(label(outside, connectivity=1))
    seen = np.zeros(labels.max() + 1, bool)
    seen[labels[1:-1, 1:-1, 1:-1][free & (distance > 0)]] = True
    seen[labels[0, 0, 0]] = True
    cavity = (labels > 0) & ~seen[labels]
    return np.where(cavity[1:-1, 1:-1, 1:-1], -1.0, distance)


def _settled(
    mesh: trimesh.Trimesh, measured: Bool[np.ndarray, " n"], rounds: int = 4
) -> Bool[np.ndarray, " n"]:
    """Flags by majority of each vertex and its neighbours, so that borders have no speckles."""
    one, other = mesh.edges.T
    count = np.bincount(one, minlength=len(measured)) + 1
    for _ in range(rounds):
        votes = measured + np.bincount(one, weights=measured[other], minlength=len(measured))
        measured = 2 * votes > count
    return measured


def _without_loose_pieces(
    mesh: trimesh.Trimesh, measured: Bool[np.ndarray, " n"], voxel: float
) -> FusedSurface:
    """Keep the largest piece, and those that stand on the floor with it."""
    labels = trimesh.graph.connected_component_labels(mesh.edges, node_count=len(mesh.vertices))
    area = np.bincount(labels[mesh.faces[:, 0]], weights=mesh.area_faces)
    lowest = np.full(len(area), np.inf)
    np.minimum.at(lowest, labels, mesh.vertices[:, 1])
    main = int(np.argmax(area))
    keep = (lowest < mesh.vertices[:, 1].min() + FLOOR * voxel) & (area > CRUMB * area[main])
    keep[main] = True
    vertex = keep[labels]
    index = np.cumsum(vertex) - 1
    faces = index[mesh.faces[vertex[mesh.faces[:, 0]]]]
    kept = trimesh.Trimesh(mesh.vertices[vertex], faces, process=False)
    return FusedSurface(kept, measured[vertex], int((~keep).sum()))
