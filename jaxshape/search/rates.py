"""The weights and learning rates of CMA-ES, as pycma 4.5 sets them (tutorial, Table 1)."""

import math
from typing import NamedTuple

import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int


class Constants(NamedTuple):
    """Weights and learning rates of CMA-ES (tutorial, Table 1).

    Attributes:
        weights: w_i `[capacity]`, recombination weights from the best candidate to the worst; the
            positive ones sum to 1.
        mu_eff: Variance-effective number of parents.
        c_sigma: Learning rate of the evolution path of the step size.
        damping: d_sigma, damping of the step size.
        c_c: Learning rate of the evolution path of the covariance.
        c_1: Learning rate of the rank-one update of the covariance.
        c_mu: Learning rate of the rank-mu update of the covariance.
        eigen_gap: Generations between eigendecompositions, 1 or more.
    """

    weights: Float[Array, " capacity"]
    mu_eff: Float[Array, ""]
    c_sigma: Float[Array, ""]
    damping: Float[Array, ""]
    c_c: Float[Array, ""]
    c_1: Float[Array, ""]
    c_mu: Float[Array, ""]
    eigen_gap: Int[Array, ""]


def default_population(dim: int) -> int:
    """The number of candidates in one generation, 4 + floor(3 ln d)."""
    return 4 + math.floor(3 * math.log(dim))


def constants(
    dim: int,
    population: int | Int[Array, ""],
    capacity: int | None = None,
    dtype: DTypeLike = float,
) -> Constants:
    """pycma's default constants for a dimension and a population (tutorial, Table 1).

    Args:
        dim: Dimension of a point, 1 or more.
        population: Candidates per generation, 3 or more. It may be traced if `capacity` bounds it.
        capacity: Length of the weights, static; weights beyond the population are 0. None for the
            population itself.
        dtype: Type of the points.
    """
    d, size = dim, jnp.asarray(population, dtype)
    rank = jnp.arange(1, (population if capacity is None else capacity) + 1, dtype=size.dtype)
    raw = jnp.where(rank <= size, jnp.log((size + 1) / 2) - jnp.log(rank), 0)  # Eq. 49
    positive, negative = jnp.maximum(raw, 0), jnp.minimum(raw, 0)
    mu_eff = positive.sum() ** 2 / (positive**2).sum()
    mu_eff_negative = negative.sum() ** 2 / (negative**2).sum()

    c_1 = jnp.minimum(1, size / 6) * 2 / ((d + 1.3) ** 2 + mu_eff)
    c_mu = 2 * (0.25 + mu_eff + 1 / mu_eff - 2) / ((d + 2) ** 2 + mu_eff)
    c_mu = jnp.minimum(1 - c_1, c_mu)
    c_sigma = jnp.minimum(0.5, (mu_eff + 2) / (d + mu_eff + 3))

    # Negative weights: no decay of C, a rate that fits their number, positive definite (50 - 53).
    negative_sum = jnp.minimum(
        jnp.minimum(1 + c_1 / c_mu, 1 + 2 * mu_eff_negative / (mu_eff + 2)),
        (1 - c_1 - c_mu) / (c_mu * d),
    )
    # pycma's own term: it damps large populations, up to three times as hard in many dimensions.
    many = max(1, 3 * (1 - 0.5 ** (d / 9))) * jnp.sqrt((mu_eff - 1) / (d + 1))
    return Constants(
        weights=positive / positive.sum() - negative_sum * negative / negative.sum(),
        mu_eff=mu_eff,
        c_sigma=c_sigma,
        damping=1 + 2 * jnp.maximum(0, many - 1) + c_sigma,
        c_c=(4 + mu_eff / d) / (d + 4 + 2 * mu_eff / d),
        c_1=c_1,
        c_mu=c_mu,
        eigen_gap=jnp.ceil(1 / ((c_1 + c_mu) * d * 10)).astype(jnp.int32),
    )
