"""Each half of an object as evidence for the other half, if the two measured halves agree."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxshape.geometry.evidence import Evidence

NATS = 3.0
"""Nats that a measured mirror image adds to the log-odds of an unknown voxel."""

AGREEMENT = 0.8
"""Share of the surface measured on both sides that must agree: most chairs reach .9."""


class Mirrored(NamedTuple):
    """Evidence from the mirror image of an object.

    Attributes:
        logits: Nats to add to the logits of a decoded shape; 0 where the voxel itself was measured.
        symmetric: Whether both sides agree where both were measured; if not, all logits are 0.
        agreement: The share of the surface measured on both sides that agrees; 1 without any.
    """

    logits: Float[Array, "*batch x y z"]
    symmetric: Bool[Array, "*batch"]
    agreement: Float[Array, "*batch"]


def mirror(x: Array | np.ndarray) -> Array:
    """The grid of the object with left and right exchanged."""
    return jnp.flip(x, axis=-3)


def mirrored(evidence: Evidence, nats: float = NATS) -> Mirrored:
    """Evidence about unknown voxels from their mirror images, where the object is symmetric.

    A surface voxel that is off by one voxel because of the grid still agrees. A surface contradicts
    symmetry only where its mirror image and all voxels next to it were seen to be free.

    Args:
        evidence: Probabilities of one object, in a frame whose x-axis points across the plane of
            symmetry.
        nats: Nats that a mirror image adds if it was measured with certainty.

    Returns:
        The nats, and the agreement of both sides.
    """
    surface, free = evidence
    axes = (-3, -2, -1)
    other_free = mirror(free)
    denied = surface * _least_nearby(other_free)
    agreed = surface * mirror(greatest_nearby(surface))
    both = denied.sum(axes) + agreed.sum(axes)
    agreement = jnp.where(both > 0, agreed.sum(axes) / jnp.where(both > 0, both, 1), 1.0)
    symmetric = agreement > AGREEMENT
    unknown = 1 - surface - free
    logits = nats * unknown * (mirror(surface) - other_free)
    return Mirrored(jnp.where(symmetric[..., None, None, None], logits, 0.0), symmetric, agreement)


def symmetrised(
    logits: Float[Array, "*batch x y z"], found: Mirrored
) -> Float[Array, "*batch x y z"]:
    """Logits averaged with their mirror image, plus its evidence; unchanged if not symmetric."""
    symmetric = found.symmetric[..., None, None, None]
    return jnp.where(symmetric, (logits + mirror(logits)) / 2, logits) + found.logits


def greatest_nearby(x: Float[Array, "*batch x y z"]) -> Float[Array, "*batch x y z"]:
    """The greatest value among each voxel and its 26 neighbours; opposite borders are neighbours.

    Args:
        x: Values of a grid whose borders are free.
    """
    for axis in (-3, -2, -1):
        before, after = (jnp.roll(x, shift, axis) for shift in (1, -1))
        x = jnp.maximum(x, jnp.maximum(before, after))
    return x


def _least_nearby(x: Float[Array, "*batch x y z"]) -> Float[Array, "*batch x y z"]:
    return -greatest_nearby(-x)
