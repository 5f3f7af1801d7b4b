"""The objective of a search: the disagreement of a decoded shape with the measurement.

A `Residual` is two pure functions of ONE object and ONE candidate; the search batches them.

    target = residual.target(grids, first_logits)    # once per object
    loss   = residual.score(logits, target)          # for every candidate

The package has three: `PAPER` is Eq. 7 of the paper as printed, `BALANCED` is Eq. 7 with a third of
the weight on measured free space, and `SOFT` is `BALANCED` with each voxel weighted by how sure its
measurement is. Your own residual needs only these two functions (docs/examples/own_residual.py).
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxshape.geometry.grids import Grid, Grids, binary


class Residual(NamedTuple):
    """Two pure functions that score candidates; hashable, so that it can be static under jit.

    The package has three: `PAPER` is Eq. 7 as printed, `BALANCED` is Eq. 7 with a third of the
    weight on measured free space, and `SOFT` is `BALANCED` with each voxel weighted by how sure its
    measurement is. `RefineConfig.objective` names them `paper`, `balanced` and `soft`.

    Attributes:
        target: `(grids, first_logits [x y z]) -> target`: a pytree of arrays, computed once from
            the measurement of an object and its decoded first code, G(lambda_0). `grids.data` holds
            the further arrays that you gave to `reconstruct`.
        score: `(logits [x y z], target) -> loss`, a scalar in nats per voxel, differentiable in
            the logits.
    """

    target: Callable[[Grids, Float[Array, "x y z"]], PyTree]
    score: Callable[[Float[Array, "x y z"], PyTree], Float[Array, ""]]


def one_loss(function: str, loss: Any) -> Float[Array, ""]:
    """Check that a residual or a penalty returned one floating-point number, and return it.

    Args:
        function: Name of the function.
        loss: What it returned.

    Raises:
        ValueError: It returned anything else.
    """
    if loss is None or jnp.shape(loss) or not jnp.issubdtype(jnp.result_type(loss), jnp.floating):
        kind = getattr(loss, "dtype", type(loss).__name__)
        raise ValueError(
            f"{function} must return one floating-point number for one candidate; it returned"
            f" {kind} of shape {getattr(loss, 'shape', ())}."
        )
    return loss


class Weights(NamedTuple):
    """Weights of the parts of Eq. 7, relative to measured occupied voxels.

    Attributes:
        free: Weight of measured free space, 0 or more (Eq. 7: 1). A lower weight keeps thin
            structures from drowning in free space.
        prior: Factor of alpha, the weight of the prior where nothing was measured, 0 or more (Eq.
            7: 1).
        least_alpha: Lower bound of alpha, 0 or more (Eq. 7: 0). After many frames little is
            occluded and alpha is small: the search then sacrifices the hidden part to fit the noise
            of the measurement.
    """

    free: float = 1.0
    prior: Float[Array, ""] | float = 1.0
    least_alpha: float = 0.0


AS_PRINTED, LESS_FREE = Weights(), Weights(free=1 / 3)
UNDER_NOISE = Weights(free=1 / 3, least_alpha=0.8)


class Target(NamedTuple):
    """Weights of the two cross-entropy terms of each voxel.

    Attributes:
        occupied: Weight `[*batch x y z]` of -log p.
        empty: Weight `[*batch x y z]` of -log (1 - p).
    """

    occupied: Float[Array, "*batch x y z"]
    empty: Float[Array, "*batch x y z"]


def weigh(
    grids: Grids, first_logits: Float[Array, "*batch x y z"], weights: Weights = AS_PRINTED
) -> Target:
    """The weights of Eq. 7: F in measured voxels, alpha times the prior in occluded ones.

    Args:
        grids: F and M, binary or soft, `[*batch x y z]`.
        first_logits: Logits of the decoded first code, G(lambda_0), `[*batch x y z]`.
        weights: Weights of measured free space and of the prior; Eq. 7's by default.

    Returns:
        The target of `cross_entropy`. alpha is sum(M) / sum(1 - M), at least `weights.least_alpha`,
        times `weights.prior`; if everything is occluded, the denominator is 1, so that the prior
        alone decides.
    """
    axes = (-3, -2, -1)
    M = _as_weights(grids.occluded, first_logits)
    F = _as_weights(grids.occupied, first_logits)
    G0 = jax.nn.sigmoid(first_logits)
    alpha = M.sum(axes, keepdims=True) / jnp.maximum((1 - M).sum(axes, keepdims=True), 1)
    alpha = weights.prior * jnp.maximum(alpha, weights.least_alpha)
    return Target(
        occupied=(1 - M) * F + alpha * M * G0,
        empty=weights.free * (1 - M) * (1 - F) + alpha * M * (1 - G0),
    )


def _as_weights(grid: Grid, like: Array) -> Array:
    return jnp.asarray(grid).astype(like.dtype)


def cross_entropy(logits: Float[Array, "*batch x y z"], target: Target) -> Float[Array, "*batch"]:
    """The loss of Eq. 7 from logits: a mean over voxels, since f carries the 1 / N^3 of the
    training loss.

    Args:
        logits: Logits of decoded shapes `[*batch x y z]`.
        target: Weights of the two terms of each voxel, with the same batch axes.

    Returns:
        Loss of each shape `[*batch]`, in nats per voxel.
    """
    # -log sigmoid(l) = softplus(-l) = softplus(l) - l, and -log(1 - sigmoid(l)) = softplus(l).
    softplus = jnp.maximum(logits, 0) + jnp.log(1 + jnp.exp(-jnp.abs(logits)))
    # Sums written as products run several times faster on CPU than XLA's fused mean.
    over_voxels = partial(jnp.einsum, "...xyz,...xyz->...", precision="highest")
    total = over_voxels(target.occupied + target.empty, softplus)
    return (total - over_voxels(target.occupied, logits)) / math.prod(logits.shape[-3:])


def equation_7(weights: Weights = AS_PRINTED) -> Residual:
    """Eq. 7 of the paper, on binary F and M: soft grids are rounded.

    Args:
        weights: Weights of measured free space and of the prior; Eq. 7's by default.
    """
    return Residual(lambda grids, logits: weigh(binary(grids), logits, weights), cross_entropy)


def soft(weights: Weights = UNDER_NOISE) -> Residual:
    """Eq. 7 with each voxel weighted by how sure its measurement is.

    F and M are probabilities, as fused signed distances give them (`jaxshape.geometry.evidence`).
    A voxel that is known with probability 0.5 counts half with its measured value, and half with
    the prior.

    Args:
        weights: Weights of measured free space and of the prior; by default as in `BALANCED`, with
            alpha at least 0.8.
    """
    return Residual(lambda grids, logits: weigh(grids, logits, weights), cross_entropy)


PAPER = equation_7()
"""Eq. 7 of the paper as printed."""
BALANCED = equation_7(LESS_FREE)
"""Eq. 7 with a third of the weight on measured free space: the best on procedural and CAD chairs,
without noise and with it (experiments/objective.py)."""
SOFT = soft()
"""Eq. 7 for soft grids under noise: each voxel is weighted by how sure its measurement is, measured
free space counts a third, and the prior keeps its weight when little is hidden."""

RESIDUALS = {"balanced": BALANCED, "paper": PAPER, "soft": SOFT}
"""The residuals by the names that `RefineConfig.objective` takes."""
