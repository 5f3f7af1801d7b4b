"""The composed shape: measured voxels, and a decoded shape in the others (paper, section 2.4)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxshape.geometry.evidence import from_grids
from jaxshape.geometry.grids import Grid, Grids
from jaxshape.geometry.symmetry import NATS, mirrored, symmetrised
from jaxshape.model.calibration import Calibration

LEARNT_NATS = 1.0
"""Nats that a measured mirror image adds when the decoder has already taken it into account."""

LEAST_PROBABILITY = 1 / 3
"""Least probability of a voxel that is filled, however uncertain the whole shape is."""


class Composition(NamedTuple):
    """A composed shape and its parts; leading axes are batch axes.

    Attributes:
        composed: Measured voxels as measured, occluded voxels from the filling `[*batch x y z]`.
        logits: Logits of the filling `[*batch x y z]`.
        symmetric: Whether the filling is mirrored `[*batch]`; None without `symmetry`.
        agreement: Share of the surface measured on both sides that agrees, 0 to 1 `[*batch]`; None
            without `symmetry`.
    """

    composed: Bool[Array, "*batch x y z"]
    logits: Float[Array, "*batch x y z"]
    symmetric: Bool[Array, "*batch"] | None
    agreement: Float[Array, "*batch"] | None


def complete(
    grids: Grids,
    logits: Float[Array, "*batch x y z"],
    *,
    symmetry: bool,
    conditional: bool = False,
    calibration: Calibration | None = None,
) -> Composition:
    """Fill unmeasured voxels with a decoded shape and with the mirror image of measured ones.

    Args:
        grids: F and M of the objects `[*batch x y z]`, binary or soft.
        logits: Logits of their decoded shapes `[*batch x y z]`.
        symmetry: If the measured halves of an object agree, average its decoded shape with the
            mirror image and add the evidence of the other side.
        conditional: The decoder took the measurement (`ShapeModel.conditional`). Its shape then
            also counts in measured voxels, and only occluded voxels are averaged with the mirror
            image.
        calibration: Map from the logits of a conditional decoder to probabilities in occluded
            voxels. With it, the composed shape is the one of greatest expected IoU
            (`best_threshold`); None takes the voxels with a probability above 1/2.
    """
    seen, symmetric, agreement = from_grids(grids), None, None
    if symmetry:
        other = mirrored(seen, LEARNT_NATS if conditional else NATS)
        mean = symmetrised(logits, other)
        logits = known_or(Grids(logits, grids.occluded), mean) if conditional else mean
        symmetric, agreement = other.symmetric, other.agreement
    probability, threshold = jax.nn.sigmoid(logits), 0.5
    if not conditional:
        probability = known_or(grids, probability)
    elif calibration is None:
        probability = agreed(*grids[:2], probability)
    else:
        hidden = calibration.probability(logits, jnp.zeros_like(logits))
        probability = agreed(*grids[:2], known_or(Grids(probability, grids.occluded), hidden))
        threshold = best_threshold(probability)[..., None, None, None]
    return Composition(probability > threshold, logits, symmetric, agreement)


def best_threshold(probability: Float[Array, "*batch x y z"]) -> Float[Array, "*batch"]:
    """The probability above which voxels belong to the shape of greatest expected IoU.

    Among all sets with a given number of voxels, that of the most probable voxels has the greatest
    expected intersection with the true surface. So the voxels are sorted, and IoU* is the greatest
    ratio of expected intersection to expected union. One more voxel raises this ratio if its
    probability is above IoU* / (1 + IoU*): 1/2 if everything is certain, less otherwise (Lipton et
    al., "Optimal thresholding of classifiers to maximize F1 measure", 2014, for IoU in place of
    F1).

    Args:
        probability: Calibrated probability of each voxel to be surface `[*batch x y z]`.

    Returns:
        The threshold, from `LEAST_PROBABILITY` to 1/2 `[*batch]`.
    """
    falling = -jnp.sort(-probability.reshape(*probability.shape[:-3], -1))
    intersection, count = jnp.cumsum(falling, axis=-1), jnp.arange(1, falling.shape[-1] + 1)
    union = count + intersection[..., -1:] - intersection
    highest = jnp.max(intersection / union, axis=-1)
    return jnp.maximum(highest / (1 + highest), LEAST_PROBABILITY)


def agreed(
    occupied: Grid, occluded: Grid, probability: Float[Array, "*batch x y z"]
) -> Float[Array, "*batch x y z"]:
    """Probability of surface from the measurement and a decoder that was conditioned on it.

    With the points of a low-resolution camera, rays pass through thin parts. Therefore only the
    measured surface of binary grids is kept, and the decoder decides about free space. Soft grids
    contain the certainty of surface and free space: they are averaged with the decoder at equal
    weight.

    Args:
        occupied: F `[*batch x y z]`, binary or soft.
        occluded: M `[*batch x y z]`, of the same kind.
        probability: The decoder's probability of being occupied `[*batch x y z]`.
    """
    if jnp.asarray(occupied).dtype == bool:
        return jnp.where(occupied & ~occluded, 1.0, probability)
    return (probability + known_or(Grids(occupied, occluded), probability)) / 2


def compose(occupied: Grid, occluded: Grid, completed: Grid) -> Bool[Array, "*batch x y z"]:
    """Keep observed voxels as measured; fill occluded ones with the completed shape.

    Args:
        occupied: F `[*batch x y z]`, binary or soft.
        occluded: M `[*batch x y z]`, binary or soft.
        completed: The decoded shape `[*batch x y z]`: True where occupied, or its probability.

    Returns:
        The composed shape `[*batch x y z]`: True where (1 - M) F + M p is above 1/2. For binary
        grids that is F where something was measured, and the completed shape elsewhere.
    """
    return known_or(Grids(occupied, occluded), completed) > 0.5


def known_or(grids: Grids, completed: Grid) -> Float[Array, "*batch x y z"]:
    """The measurement in measured voxels, the completed shape in occluded ones: (1 - M) F + M p.

    Args:
        grids: F and M `[*batch x y z]`, binary or soft.
        completed: The decoded shape `[*batch x y z]`: True where occupied, or its probability p.
    """
    F, M, p = (jnp.asarray(x).astype(jnp.float32) for x in (*grids[:2], completed))
    return (1 - M) * F + M * p
