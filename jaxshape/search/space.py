"""The coordinates in which codes are searched.

Refiners know nothing of codes: they move a point u of `LatentSpace`, and the code is
mean + root u. In the space whitened by the training codes u is a standard normal number in every
direction, so that step sizes, bounds and tolerances mean the same for every network.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxshape.model.weights import ShapePrior


class LatentSpace(NamedTuple):
    """An affine map from points to codes, with an optional box around its origin."""

    mean: Float[Array, " d"]
    root: Float[Array, "d d"]
    """Lower triangular, with root @ root.T the covariance of the codes."""
    bound: Float[Array, ""] | float | None = None
    """Points are folded into the box of this half side, in the units of u."""

    def to_code(self, point: Float[Array, " d"]) -> Float[Array, " d"]:
        """The code of a point."""
        step = jnp.dot(self.root, fold(point, self.bound), precision="highest")
        return self.mean + step

    def from_code(self, code: Float[Array, " d"]) -> Float[Array, " d"]:
        """The point of a code; the nearest one inside where it lies outside the bounds.

        Close to the bounds `to_code` moves it a little further in: at the very edge, where the
        fold turns back, a gradient could not leave again.
        """
        point = jax.scipy.linalg.solve_triangular(self.root, code - self.mean, lower=True)
        return point if self.bound is None else jnp.clip(point, -self.bound, self.bound)


def whitened(prior: ShapePrior, bound: float | None = None) -> LatentSpace:
    """The space in which the training codes have zero mean and unit covariance."""
    return LatentSpace(prior.code_mean, jnp.linalg.cholesky(prior.code_covariance), bound)


def raw(dim: int, bound: float | None = None) -> LatentSpace:
    """The codes themselves, as in the paper."""
    return LatentSpace(jnp.zeros(dim), jnp.eye(dim), bound)


def fold(point: Float[Array, "*n"], bound: Float[Array, ""] | float | None) -> Float[Array, "*n"]:
    """Map every number into [-bound, bound]: the identity, but near the ends, where it turns back.

    The last tenth before a bound is a parabola that touches it, and the whole repeats mirrored, as
    in pycma's `BoxConstraintsLinQuadTransformation`: smooth, so that gradients pass and a normal
    distribution stays nearly normal.
    """
    if bound is None:
        return point
    margin = 0.1 * bound
    # A period runs from -(bound + margin) up to bound + margin and back.
    half = bound + margin
    wrapped = jnp.abs(jnp.mod(point - half, 4 * half) - 2 * half) - half
    inner = jnp.abs(wrapped) - (bound - margin)
    bent = jnp.sign(wrapped) * (bound - (2 * margin - inner) ** 2 / (4 * margin))
    return jnp.where(inner > 0, bent, wrapped)
