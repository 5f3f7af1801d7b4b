"""Triangulation of polygons: fans if they are convex, ear clipping if they are not."""

import numpy as np
from jaxtyping import Float, Int

from jaxshape.data.formats.parts import NotSupported, Unreadable, check_faces

MAX_CORNERS = 10_000
"""Largest number of corners of a non-convex polygon: ear clipping may take quadratic time."""


def triangulate(
    vertices: Float[np.ndarray, "v 3"],
    indices: Int[np.ndarray, " n"],
    counts: Int[np.ndarray, " p"],
) -> Int[np.ndarray, "f 3"]:
    """Triangles that cover polygons, in the order of the polygons.

    Args:
        vertices: Corners of all polygons.
        indices: Indices into `vertices`, polygon after polygon.
        counts: Number of corners of each polygon; polygons with fewer than three have no area.

    Returns:
        Indices into `vertices`, `count - 2` triangles for each polygon; fewer if corners repeat.

    Raises:
        NotSupported: A polygon that is not convex has more than `MAX_CORNERS` corners.
        Unreadable: A polygon refers to a vertex that does not exist.
        TooManyFaces: There are too many triangles.
    """
    if len(indices) and not 0 <= indices.min() <= indices.max() < len(vertices):
        raise Unreadable("A face refers to a vertex that the file does not hold.")
    check_faces(int(np.maximum(counts - 2, 0).sum()))
    starts = np.cumsum(counts) - counts
    triangles, owners = [np.zeros((0, 3), np.int64)], [np.zeros(0, np.int64)]
    for count in map(int, np.unique(counts[counts >= 3])):
        which = np.flatnonzero(counts == count)
        polygons = indices[starts[which][:, None] + np.arange(count)]
        convex = _convex(vertices, polygons)
        fans = polygons[convex][:, _fan(count)]
        triangles.append(fans.reshape(-1, 3))
        owners.append(which[convex].repeat(count - 2))
        if count > MAX_CORNERS and not convex.all():
            raise NotSupported(f"A concave polygon has {count} corners, too many; split it.")
        for owner, polygon in zip(which[~convex], polygons[~convex], strict=True):
            cut = polygon[_ears(vertices[polygon])]
            triangles.append(cut)
            owners.append(np.full(len(cut), owner))
    return np.concatenate(triangles)[np.argsort(np.concatenate(owners), kind="stable")]


def _fan(count: int) -> Int[np.ndarray, "f 3"]:
    i = np.arange(1, count - 1)
    return np.stack([np.zeros_like(i), i, i + 1], axis=1)


def _convex(vertices: Float[np.ndarray, "v 3"], polygons: Int[np.ndarray, "p n"]) -> np.ndarray:
    """True for polygons that turn in the same direction at all corners; also for triangles, and for
    polygons with corners that are not finite."""
    if polygons.shape[1] == 3:
        return np.ones(len(polygons), bool)
    corners = vertices[polygons]
    with np.errstate(over="ignore", invalid="ignore"):
        normal = _normals(corners)
        edges = np.roll(corners, -1, axis=1) - corners
        turns = np.einsum("pnd,pd->pn", np.cross(np.roll(edges, 1, axis=1), edges), normal)
        tolerance = 1e-9 * np.einsum("pd,pd->p", normal, normal)
        return ~(turns < -tolerance[:, None]).any(axis=1) | ~np.isfinite(normal).all(axis=1)


def _normals(corners: Float[np.ndarray, "p n 3"]) -> Float[np.ndarray, "p 3"]:
    """Newell's normal, twice as long as the polygon's area."""
    around = corners - corners[:, :1]
    return np.cross(around, np.roll(around, -1, axis=1)).sum(axis=1)


def _ears(corners: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "f 3"]:
    """Triangles of one polygon, by ear clipping in the axis plane with its largest projection."""
    import mapbox_earcut

    normal = _normals(corners[None])[0]
    axis = int(np.argmax(np.abs(normal)))
    across = [(1, 2), (2, 0), (0, 1)][axis]
    flat = np.ascontiguousarray((corners - corners[0])[:, across])
    cut = mapbox_earcut.triangulate_float64(flat, np.array([len(flat)], np.uint32))
    cut = np.asarray(cut, np.int64).reshape(-1, 3)
    a, b, c = flat[cut].transpose(1, 0, 2)
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    backwards = area * normal[axis] < 0  # keep the orientation of the polygon
    cut[backwards] = cut[backwards][:, ::-1]
    return cut
