"""The objective about a point to second order, in the directions in which it curves most.

The Gauss-Newton matrix of an objective l(f(u)), J^T H J with J the Jacobian of f and H the Hessian
of l, is positive semi-definite where l is convex. It is never formed: k products with it give the
Lanczos directions Q, which span the Krylov space of the gradient, and the matrix in that space, T =
Q^T (J^T H J) Q. A product takes about the time of a gradient.

A search obtains it from `expand`. Objectives of `refine` and `js.objective` are `Composed`; for a
plain JAX function the Hessian replaces the Gauss-Newton matrix.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

# The loss of one point, in the point's own type; a refiner calls it under `jax.vmap` or `jax.grad`.
# A point that is not finite costs nothing and has the loss NaN.
Objective = Callable[[Float[Array, " d"]], Float[Array, ""]]


class Expansion(NamedTuple):
    """An objective about a point u: loss + slope s + s^T Q T Q^T s / 2 for a step s.

    Attributes:
        loss: Loss of the point.
        slope: Gradient `[d]`.
        directions: Q^T `[k d]`, orthonormal rows, the first along the gradient; rows of zeros where
            fewer than k directions are left.
        matrix: T `[k k]`, symmetric: the curvature among the directions.
    """

    loss: Float[Array, ""]
    slope: Float[Array, " d"]
    directions: Float[Array, "k d"]
    matrix: Float[Array, "k k"]


@dataclass(frozen=True)
class Composed:
    """An objective that exposes its inner and outer function, so that it has a Gauss-Newton matrix.

    Attributes:
        loss: `point [d] -> loss`; calling the objective calls it.
        expansion: `(point [d], number of directions) -> Expansion`.
    """

    loss: Objective
    expansion: Callable[[Float[Array, " d"], int], Expansion]

    def __call__(self, point: Float[Array, " d"]) -> Float[Array, ""]:
        """The loss of a point.

        Args:
            point: A point of the search space `[d]`.
        """
        return self.loss(point)


def only_where(wanted: Bool[Array, ""], objective: Objective) -> Objective:
    """Evaluate the objective only where wanted; elsewhere it gets NaN points, which cost nothing.

    Args:
        wanted: Whether to evaluate.
        objective: The objective.
    """
    asked = lambda point: jnp.where(wanted, point, jnp.nan)  # noqa: E731
    loss = lambda point: objective(asked(point))  # noqa: E731
    if not isinstance(objective, Composed):
        return loss
    return Composed(loss, lambda point, count: objective.expansion(asked(point), count))


def expand(objective: Objective, point: Float[Array, " d"], directions: int) -> Expansion:
    """The objective about a point, to second order.

    Args:
        objective: The loss of one point: `Composed`, or any function that JAX can differentiate
            twice, whose Hessian may have negative curvature.
        point: The point `[d]`. A point that is not finite costs a `Composed` objective nothing.
        directions: Largest number of directions, 1 or more; d of them give the whole matrix.

    Returns:
        The expansion, with min(directions, d) directions.
    """
    directions = min(directions, len(point))
    if isinstance(objective, Composed):
        return objective.expansion(point, directions)
    loss, slope = jax.value_and_grad(objective)(point)
    product = lambda v: jax.jvp(jax.grad(objective), (point,), (v[0],))[1][None]  # noqa: E731
    Q, T = lanczos(product, slope[None], directions)
    return Expansion(loss, slope, Q[0], T[0])


def lanczos(
    product: Callable[[Float[Array, "n d"]], Float[Array, "n d"]],
    first: Float[Array, "n d"],
    count: int,
) -> tuple[Float[Array, "n k d"], Float[Array, "n k k"]]:
    """Orthonormal bases of the Krylov spaces of n symmetric matrices, and the matrices in them.

    Each direction is the matrix times the previous one, made orthogonal to all earlier ones. The
    orthogonalisation is done twice, because of rounding.

    Args:
        product: Multiplies each of the n symmetric matrices with a vector of its own.
        first: The vector that each space begins with.
        count: Directions, 1 or more.

    Returns:
        The directions, zero vectors once a space is exhausted, and the matrices T.
    """
    dot = lambda equation, *x: jnp.einsum(equation, *x, precision="highest")  # noqa: E731

    def add(carry, number):
        Q, new, scale = carry
        norm = jnp.linalg.norm(new, axis=-1, keepdims=True)
        left = norm > 1e2 * jnp.finfo(new.dtype).eps * scale
        q = jnp.where(left, new / jnp.where(left, norm, 1), 0)
        Q = lax.dynamic_update_index_in_dim(Q, q, number, axis=1)
        made = product(q)
        new = made
        for _ in range(2):
            new = new - dot("nkd,nk->nd", Q, dot("nkd,nd->nk", Q, new))
        scale = jnp.maximum(jnp.linalg.norm(made, axis=-1, keepdims=True), scale)
        return (Q, new, scale), made

    none = jnp.repeat(0 * first[:, None], count, axis=1)
    (Q, _, _), made = lax.scan(add, (none, first, 0 * first[:, :1]), jnp.arange(count))
    T = dot("nkd,lnd->nkl", Q, made)
    return Q, (T + T.swapaxes(-1, -2)) / 2
