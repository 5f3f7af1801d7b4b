"""Whether a seat stands on its feet: a warning for meshes read with the wrong up axis.

Each of the six directions along the axes is scored as the seat's up direction: a seat stands on
a few points far apart, has one large level surface near half height, and is not the same when
turned over, while nearly every seat is the same left and right.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull, KDTree, QhullError

DIRECTIONS = ("y", "-y", "z", "-z", "x", "-x")

MARGIN = 0.35
"""Margin by which another direction must score better than +y: of 78 upright real seats,
the one that came closest to a false alarm reached 0.28."""

SEAT = 1.1
"""Score that every seat reaches in its best direction: the lowest of 26 real seats has 1.18, a box
0.9, and a cylinder 0.8."""

CELLS = 16
"""Cells along each axis of the grid that detects level surfaces; the outermost are contact."""


def apparent_up(points: Float[np.ndarray, "n 3"]) -> str:
    """The axis of a seat that seems to point up: `y`, unless another one is clearly more probable.

    For a mesh that is not a seat, the result is `y`. `points` are some thousands, spread evenly
    over the surface.
    """
    scores = up_scores(points)
    best = max(scores, key=lambda direction: scores[direction])
    return best if scores[best] > max(scores["y"] + MARGIN, SEAT) else "y"


def up_scores(points: Float[np.ndarray, "n 3"]) -> dict[str, float]:
    """Score each of `DIRECTIONS` as the up direction; only differences of scores have a meaning."""
    extents = np.ptp(points, axis=0)
    unit = (points - points.min(axis=0)) / extents
    occupied = np.zeros((CELLS,) * 3, bool)
    occupied[tuple(np.minimum((unit * CELLS).astype(int), CELLS - 1).T)] = True
    asymmetry = _asymmetry(unit, extents)
    scores = {}
    for direction in DIRECTIONS:
        axis = "xyz".index(direction[-1])
        layers = occupied.mean(axis=tuple({0, 1, 2} - {axis}))
        height, across = unit[:, axis], np.delete(unit, axis, axis=1)
        if direction[0] == "-":
            layers, height = layers[::-1], 1 - height
        stance_below = _spread(across, height < 0.05) - 0.5 * layers[0]
        stance_above = _spread(across, height > 0.95) - 0.5 * layers[-1]
        level = layers.max() - 0.5 * abs((np.argmax(layers) + 0.5) / CELLS - 0.45)
        # every seat is asymmetric beyond 0.06 of its size along some axis: more is no evidence
        score = 0.5 * (stance_below - stance_above) + level + 15 * min(asymmetry[axis], 0.06)
        scores[direction] = float(score)
    return scores


def _asymmetry(
    unit: Float[np.ndarray, "n 3"], extents: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3"]:
    """Mean distance of the mirror image along each axis to the shape, over the shape's diagonal."""
    points = (unit - 0.5) * extents
    tree = KDTree(points)
    distance = [tree.query(points * mirror)[0].mean() for mirror in 1 - 2 * np.eye(3)]
    return np.array(distance) / np.linalg.norm(extents)


def _spread(across: Float[np.ndarray, "n 2"], chosen: Bool[np.ndarray, " n"]) -> float:
    """Area that the chosen points span, as a fraction of the area that all points span."""
    return _hull_area(across[chosen]) / _hull_area(across)


def _hull_area(points: Float[np.ndarray, "n 2"]) -> float:
    try:
        return float(ConvexHull(points).volume)
    except (QhullError, ValueError):  # too few points, or all on a line
        return 0.0
