"""The first triangle on each ray of an image, without Embree. [host]"""

import numpy as np
from jaxtyping import Bool, Float, Integer

PAIRS = 1_000_000
"""Pairs of a triangle and a pixel that the rasteriser tests together."""


def rasterize(
    corners: Float[np.ndarray, "f 3 3"],
    depth: Float[np.ndarray, "f 3"],
    columns: Float[np.ndarray, " w"],
    rows: Float[np.ndarray, " h"],
) -> Integer[np.ndarray, "h w"]:
    """The nearest triangle at each pixel of an image; -1 where there is none.

    Corners are homogeneous points (X, Y, W) of the image plane, at x = X / W and y = Y / W. With
    W = Z they are those of a pinhole camera, with W = 1 those of a camera with parallel rays.

    Args:
        corners: Corners of the triangles `[f 3 3]`.
        depth: Depths of the corners `[f 3]`; surface at depths of 0 and below is not seen.
        columns: x of the columns of pixels, increasing `[w]`.
        rows: y of the rows of pixels, increasing `[h]`.
    """
    nearest = np.full(len(rows) * len(columns), np.inf)
    first = np.full(len(nearest), -1)
    i, j, k = corners[:, 0], corners[:, 1], corners[:, 2]
    opposite = np.stack([np.cross(j, k), np.cross(k, i), np.cross(i, j)], axis=1)
    in_front = np.asarray((corners[..., 2] > 0).all(axis=1))
    left, right = _covered(corners[..., 0], corners[..., 2], in_front, columns)
    top, bottom = _covered(corners[..., 1], corners[..., 2], in_front, rows)
    width, count = right - left, (right - left) * (bottom - top)
    start = np.concatenate([[0], np.cumsum(count)])
    begin = 0
    while begin < len(corners):
        end = max(begin + 1, int(np.searchsorted(start, start[begin] + PAIRS, "right")) - 1)
        chosen = np.arange(begin, end)
        triangle = np.repeat(chosen, count[chosen])
        place = np.arange(start[begin], start[end]) - start[triangle]
        row = top[triangle] + place // np.maximum(width[triangle], 1)
        column = left[triangle] + place % np.maximum(width[triangle], 1)
        rays = np.stack([columns[column], rows[row], np.ones(len(row))], axis=1)
        # Volumes of the ray with the edge opposite of each corner: its share of the point.
        share = np.einsum("nd,nkd->nk", rays, opposite[triangle])
        whole = share.sum(axis=1)
        inside = ((share >= 0).all(axis=1) | (share <= 0).all(axis=1)) & (whole != 0)
        z = (share * depth[triangle]).sum(axis=1)[inside] / whole[inside]
        triangle, pixel = triangle[inside], (row * len(columns) + column)[inside]
        order = np.lexsort((z, pixel))
        order = order[z[order] > 0]
        order = order[np.diff(pixel[order], prepend=-1) != 0]
        order = order[z[order] < nearest[pixel[order]]]
        nearest[pixel[order]], first[pixel[order]] = z[order], triangle[order]
        begin = end
    return first.reshape(len(rows), len(columns))


def _covered(
    along: Float[np.ndarray, "f 3"],
    w: Float[np.ndarray, "f 3"],
    in_front: Bool[np.ndarray, " f"],
    centers: Float[np.ndarray, " n"],
) -> tuple[Integer[np.ndarray, " f"], Integer[np.ndarray, " f"]]:
    """First pixel that each triangle may cover along an axis, and the one after its last."""
    place = along / np.where(w > 0, w, 1)
    slack = 1e-6 * np.ptp(centers)
    first = np.searchsorted(centers, place.min(axis=1) - slack)
    last = np.searchsorted(centers, place.max(axis=1) + slack, "right")
    return np.where(in_front, first, 0), np.where(in_front, last, len(centers))
