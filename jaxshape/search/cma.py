"""CMA-ES: covariance matrix adaptation, with the semantics of pycma.

Equations and symbols follow Hansen, "The CMA Evolution Strategy: A Tutorial" (arXiv:1604.00772);
the constants come from pycma 4.5, the package the paper used, which adds a step-size damping for
large populations. `cma_ask` and `cma_tell` are the algorithm, `rates.py` has its constants,
`stopping.py` says when it is over, `methods/cma.py` binds them to a `Refiner`, and `restarts.py`
starts it again with larger populations.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxshape.checks import positive, whole
from jaxshape.search import stopping
from jaxshape.search.batching import apply_if
from jaxshape.search.rates import Constants, constants, default_population
from jaxshape.search.refiner import (
    Candidate,
    Distribution,
    StopReason,
    Trace,
    finite_or_inf,
    keep_better,
    start_trace,
)
from jaxshape.search.stopping import History, Tolerances


class CmaState(NamedTuple):
    """The distribution N(mean, sigma^2 C) of one search, and its best candidate.

    Attributes:
        mean: Centre of the distribution `[d]`.
        best: The best candidate so far, the start included where its loss was given.
        stop: Why the search ended, as a `StopReason`; RUNNING while it goes on.
        sigma: Step size, the scale that all axes share; above 0.
        covariance: C `[d d]`, symmetric and positive definite.
        basis: B `[d d]`, eigenvectors of C as columns, as of the last decomposition.
        scales: D `[d]`, square roots of the eigenvalues of C, ascending, as of the last
            decomposition.
        path_sigma: p_sigma `[d]`, the evolution path of the step size.
        path_c: p_c `[d]`, the evolution path of the covariance.
        generation: Number of generations that have updated the distribution, from 0.
        history: Earlier generations, as far as the stop criteria need them.
    """

    mean: Float[Array, " d"]
    best: Candidate
    stop: Int[Array, ""]
    sigma: Float[Array, ""]
    covariance: Float[Array, "d d"]
    basis: Float[Array, "d d"]
    scales: Float[Array, " d"]
    path_sigma: Float[Array, " d"]
    path_c: Float[Array, " d"]
    generation: Int[Array, ""]
    history: History


def checked_population(dim: int, sigma0: Float[Array, ""] | float, population: int | None) -> int:
    """Check the settings of a search, and give its population.

    Args:
        dim: Dimension of a point, 1 or more.
        sigma0: First standard deviation, above 0.
        population: Candidates per generation, 3 or more; None for pycma's default.

    Raises:
        ValueError: A setting is outside its range.
    """
    whole("dim", dim, 1)
    positive("sigma0", sigma0)
    if population is None:
        return default_population(dim)
    whole("population", population, 3)  # CMA-ES ranks candidates
    return population


def cma_start(
    point: Float[Array, " d"],
    sigma0: Float[Array, ""] | float,
    *,
    population: int | None = None,
    loss: Float[Array, ""] | float = math.inf,
) -> CmaState:
    """The distribution N(point, sigma0^2 I) before the first generation.

    Args:
        point: Centre of the distribution `[d]`.
        sigma0: Standard deviation of every coordinate, above 0.
        population: Candidates per generation, 3 or more, for the stop criteria of `stopping.check`;
            None for pycma's 4 + floor(3 ln d).
        loss: Loss of the point where it is known; the point then counts as the best so far.

    Returns:
        The state of a search that has seen no generation. Its `stop` stays RUNNING under
        `cma_tell`; `cma` is the search with stop criteria.

    Raises:
        ValueError: A setting is outside its range.

    Examples:
        Use it with `cma_ask` and `cma_tell` in your own loop, in JAX or around a simulator:

        >>> import jax, jax.numpy as jnp, jaxshape as js
        >>> losses_of = jax.vmap(lambda x: jnp.sum((x - 3) ** 2))
        >>> ask, tell = jax.jit(js.cma_ask, static_argnums=2), jax.jit(js.cma_tell)
        >>> state = js.cma_start(jnp.zeros(5), sigma0=1.0)
        >>> for key in jax.random.split(jax.random.key(0), 100):
        ...     points = ask(key, state, 8)
        ...     state = tell(state, points, losses_of(points))
        >>> state.mean.round(2)
        Array([3., 3., 3., 3., 3.], dtype=float32)
    """
    size = checked_population(len(point), sigma0, population)
    return start(point, sigma0, len(point), size, jnp.asarray(loss, point.dtype))


def start(
    point: Float[Array, " d"],
    sigma0: Float[Array, ""] | float,
    dim: int,
    population: int,
    loss: Float[Array, ""],
) -> CmaState:
    """`cma_start` for a search in `dim` dimensions; it checks the shape of the point."""
    if point.shape != (dim,):
        raise ValueError(
            f"The point has shape {point.shape}; this search was built for ({dim},)."
            " Batch with jax.vmap."
        )
    identity, zero = jnp.eye(dim, dtype=point.dtype), jnp.zeros_like(point)
    return CmaState(
        mean=point,
        best=Candidate(point, finite_or_inf(loss)),
        stop=jnp.int32(StopReason.RUNNING),
        sigma=jnp.asarray(sigma0, point.dtype),
        covariance=identity,
        basis=identity,
        scales=jnp.ones_like(point),
        path_sigma=zero,
        path_c=zero,
        generation=jnp.int32(0),
        history=stopping.no_history(point, population),
    )


def started(state: CmaState) -> tuple[CmaState, Trace]:
    """A state that has evaluated one point, together with its trace."""
    return state, start_trace(state.best, distribution(state))


def distribution(state: CmaState) -> Distribution:
    """The distribution of a state, as a trace records it."""
    return Distribution(
        sigma=state.sigma,
        standard_deviations=state.sigma * jnp.sqrt(jnp.diag(state.covariance)),
        axis_lengths=state.sigma * state.scales,
    )


def move(
    state: CmaState,
    points: Float[Array, "capacity d"],
    losses: Float[Array, " capacity"],
    rates: Constants,
    sigma0: Float[Array, ""] | float,
    population: int | Int[Array, ""],
    tolerances: Tolerances,
) -> CmaState:
    """One generation: `cma_tell`, then the stop criteria."""
    state = cma_tell(state, points, losses, rates)
    return stopping.check(state, losses, sigma0, population, tolerances)


@jax.default_matmul_precision("highest")  # on GPU the default drops most of the mantissa
def cma_ask(key: Array, state: CmaState, number: int) -> Float[Array, "{number} d"]:
    """Sample candidates, x = m + sigma C^(1/2) z (Eqs. 38 - 40).

    The tutorial samples B D z, which has the same distribution, but B is arbitrary where
    eigenvalues are equal; the symmetric root lets equal keys give equal points in any batch.

    Args:
        key: Random key of this generation.
        state: The distribution to sample from.
        number: Candidates to draw, 1 or more; static under `jax.jit`.

    Returns:
        The candidates `[number d]`.
    """
    z = jax.random.normal(key, (number, len(state.mean)), state.mean.dtype)
    return state.mean + state.sigma * (z @ state.basis * state.scales) @ state.basis.T


@jax.default_matmul_precision("highest")
def cma_tell(
    state: CmaState,
    points: Float[Array, "capacity d"],
    losses: Float[Array, " capacity"],
    rates: Constants | None = None,
) -> CmaState:
    """Move the distribution towards the better candidates (tutorial, Eqs. 41 - 47).

    Only the order of the losses matters. Equal losses keep the order of the candidates: on a flat
    objective selection is random, and the step size stays unbiased. NaN and infinite losses rank
    last.

    Args:
        state: The distribution before this generation.
        points: Candidates of one generation `[n d]`, 3 or more. They need not come from `cma_ask`.
        losses: Losses of these candidates `[n]`.
        rates: Weights and learning rates (`jaxshape.search.cma.constants`); None for pycma's own.

    Returns:
        The distribution after this generation.
    """
    if rates is None:
        rates = constants(len(state.mean), len(points), dtype=state.mean.dtype)
    c, dim = rates, len(state.mean)
    weights = c.weights
    generation = state.generation + 1

    order = jnp.argsort(finite_or_inf(losses), stable=True)
    steps = (points[order] - state.mean) / state.sigma  # y_i, best first
    mean_step = jnp.maximum(weights, 0) @ steps

    # Step size: longer or shorter path than under random selection?
    path_sigma = (1 - c.c_sigma) * state.path_sigma + jnp.sqrt(
        c.c_sigma * (2 - c.c_sigma) * c.mu_eff
    ) * (_sphere(state, mean_step) @ state.basis.T)
    norm = jnp.linalg.norm(path_sigma)
    change = c.c_sigma / c.damping * (norm / _expected_norm(dim) - 1)

    # Covariance: the rank-one path waits while the step size still grows fast (h_sigma = 0).
    age = 1 - (1 - c.c_sigma) ** (2 * generation)
    h_sigma = (norm**2 / age < (2 + 4 / (dim + 1)) * dim).astype(norm.dtype)
    path_c = (1 - c.c_c) * state.path_c + h_sigma * jnp.sqrt(
        c.c_c * (2 - c.c_c) * c.mu_eff
    ) * mean_step
    lost = (1 - h_sigma) * c.c_c * (2 - c.c_c)  # variance that path_c misses while it waits
    # Steps of negative weight are scaled to length sqrt(d): one outlier could make C indefinite
    # (Eq. 46).
    length = jnp.linalg.norm(_sphere(state, steps), axis=-1)
    signed = jnp.where(weights < 0, weights * dim / (length + 1e-9) ** 2, weights)
    covariance = (
        (1 - c.c_1 * (1 - lost) - c.c_mu * weights.sum()) * state.covariance
        + c.c_1 * jnp.outer(path_c, path_c)
        + c.c_mu * (steps.T * signed) @ steps
    )

    due = generation % c.eigen_gap == 0
    covariance, basis, scales = apply_if(due, _decompose, covariance, state.basis, state.scales)
    return _balanced(
        state._replace(
            mean=state.mean + state.sigma * mean_step,
            best=keep_better(state.best, points, losses),
            sigma=state.sigma * jnp.exp(jnp.clip(change, -1, 1)),
            covariance=covariance,
            basis=basis,
            scales=scales,
            path_sigma=path_sigma,
            path_c=path_c,
            generation=generation,
        )
    )


def _expected_norm(dim: int) -> float:
    """E |N(0, I)|."""
    return math.sqrt(2) * math.exp(math.lgamma((dim + 1) / 2) - math.lgamma(dim / 2))


def _sphere(state: CmaState, steps: Float[Array, "*n d"]) -> Float[Array, "*n d"]:
    """D^-1 B^T y: steps in units of the current distribution, along its axes."""
    return steps @ state.basis / state.scales


def _balanced(state: CmaState) -> CmaState:
    """The same distribution, with its scale moved from C into sigma before C under- or overflows.

    A run without stop criteria can get there: large populations shrink C instead of sigma.
    """
    limits = jnp.finfo(state.sigma.dtype)
    size = jnp.trace(state.covariance) / len(state.mean)
    size = jnp.where((size > limits.eps) & (size < 1 / limits.eps), 1, size)
    sigma = state.sigma * jnp.sqrt(size)
    return state._replace(
        sigma=jnp.clip(sigma, float(limits.tiny) ** 0.5, float(limits.max) ** 0.5),
        covariance=state.covariance / size,
        scales=state.scales / jnp.sqrt(size),
        path_c=state.path_c / jnp.sqrt(size),
    )


def _decompose(
    covariance: Float[Array, "d d"], basis: Float[Array, "d d"], scales: Float[Array, " d"]
) -> tuple[Float[Array, "d d"], Float[Array, "d d"], Float[Array, " d"]]:
    """C = B D^2 B^T, with C lifted by a multiple of I where rounding would make it indefinite."""
    del basis, scales
    covariance = (covariance + covariance.T) / 2
    values, basis = jnp.linalg.eigh(covariance, symmetrize_input=False)
    largest_condition = 0.1 / float(jnp.finfo(values.dtype).eps)
    lift = jnp.maximum(values[-1] / largest_condition - values[0], 0)
    return (
        covariance + lift * jnp.eye(len(values), dtype=lift.dtype),
        basis,
        jnp.sqrt(values + lift),
    )
