"""Principal components of the training grids: the inexpensive baseline for every network.

A shape is the mean grid plus `d` components, `p = mean + code @ components`, and its logits are
`slope (p - 1/2)`. The first code is the most probable one given the voxels that were measured: the
codes of the training set are normal with the variances of their components, and each voxel differs
from `p` by independent noise.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from jaxshape.geometry.grids import Grids
from jaxshape.model.shapes import Prepared, ShapeModel, ShapePrior

PASSES = 4
"""Power iterations of the randomised decomposition; shapes need several, as their spectrum decays
slowly."""

OVERSAMPLING = 10
"""Directions iterated in addition to the components that are kept (Halko et al., 2011)."""


def encode(params: PyTree, grids: Grids) -> Float[Array, "b d"]:
    """The most probable code given F, from the voxels that are not occluded."""
    components = params["components"]
    noise = params["noise"]

    def one(occupied, known):
        weighted = components * known
        precision = weighted.reshape(len(components), -1) @ components.reshape(
            len(components), -1
        ).T + noise * jnp.diag(1 / params["variances"])
        return jnp.linalg.solve(
            precision, jnp.einsum("dxyz,xyz->d", weighted, occupied - params["mean"])
        )

    known = 1 - grids.occluded.astype(components.dtype)
    return jax.lax.map(lambda x: one(*x), (grids.occupied.astype(components.dtype), known))


def decode(prepared: Prepared, code: Float[Array, "n d"]) -> Float[Array, "n x y z"]:
    """Logits of the grids of codes."""
    params = prepared.shared
    p = params["mean"] + jnp.einsum(
        "nd,dxyz->nxyz", code.astype(params["mean"].dtype), params["components"]
    )
    return params["slope"] * (p - 0.5)


def shapes(params: PyTree) -> PyTree:
    """Expected shapes of all arrays, for a basis with this number of components and voxels."""
    d, *grid = params["components"].shape
    sizes = {"components": (d, *grid), "mean": grid, "variances": (d,), "slope": (), "noise": ()}
    if len(set(grid)) != 1 or len(grid) != 3:
        raise KeyError("components of cubic grids")
    return {name: jax.ShapeDtypeStruct(tuple(size), jnp.float32) for name, size in sizes.items()}


PCA = ShapeModel("pca", encode, decode, shapes=shapes)
"""A linear basis."""


def fit(surfaces: Bool[np.ndarray, "n x y z"], code: int, seed: int = 0) -> ShapePrior:
    """The principal components of complete surfaces. [host]

    Args:
        surfaces: Occupancy grids of the training set `[n x y z]`, more than `code` of them.
        code: Components to keep, which is the dimension of a code.
        seed: Seed of the randomised decomposition.

    Returns:
        A shape prior of the model `PCA`; its codes have mean 0 and a diagonal covariance.

    Raises:
        ValueError: There are too few grids.
    """
    n, *grid = surfaces.shape
    if n <= code:
        raise ValueError(
            f"There are {n} training grids for {code} components; give at least {code + 1} grids, "
            "or a smaller code."
        )
    rows = surfaces.reshape(n, -1).astype(np.float32)
    mean = rows.mean(axis=0)
    rows -= mean
    components, variances = _principal(rows, code, np.random.default_rng(seed))
    left = float(np.mean((rows - (rows @ components.T) @ components) ** 2))
    codes = rows @ components.T
    fitted = mean + codes[:512] @ components
    params = {
        "components": components.reshape(code, *grid),
        "mean": mean.reshape(grid),
        "variances": variances,
        "slope": np.float32(_best_slope(fitted, surfaces.reshape(n, -1)[:512])),
        "noise": np.float32(left),
    }
    params = jax.tree.map(jnp.asarray, params)
    return ShapePrior(PCA, params, jnp.zeros(code), jnp.diag(params["variances"]))


def _principal(rows, count: int, rng: np.random.Generator):
    """Leading principal components of centred rows, and their variances, by subspace iteration."""
    width = min(count + OVERSAMPLING, len(rows))
    basis = np.linalg.qr(rows.T @ rng.standard_normal((len(rows), width), np.float32))[0]
    for _ in range(PASSES):
        basis = np.linalg.qr(rows.T @ (rows @ basis))[0]
    _, singular, components = np.linalg.svd(rows @ basis, full_matrices=False)
    components = (components @ basis.T)[:count]
    return components.astype(np.float32), (singular[:count] ** 2 / len(rows)).astype(np.float32)


def _best_slope(p, occupied) -> float:
    """The slope of the logits with the least cross-entropy, by Newton's method from 8."""
    slope, x = 8.0, p.astype(np.float64) - 0.5
    for _ in range(20):
        q = 1 / (1 + np.exp(-slope * x))
        slope -= np.mean((q - occupied) * x) / np.mean(q * (1 - q) * x**2)
    return slope
