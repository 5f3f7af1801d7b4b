"""CMA-ES: covariance matrix adaptation over a latent code, with the semantics of pycma.

Equations and symbols follow Hansen, "The CMA Evolution Strategy: A Tutorial"
(arXiv:1604.00772); constants are those of pycma 4.5, the package the paper used, which adds a
step-size damping for large populations. `ask` and `tell` are the algorithm; `cma` binds them to
a `Refiner`. Against pycma there are no bounds, no mirrored samples (its default below six
candidates), no restarts and no stopping: a run has a fixed number of generations.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxshape.refine.refiner import (
    Candidate,
    Objective,
    Refiner,
    Trace,
    finite_or_inf,
    keep_better,
    summarise,
)


@dataclass(frozen=True)
class Settings:
    """Constants of one search, all derived from the dimension, the population and `C_0`."""

    dim: int  # d
    weights: Float[np.ndarray, " population"]  # w_i; the positive ones sum to 1
    mu_eff: float  # variance-effective number of parents
    c_sigma: float  # rate of the step-size path
    damping: float  # d_sigma
    c_c: float  # rate of the covariance path
    c_1: float  # rate of the rank-one update
    c_mu: float  # rate of the rank-mu update
    expected_norm: float  # E |N(0, I)|
    eigen_gap: int  # generations between eigendecompositions
    root: Float[np.ndarray, "d d"]  # L, with L L^T = C_0: whitened step -> code-space step
    inverse_root: Float[np.ndarray, "d d"]

    @property
    def population(self) -> int:
        return len(self.weights)


class State(NamedTuple):
    """The distribution of one search, mean + sigma L N(0, C), and its best candidate."""

    mean: Float[Array, " d"]
    best: Candidate
    sigma: Float[Array, ""]
    covariance: Float[Array, "d d"]  # C, of the whitened steps
    basis: Float[Array, "d d"]  # B, eigenvectors of C as columns, as of the last decomposition
    scales: Float[Array, " d"]  # D, roots of its eigenvalues
    path_sigma: Float[Array, " d"]  # p_sigma
    path_c: Float[Array, " d"]  # p_c
    generation: Int[Array, ""]


def cma(
    *,
    dim: int,
    sigma0: float,
    population: int | None = None,
    covariance: Float[np.ndarray, "d d"] | None = None,
) -> Refiner:
    """CMA-ES over codes of `dim` numbers, starting from N(code, sigma0^2 covariance).

    `population` is the number of candidates per iteration, pycma's 4 + floor(3 ln dim) by default.
    `covariance` is `C_0`, the identity by default. The covariance of the training codes makes the
    search identical to one in the space whitened by them. Bad settings raise ValueError.
    """
    if not (math.isfinite(sigma0) and sigma0 > 0):
        raise ValueError(f"sigma0 is {sigma0}; it is a standard deviation, so give one above 0.")
    settings = derive_settings(dim=dim, population=population, covariance=covariance)

    def init(key: Array, code: Float[Array, " d"], loss: Float[Array, ""]) -> State:
        del key  # the start is the given code
        return start(settings, Candidate(code, loss), sigma0)

    def step(key: Array, state: State, objective: Objective) -> tuple[State, Trace]:
        codes = ask(settings, key, state)
        losses = jax.vmap(objective)(codes)
        state = tell(settings, state, codes, losses)
        return state, summarise(state.best, codes, losses)

    return Refiner(init, step)


def derive_settings(
    *,
    dim: int,
    population: int | None = None,
    covariance: Float[np.ndarray, "d d"] | None = None,
) -> Settings:
    """pycma's default constants for a dimension and a population (tutorial, Table 1)."""
    d, size = dim, 4 + math.floor(3 * math.log(dim)) if population is None else population
    if size < 3:
        raise ValueError(f"The population is {size}; CMA-ES ranks candidates, so give 3 or more.")
    rank = np.arange(1, size + 1)
    raw = math.log((size + 1) / 2) - np.log(rank)  # Eq. 49
    positive, negative = np.maximum(raw, 0), np.minimum(raw, 0)
    mu_eff = positive.sum() ** 2 / (positive**2).sum()
    mu_eff_negative = negative.sum() ** 2 / (negative**2).sum()

    c_1 = min(1, size / 6) * 2 / ((d + 1.3) ** 2 + mu_eff)
    c_mu = 2 * (0.25 + mu_eff + 1 / mu_eff - 2) / ((d + 2) ** 2 + mu_eff)
    c_mu = min(1 - c_1, c_mu)
    c_sigma = min(0.5, (mu_eff + 2) / (d + mu_eff + 3))

    # Negative weights: no decay of C, a rate that fits their number, positive definite (50 - 53).
    negative_sum = min(
        1 + c_1 / c_mu, 1 + 2 * mu_eff_negative / (mu_eff + 2), (1 - c_1 - c_mu) / (c_mu * d)
    )
    # pycma's own term: it damps large populations, up to three times as hard in many dimensions.
    many = max(1, 3 * (1 - 0.5 ** (d / 9))) * math.sqrt((mu_eff - 1) / (d + 1))
    root = _root(d, covariance)
    return Settings(
        dim=d,
        weights=positive / positive.sum() - negative_sum * negative / negative.sum(),
        mu_eff=float(mu_eff),
        c_sigma=float(c_sigma),
        damping=float(1 + 2 * max(0, many - 1) + c_sigma),
        c_c=float((4 + mu_eff / d) / (d + 4 + 2 * mu_eff / d)),
        c_1=float(c_1),
        c_mu=float(c_mu),
        expected_norm=math.sqrt(2) * math.exp(math.lgamma((d + 1) / 2) - math.lgamma(d / 2)),
        eigen_gap=math.ceil(1 / ((c_1 + c_mu) * d * 10)),
        root=root,
        inverse_root=np.linalg.inv(root),
    )


def _root(dim: int, covariance: Float[np.ndarray, "d d"] | None) -> Float[np.ndarray, "d d"]:
    """L with L L^T = C_0; ValueError if C_0 is not a covariance of `dim` numbers."""
    if covariance is None:
        return np.eye(dim)
    covariance = np.asarray(covariance, np.float64)
    if covariance.shape != (dim, dim) or not np.allclose(covariance, covariance.T):
        raise ValueError(
            f"The covariance has shape {covariance.shape}; expected a symmetric {dim} x {dim}."
        )
    try:
        return np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        raise ValueError(
            "The covariance is not positive definite; estimate it from more codes than dimensions,"
            " or add a small multiple of the identity."
        ) from None


def start(settings: Settings, first: Candidate, sigma0: float) -> State:
    """The distribution N(first code, sigma0^2 C_0) before the first generation."""
    code = first.code
    if code.shape != (settings.dim,):
        raise ValueError(
            f"The code has shape {code.shape}; this search was built for ({settings.dim},)."
            " Batch with jax.vmap."
        )
    identity, zero = jnp.eye(settings.dim, dtype=code.dtype), jnp.zeros_like(code)
    return State(
        mean=code,
        best=first._replace(loss=finite_or_inf(first.loss)),
        sigma=jnp.asarray(sigma0, code.dtype),
        covariance=identity,
        basis=identity,
        scales=jnp.ones_like(code),
        path_sigma=zero,
        path_c=zero,
        generation=jnp.asarray(0, jnp.int32),
    )


@jax.default_matmul_precision("highest")  # on GPU the default drops most of the mantissa
def ask(settings: Settings, key: Array, state: State) -> Float[Array, "population d"]:
    """Sample the candidates of one generation, x = m + sigma L C^(1/2) z (Eqs. 38 - 40).

    The tutorial samples B D z, which has the same distribution, but B is arbitrary where
    eigenvalues are equal; the symmetric root lets equal keys give equal codes in any batch.
    """
    z = jax.random.normal(key, (settings.population, settings.dim), state.mean.dtype)
    steps = (z @ state.basis * state.scales) @ state.basis.T
    return state.mean + state.sigma * steps @ jnp.asarray(settings.root.T, z.dtype)


@jax.default_matmul_precision("highest")
def tell(
    settings: Settings,
    state: State,
    codes: Float[Array, "population d"],
    losses: Float[Array, " population"],
) -> State:
    """Move the distribution towards the better candidates (tutorial, Eqs. 41 - 47).

    Only the order of the losses matters. Equal losses keep the order of the candidates, so that
    a flat objective is random selection, under which the step size stays unbiased; NaN and
    infinite losses rank last. The codes need not come from `ask`.
    """
    s, dtype = settings, state.mean.dtype
    weights = jnp.asarray(s.weights, dtype)
    inverse_root, root = jnp.asarray(s.inverse_root, dtype), jnp.asarray(s.root, dtype)
    generation = state.generation + 1

    order = jnp.argsort(finite_or_inf(losses), stable=True)
    steps = (codes[order] - state.mean) / state.sigma @ inverse_root.T  # y_i, best first
    mean_step = jnp.maximum(weights, 0) @ steps
    mean = state.mean + state.sigma * root @ mean_step

    # Step size: longer or shorter path than under random selection?
    path_sigma = (1 - s.c_sigma) * state.path_sigma + math.sqrt(
        s.c_sigma * (2 - s.c_sigma) * s.mu_eff
    ) * (_sphere(state, mean_step) @ state.basis.T)
    norm = jnp.linalg.norm(path_sigma)
    change = s.c_sigma / s.damping * (norm / s.expected_norm - 1)
    sigma = state.sigma * jnp.exp(jnp.clip(change, -1, 1))

    # Covariance: the rank-one path waits while the step size still grows fast (h_sigma = 0).
    age = 1 - (1 - s.c_sigma) ** (2 * generation)
    h_sigma = (norm**2 / age < (2 + 4 / (s.dim + 1)) * s.dim).astype(dtype)
    path_c = (1 - s.c_c) * state.path_c + h_sigma * math.sqrt(
        s.c_c * (2 - s.c_c) * s.mu_eff
    ) * mean_step
    lost = (1 - h_sigma) * s.c_c * (2 - s.c_c)  # variance the waiting path lacks
    # A bad step is taken at the length sqrt(d), or one outlier could make C indefinite (Eq. 46).
    length = jnp.linalg.norm(_sphere(state, steps), axis=-1)
    signed = jnp.where(weights < 0, weights * s.dim / (length + 1e-9) ** 2, weights)
    covariance = (
        (1 - s.c_1 * (1 - lost) - s.c_mu * s.weights.sum()) * state.covariance
        + s.c_1 * jnp.outer(path_c, path_c)
        + s.c_mu * (steps.T * signed) @ steps
    )

    covariance, basis, scales = _decompose_if(
        generation % s.eigen_gap == 0, covariance, state.basis, state.scales
    )
    return _balanced(
        State(
            mean=mean,
            best=keep_better(state.best, codes, losses),
            sigma=sigma,
            covariance=covariance,
            basis=basis,
            scales=scales,
            path_sigma=path_sigma,
            path_c=path_c,
            generation=generation,
        )
    )


def _sphere(state: State, steps: Float[Array, "*n d"]) -> Float[Array, "*n d"]:
    """D^-1 B^T y: whitened steps in units of the current distribution, along its axes."""
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


# A plain `lax.cond` turns into a select under `jax.vmap` and would decompose every covariance in
# every generation. Objects of a batch are due together, so one branch decides for all of them.
@jax.custom_batching.custom_vmap
def _decompose_if(
    due: Bool[Array, ""],
    covariance: Float[Array, "d d"],
    basis: Float[Array, "d d"],
    scales: Float[Array, " d"],
) -> tuple[Float[Array, "d d"], Float[Array, "d d"], Float[Array, " d"]]:
    """(C, B, D), with B and D computed anew where `due`."""
    return jax.lax.cond(due, _decompose, lambda *same: same, covariance, basis, scales)


@_decompose_if.def_vmap
def _decompose_if_any(axis_size: int, is_batched, due, *matrices):
    due, *matrices = (
        x if batched else jnp.broadcast_to(x, (axis_size, *x.shape))
        for x, batched in zip((due, *matrices), is_batched, strict=True)
    )

    def decompose(*old):
        new = jax.vmap(_decompose)(*old)
        return tuple(
            jnp.where(jnp.expand_dims(due, range(1, x.ndim)), x, y)
            for x, y in zip(new, old, strict=True)
        )

    decomposed = jax.lax.cond(jnp.any(due), decompose, lambda *same: same, *matrices)
    return decomposed, (True, True, True)
