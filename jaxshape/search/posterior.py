"""Uncertainty of a shape, from samples of codes that explain the measurement equally well.

    codes  = sample_codes(keys, prior, grids, found, count)   # of the posterior of each object
    logits = decode(prior, codes, grids)                      # all of them in one call
    spread = logits.std(axis=1)                               # of the occupancy of each voxel

In a conditional model, codes are normally distributed given the measurement, because the model was
trained that way. In other models they follow Laplace's approximation about the code that was found:
its precision is that of the prior plus the curvature of the objective.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from jaxshape.geometry.grids import Grids
from jaxshape.model.shapes import ShapePrior
from jaxshape.search.curvature import Expansion, expand
from jaxshape.search.objective import objective
from jaxshape.search.residuals import Residual
from jaxshape.search.space import whitened

DIRECTIONS = 20
"""Number of directions in which the curvature of the objective is computed; in all others a code is
as uncertain as before the measurement."""


def sample_codes(
    keys: Key[Array, " object"],
    prior: ShapePrior,
    grids: Grids,
    code: Float[Array, "object d"],
    count: int,
    *,
    residual: Residual,
    target: PyTree,
) -> Float[Array, "object count d"]:
    """Codes from the posterior of each object, given what was measured of it.

    Args:
        keys: One random key for each object `[object]`.
        prior: The shape prior.
        grids: F and M of the objects `[object x y z]`.
        code: The code found for each object `[object d]`, about which the posterior of a model that
            decodes from the code alone is expanded; a conditional model does not need it.
        count: Codes for each object, 1 or more.
        residual: The residual that scores codes.
        target: Its target for each object, a pytree of arrays `[object ...]`.

    Returns:
        The codes `[object count d]`.
    """
    space = whitened(prior)
    draw = lambda key: jax.random.normal(key, (count, prior.code_size))  # noqa: E731
    points = jax.vmap(draw)(keys)
    if not prior.model.conditional:
        nats = float(prior.resolution) ** 3  # the objective is a mean over voxels

        def about(grids, code, target, points):
            loss = objective(prior, target, residual=residual, grids=grids, space=space)
            center = space.from_code(code)
            return center + narrowed(expand(loss, center, DIRECTIONS), nats, points)

        points = jax.vmap(about)(grids, code, target, points)
    return jax.vmap(jax.vmap(space.to_code))(points)


def narrowed(about: Expansion, scale: float, points: Float[Array, "n d"]) -> Float[Array, "n d"]:
    """Standard normal points, narrowed to the posterior of a normal prior and a quadratic loss.

    The posterior's covariance is (I + scale Q T Q^T)^-1, with Q the directions of the expansion and
    T the curvature among them.

    Args:
        about: The loss about the mode of the posterior.
        scale: Factor of the loss that makes it a negative log-likelihood, above 0.
        points: Standard normal points `[n d]`.
    """
    values, axes = jnp.linalg.eigh(about.matrix)
    directions = axes.T @ about.directions
    shrink = 1 - jax.lax.rsqrt(1 + scale * jnp.maximum(values, 0))
    along = jnp.einsum("nd,kd->nk", points, directions, precision="highest")
    return points - jnp.einsum("nk,k,kd->nd", along, shrink, directions, precision="highest")


def hypotheses(
    samples: Float[Array, "sample x y z"], unknown: Bool[Array, "x y z"], count: int
) -> tuple[Int[Array, " count"], Float[Array, " count"]]:
    """The samples that differ most where nothing was measured, and how probable each is.

    The first is the sample nearest to all others; each further one is the sample farthest from
    those chosen before. The distance is 1 - IoU of the occupied unknown voxels. A mean of all
    samples would blur what they disagree on, such as two kinds of legs.

    Args:
        samples: Logits of samples of the posterior of one object `[sample x y z]`.
        unknown: True where nothing was measured `[x y z]`.
        count: Hypotheses, from 1 to the number of samples.

    Returns:
        Indices of the chosen samples `[count]`, and for each of them the share of all samples to
        which it is the nearest `[count]`; the shares sum to 1.
    """
    held = ((samples > 0) & unknown).reshape(len(samples), -1).astype(jnp.float32)
    both, size = held @ held.T, held.sum(axis=1)
    either = size[:, None] + size - both
    distance = 1 - jnp.where(either > 0, both / jnp.maximum(either, 1), 1)
    chosen = jnp.argmin(distance.sum(axis=1))[None]
    for _ in range(count - 1):
        chosen = jnp.append(chosen, jnp.argmax(distance[chosen].min(axis=0)))
    nearest = jnp.argmin(distance[chosen], axis=0)
    return chosen, jnp.mean(nearest[:, None] == jnp.arange(count), axis=0)
