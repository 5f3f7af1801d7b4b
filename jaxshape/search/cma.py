"""CMA-ES: covariance matrix adaptation, with the semantics of pycma.

Equations and symbols follow Hansen, "The CMA Evolution Strategy: A Tutorial" (arXiv:1604.00772);
constants are those of pycma 4.5, the package the paper used, which adds a step-size damping for
large populations. `ask` and `tell` are the algorithm, `stopping.py` says when it is over, `cma`
binds them to a `Refiner`, and `restarts.py` starts it again with larger populations.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxshape.search import stopping
from jaxshape.search.batching import apply_if
from jaxshape.search.refiner import (
    Candidate,
    Distribution,
    Objective,
    Refiner,
    StopReason,
    Trace,
    finite_or_inf,
    keep_better,
    start_trace,
    summarise,
)
from jaxshape.search.stopping import History, Tolerances


class Constants(NamedTuple):
    """What follows from the dimension and the population (tutorial, Table 1)."""

    weights: Float[Array, " capacity"]  # w_i; the positive ones sum to 1
    mu_eff: Float[Array, ""]  # variance-effective number of parents
    c_sigma: Float[Array, ""]  # rate of the step-size path
    damping: Float[Array, ""]  # d_sigma
    c_c: Float[Array, ""]  # rate of the covariance path
    c_1: Float[Array, ""]  # rate of the rank-one update
    c_mu: Float[Array, ""]  # rate of the rank-mu update
    eigen_gap: Int[Array, ""]  # generations between eigendecompositions


class State(NamedTuple):
    """The distribution N(mean, sigma^2 C) of one search, and its best candidate."""

    mean: Float[Array, " d"]
    best: Candidate
    stop: Int[Array, ""]
    sigma: Float[Array, ""]
    covariance: Float[Array, "d d"]  # C
    basis: Float[Array, "d d"]  # B, eigenvectors of C as columns, as of the last decomposition
    scales: Float[Array, " d"]  # D, roots of its eigenvalues, ascending
    path_sigma: Float[Array, " d"]  # p_sigma
    path_c: Float[Array, " d"]  # p_c
    generation: Int[Array, ""]
    history: History


def default_population(dim: int) -> int:
    """The number of candidates in one generation, 4 + floor(3 ln d)."""
    return 4 + math.floor(3 * math.log(dim))


def cma(
    *,
    dim: int,
    sigma0: float,
    population: int | None = None,
    tolerances: Tolerances = Tolerances(),
) -> Refiner:
    """CMA-ES over points of `dim` numbers, starting from N(point, sigma0^2 I).

    `population` is the number of candidates per iteration, pycma's 4 + floor(3 ln dim) by default.
    To start from another covariance, search in another space (`space.py`). `resume` keeps mean,
    sigma and C of an earlier search; its paths led down another objective. ValueError for a step
    size or a population that makes no search.
    """
    size = default_population(dim) if population is None else population
    require_settings(sigma0, size)

    def init(key: Array, point: Float[Array, " d"], loss: Float[Array, ""]) -> tuple[State, Trace]:
        del key  # the start is the given point
        return started(start(Candidate(point, loss), sigma0, dim, size))

    def step(key: Array, state: State, objective: Objective) -> tuple[State, Trace]:
        points = ask(key, state, size)
        losses = jax.vmap(objective)(points)
        state = tell(state, points, losses, constants(dim, size))
        state = stopping.check(state, losses, sigma0, size, tolerances)
        evaluations = 1 + size * state.generation
        return state, summarise(state.best, points, losses, evaluations, distribution(state))

    def resume(key: Array, state: State, loss: Float[Array, ""]) -> tuple[State, Trace]:
        fresh, _ = init(key, state.best.point, loss)
        kept = {name: getattr(state, name) for name in _DISTRIBUTION}
        return started(fresh._replace(**kept))

    return Refiner(init, step, resume)


_DISTRIBUTION = ("mean", "sigma", "covariance", "basis", "scales")


def require_settings(sigma0: float, population: int) -> None:
    """ValueError for a step size or a population that makes no search."""
    if not (math.isfinite(sigma0) and sigma0 > 0):
        raise ValueError(f"sigma0 is {sigma0}; it is a standard deviation, so give one above 0.")
    if population < 3:
        raise ValueError(
            f"The population is {population}; CMA-ES ranks candidates, so give 3 or more."
        )


def constants(dim: int, population: int | Int[Array, ""], capacity: int | None = None) -> Constants:
    """pycma's default constants for a dimension and a population (tutorial, Table 1).

    The population may be traced if a static `capacity` bounds it: weights behind it are 0.
    """
    d, size = dim, jnp.asarray(population, float)
    rank = jnp.arange(1, (population if capacity is None else capacity) + 1)
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


def start(first: Candidate, sigma0: Float[Array, ""] | float, dim: int, population: int) -> State:
    """The distribution N(first point, sigma0^2 I) before the first generation."""
    point = first.point
    if point.shape != (dim,):
        raise ValueError(
            f"The point has shape {point.shape}; this search was built for ({dim},)."
            " Batch with jax.vmap."
        )
    identity, zero = jnp.eye(dim, dtype=point.dtype), jnp.zeros_like(point)
    return State(
        mean=point,
        best=first._replace(loss=finite_or_inf(first.loss)),
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


def started(state: State) -> tuple[State, Trace]:
    """A state that has evaluated one point, with its trace."""
    return state, start_trace(state.best, distribution(state))


def distribution(state: State) -> Distribution:
    """What a reader plots of the distribution."""
    return Distribution(
        sigma=state.sigma,
        standard_deviations=state.sigma * jnp.sqrt(jnp.diag(state.covariance)),
        axis_lengths=state.sigma * state.scales,
    )


@jax.default_matmul_precision("highest")  # on GPU the default drops most of the mantissa
def ask(key: Array, state: State, number: int) -> Float[Array, "{number} d"]:
    """Sample candidates, x = m + sigma C^(1/2) z (Eqs. 38 - 40).

    The tutorial samples B D z, which has the same distribution, but B is arbitrary where
    eigenvalues are equal; the symmetric root lets equal keys give equal points in any batch.
    """
    z = jax.random.normal(key, (number, len(state.mean)), state.mean.dtype)
    return state.mean + state.sigma * (z @ state.basis * state.scales) @ state.basis.T


@jax.default_matmul_precision("highest")
def tell(
    state: State,
    points: Float[Array, "capacity d"],
    losses: Float[Array, " capacity"],
    constants: Constants,
) -> State:
    """Move the distribution towards the better candidates (tutorial, Eqs. 41 - 47).

    Only the order of the losses matters. Equal losses keep the order of the candidates, so that
    a flat objective is random selection, under which the step size stays unbiased; NaN and
    infinite losses rank last. The points need not come from `ask`.
    """
    c, dim = constants, len(state.mean)
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
    lost = (1 - h_sigma) * c.c_c * (2 - c.c_c)  # variance the waiting path lacks
    # A bad step is taken at the length sqrt(d), or one outlier could make C indefinite (Eq. 46).
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


def _sphere(state: State, steps: Float[Array, "*n d"]) -> Float[Array, "*n d"]:
    """D^-1 B^T y: steps in units of the current distribution, along its axes."""
    return steps @ state.basis / state.scales


def _balanced(state: State) -> State:
    """The same distribution, its scale moved from C into sigma before C under- or overflows.

    A run without stopping can go that far: large populations shrink C instead of sigma.
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
