"""Eq. 7 with probabilities in the place of F and M."""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxshape.geometry.evidence import Evidence
from jaxshape.search.objective import BALANCED, Target, Weights

LEAST_ALPHA = 0.8
"""Weight of the prior, whatever was seen. The paper's alpha falls to .2 after 18 frames, and the
search then gives the hidden part up to fit the noise of what is measured."""


def soft_target(
    evidence: Evidence,
    prior_logits: Float[Array, "*batch x y z"],
    weights: Weights = BALANCED,
) -> Target:
    """Weights of Eq. 7: measurements by their certainty, the prior by what is unknown.

    With probabilities of 0 and 1 this is `objective.target` of F and M, but for the least alpha.

    Args:
        evidence: What the frames say about each voxel.
        prior_logits: The decoded first code, G(lambda_0).
        weights: Of free space and of the prior.

    Returns:
        How much each voxel wants to be occupied, and how much empty.
    """
    unknown = 1 - evidence.surface - evidence.free
    total = unknown.sum((-3, -2, -1), keepdims=True)
    alpha = total / jnp.maximum(math.prod(unknown.shape[-3:]) - total, 1)
    alpha = weights.prior * jnp.maximum(alpha, LEAST_ALPHA)
    G0 = jax.nn.sigmoid(prior_logits)
    return Target(
        occupied=evidence.surface + alpha * unknown * G0,
        empty=weights.free * evidence.free + alpha * unknown * (1 - G0),
    )


def soft_compose(
    evidence: Evidence, logits: Float[Array, "*batch x y z"]
) -> Float[Array, "*batch x y z"]:
    """Probabilities of the composed shape: measured where certain, decoded elsewhere."""
    unknown = 1 - evidence.surface - evidence.free
    return evidence.surface + unknown * jax.nn.sigmoid(logits)
