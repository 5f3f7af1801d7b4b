"""Agreement of a predicted grid or surface with the true one: IoU, Chamfer-L1, F-score. [host]"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float
from scipy.spatial import KDTree

from jaxshape.geometry.overlap import iou

F_SCORE_THRESHOLD = 0.01
"""Distance up to which two points agree, as a fraction of the side of the grid's cube."""

WORST_CHAMFER = 1.0
"""The Chamfer distance when one of two shapes is empty: a whole diagonal, so that means stay
finite and a method cannot gain by predicting nothing."""


class Bounds(NamedTuple):
    """IoU of the measurements alone, with two ways to fill in the occluded voxels; leading axes are
    batch axes.

    Attributes:
        occluded_empty: IoU, from 0 to 1, with every occluded voxel taken as free `[*batch]`.
        occluded_full: IoU, from 0 to 1, with every occluded voxel taken as occupied `[*batch]`.
    """

    occluded_empty: Float[Array, "..."]
    occluded_full: Float[Array, "..."]


def bounds(
    occupied: Bool[Array | np.ndarray, "*#batch x y z"],
    occluded: Bool[Array | np.ndarray, "*#batch x y z"],
    truth: Bool[Array | np.ndarray, "*#batch x y z"],
) -> Bounds:
    """IoU of F with all occluded voxels set to empty, and to full.

    These are the two curves that the paper draws as bounds (section 4.1); either can be the higher
    one.

    Args:
        occupied: F `[*batch x y z]`, binary. Leading axes broadcast.
        occluded: M `[*batch x y z]`, binary.
        truth: True surface voxels `[*batch x y z]`.
    """
    return Bounds(iou(occupied & ~occluded, truth), iou(occupied | occluded, truth))


def chamfer_l1(
    points_a: Float[np.ndarray, "n 3"], points_b: Float[np.ndarray, "m 3"], diagonal: float
) -> float:
    """Chamfer-L1 distance of two point sets, as a fraction of a bounding-box diagonal. [host]

    It is the mean distance from a point of one set to the nearest of the other, not squared,
    averaged over the two directions and divided by the diagonal. 0.01 means that surfaces are 1 %
    of the diagonal apart on average.

    Args:
        points_a: Points of one set `[n 3]`, in any unit.
        points_b: Points of the other set `[m 3]`, in the same unit.
        diagonal: Diagonal of the bounding box of the true shape, above 0, in the unit of the
            points.

    Returns:
        A number from 0; 0 where both sets are empty, 1 where one is.
    """
    if not len(points_a) or not len(points_b):
        return 0.0 if len(points_a) == len(points_b) else WORST_CHAMFER
    a_to_b, b_to_a = _nearest_distances(points_a, points_b)
    return float((a_to_b.mean() + b_to_a.mean()) / 2 / diagonal)


def f_score(
    points_a: Float[np.ndarray, "n 3"], points_b: Float[np.ndarray, "m 3"], threshold: float
) -> float:
    """Harmonic mean of the two fractions of points that lie near the other set. [host]

    Args:
        points_a: Points of one set `[n 3]`, in any unit.
        points_b: Points of the other set `[m 3]`, in the same unit.
        threshold: Distance up to which a point is near, itself included, in the unit of the points:
            0.01 where the grid's cube (the whole grid, not the object in it) has side 1.

    Returns:
        A number from 0 to 1; 0 where both fractions are 0, or a set is empty.
    """
    if not len(points_a) or not len(points_b):
        return 0.0
    precision, recall = (
        np.mean(distance <= threshold) for distance in _nearest_distances(points_a, points_b)
    )
    total = precision + recall
    return float(2 * precision * recall / total) if total > 0 else 0.0


def _nearest_distances(
    points_a: Float[np.ndarray, "n 3"], points_b: Float[np.ndarray, "m 3"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " m"]]:
    a_to_b, _ = KDTree(points_b).query(points_a)
    b_to_a, _ = KDTree(points_a).query(points_b)
    return a_to_b, b_to_a


class ShapeScores(NamedTuple):
    """Agreement of two grids.

    Attributes:
        iou: Intersection over union of the voxels, from 0 to 1; higher is better.
        chamfer_l1: Chamfer-L1 distance as a fraction of the diagonal of the true surface's bounding
            box, in grid units, from 0; lower is better.
        f_score: F-score at 1 % of the grid's side, from 0 to 1; higher is better.
    """

    iou: float
    chamfer_l1: float
    f_score: float


def shape_scores(
    predicted: Bool[Array | np.ndarray, "x y z"], truth: Bool[Array | np.ndarray, "x y z"]
) -> ShapeScores:
    """Score one predicted grid against the true one, in units of the grid's cube. [host]

    The point sets are centres of the voxel faces between occupied and free (`boundary_points`), so
    that equal grids score 0 and 1 without sampling noise. With 32 voxels along an axis, 1 % of the
    cube is a third of a voxel, and no other point lies that near: the F-score is the share of the
    voxels' surface that is exactly right. A grid's axes each have their own scale, so distances are
    those of the cube, not metres.

    Args:
        predicted: Occupied voxels of the prediction `[x y z]`.
        truth: Occupied voxels of the true shape `[x y z]`.

    Returns:
        The scores. An empty prediction of a shape has the worst values, IoU 0, Chamfer 1, F-score
        0; two empty grids have 1, 0, 0.
    """
    points, true_points = boundary_points(predicted), boundary_points(truth)
    diagonal = float(np.linalg.norm(np.ptp(true_points, axis=0))) if len(true_points) else 1.0
    return ShapeScores(
        float(iou(predicted, truth)),
        chamfer_l1(points, true_points, diagonal),
        f_score(points, true_points, F_SCORE_THRESHOLD),
    )


class OccludedScores(NamedTuple):
    """Agreement of a shape with the true one where nothing was measured; leading axes are batch
    axes.

    Attributes:
        iou: Intersection over union of the composed shape with the true one among the occluded
            voxels, from 0 to 1. Where none of them holds a piece of the true surface, 1 if none is
            filled and 0 otherwise.
        cross_entropy: Mean over the occluded voxels, in nats for each of them, of the logits that
            fill them; 0 where there are none.
    """

    iou: Float[Array, "..."]
    cross_entropy: Float[Array, "..."]


def occluded_scores(
    composed: Bool[Array | np.ndarray, "*batch x y z"],
    logits: Float[Array | np.ndarray, "*batch x y z"],
    occluded: Float[Array | np.ndarray, "*batch x y z"] | Bool[Array | np.ndarray, "*batch x y z"],
    truth: Bool[Array | np.ndarray, "*batch x y z"],
) -> OccludedScores:
    """Score the shape in the occluded voxels, which are those more likely unknown than not.

    Args:
        composed: The composed shape `[*batch x y z]`.
        logits: Logits of the shape that fills them `[*batch x y z]`.
        occluded: M `[*batch x y z]`, binary or soft: voxels above 1/2 count.
        truth: True surface voxels `[*batch x y z]`.
    """
    hidden, axes = jnp.asarray(occluded) > 0.5, (-3, -2, -1)
    loss = optax.sigmoid_binary_cross_entropy(jnp.asarray(logits), jnp.asarray(truth, jnp.float32))
    total = jnp.sum(loss, axis=axes, where=hidden)
    return OccludedScores(
        iou(composed & hidden, truth & hidden),
        total / jnp.maximum(jnp.sum(hidden, axis=axes), 1),
    )


def boundary_points(occupied: Bool[Array | np.ndarray, "x y z"]) -> Float[np.ndarray, "n 3"]:
    """Return the centre of every voxel face between occupied and free, in units of the grid side.

    These are the vertices of the marching-cubes surface of a boolean grid at level 0.5, one for
    each unit of the voxels' area: an even and exact sample of it. Outside the grid is free.
    """
    padded = np.pad(np.asarray(occupied), 1)
    points = []
    for axis in range(3):
        faces = np.argwhere(np.diff(padded, axis=axis))  # between voxel i - 1 and i, unpadded
        points.append(faces + np.where(np.arange(3) == axis, 0.0, -0.5))
    return np.concatenate(points) / max(np.shape(occupied))


class Reliability(NamedTuple):
    """Predicted probabilities and observed frequencies of occupied voxels, in equal bins.

    Attributes:
        predicted: Mean probability of the voxels in each bin `[bin]`; 0 where there are none.
        occurred: Share of them that are occupied `[bin]`; 0 where there are none.
        share: Share of all voxels that are in the bin `[bin]`.
    """

    predicted: Float[np.ndarray, " bin"]
    occurred: Float[np.ndarray, " bin"]
    share: Float[np.ndarray, " bin"]

    @property
    def error(self) -> float:
        """The expected calibration error: the mean of |predicted - occurred| over voxels."""
        return float(np.abs(self.predicted - self.occurred) @ self.share)


def reliability(
    probability: Float[np.ndarray, " n"], occupied: Bool[np.ndarray, " n"], bins: int = 15
) -> Reliability:
    """Compare predicted probabilities with the true occupancy of voxels. [host]

    Args:
        probability: Probabilities of voxels `[n]`, from 0 to 1.
        occupied: Whether each voxel is occupied `[n]`.
        bins: Bins of equal width, 1 or more.
    """
    place = np.minimum((probability * bins).astype(int), bins - 1)
    count, predicted, occurred = (
        np.bincount(place, weights, bins).astype(np.float64)
        for weights in (None, probability, occupied)
    )
    some = np.maximum(count, 1)
    return Reliability(predicted / some, occurred / some, count / max(count.sum(), 1))
