"""The coordinates in which codes are searched.

Refiners do not handle codes: they move a point u of `LatentSpace`, and the code is mean + root u.
In the space whitened by the training codes, u is standard normal in every direction, so that step
sizes, bounds and tolerances mean the same for every network.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float

from jaxshape.model.shapes import ShapePrior


class LatentSpace(NamedTuple):
    """An affine map from points to codes, with an optional box around its origin.

    Attributes:
        mean: Code of the point 0 `[d]`.
        root: Lower triangular matrix `[d d]`, with root @ root.T the covariance of the codes; None
            where points have the units of codes.
        bound: Half side of the box that points are folded into, above 0, in units of points; None
            for no box.
    """

    mean: Float[Array, " d"]
    root: Float[Array, "d d"] | None
    bound: Float[Array, ""] | float | None = None

    def to_code(self, point: Float[Array, " d"]) -> Float[Array, " d"]:
        """The code of a point.

        Args:
            point: A point of the search space `[d]`; outside the bounds it is folded back.
        """
        step = fold(point, self.bound)
        if self.root is not None:
            step = jnp.dot(self.root, step, precision="highest")
        return self.mean + step

    def from_code(self, code: Float[Array, " d"]) -> Float[Array, " d"]:
        """The point of a code; for a code outside the bounds, the nearest point inside.

        Close to the bounds `to_code` maps this point slightly further inside. The point that maps
        exactly to the bound is where the fold turns back, and a gradient method could not leave it.

        Args:
            code: A code `[d]`.
        """
        point = code - self.mean
        if self.root is not None:
            point = jax.scipy.linalg.solve_triangular(self.root, point, lower=True)
        return point if self.bound is None else jnp.clip(point, -self.bound, self.bound)


def whitened(prior: ShapePrior, bound: Float[Array, ""] | float | None = None) -> LatentSpace:
    """The space in which the training codes have zero mean and unit covariance.

    Args:
        prior: The shape prior.
        bound: Half side of the box around the mean, above 0, in standard deviations; None for no
            box.

    Raises:
        ValueError: The covariance of the codes has another shape, or is not positive semi-definite
            (raised outside `jax.jit` only; inside, every loss of the search is NaN).
    """
    shape, d = jnp.shape(prior.code_covariance), prior.code_size
    if shape != (d, d):
        raise ValueError(
            f"code_covariance has shape {shape}, but code_mean has {d} numbers; give the covariance"
            f" of the codes [{d}, {d}]."
        )
    root = _root(prior.code_covariance)
    if not isinstance(root, Tracer) and not bool(jnp.all(jnp.isfinite(root))):
        raise ValueError(
            "code_covariance is not positive semi-definite, so there is no whitened space; "
            "give the covariance of codes, or search in raw codes (space='raw')."
        )
    return LatentSpace(prior.code_mean, root, bound)


def _root(covariance: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """The Cholesky factor; directions in which the codes do not vary get a small variance."""
    root = jnp.linalg.cholesky(covariance)
    room = 1e-6 * jnp.trace(covariance) * jnp.eye(len(covariance), dtype=covariance.dtype)
    return jnp.where(jnp.all(jnp.isfinite(root)), root, jnp.linalg.cholesky(covariance + room))


def raw(prior: ShapePrior, bound: Float[Array, ""] | float | None = None) -> LatentSpace:
    """The codes themselves, as in the paper.

    Args:
        prior: The shape prior.
        bound: Half side of the box around 0, above 0, in units of codes; None for no box.
    """
    return LatentSpace(jnp.zeros_like(prior.code_mean), None, bound)


def fold(point: Float[Array, "*n"], bound: Float[Array, ""] | float | None) -> Float[Array, "*n"]:
    """Map numbers into [-bound, bound]: the identity, except near the ends, where it turns back.

    The last tenth before a bound is a parabola that touches the bound, and beyond it the map
    repeats mirrored, as in pycma's `BoxConstraintsLinQuadTransformation`: smooth, so that gradients
    pass and a normal distribution stays nearly normal.
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
