"""Fit the calibration of a shape prior to objects that it was not trained on. [host]"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.optimize import minimize

from jaxshape.geometry.grids import Grids
from jaxshape.model.calibration import Calibration
from jaxshape.model.shapes import ShapePrior
from jaxshape.search.config import RefineConfig
from jaxshape.search.reconstruction import reconstruct

SAMPLES = 16
"""Samples of the posterior from which the spread of a logit is estimated."""

OBJECTS_AT_A_TIME = 8

LEAST_OBJECTS = 16
"""Smallest number of objects to which a calibration is fitted."""


def fit_calibration(
    prior: ShapePrior,
    grids: Grids,
    surface: Bool[Array | np.ndarray, "object x y z"],
    *,
    samples: int = SAMPLES,
    seed: int = 0,
) -> Calibration | None:
    """Fit the calibration that makes the true surfaces in occluded voxels most probable. [host]

    Args:
        prior: The shape prior; its own calibration, if any, is ignored.
        grids: F and M of objects outside the training set `[object x y z]`, fused from various
            numbers of frames.
        surface: True surface voxels of the objects `[object x y z]`.
        samples: Samples of the posterior, 2 or more; choose a similar `RefineConfig.samples` for
            searches.
        seed: Seed of the samples.

    Returns:
        The calibration; None for fewer objects than `LEAST_OBJECTS`.
    """
    if len(grids.occupied) < LEAST_OBJECTS:
        return None
    config = RefineConfig(samples=samples)

    @jax.jit
    def look(prior, grids, number):
        keys = jax.random.split(jax.random.key(seed + number), len(grids.occupied))
        found = reconstruct(keys, prior, grids.occupied, grids.occluded, None, config)
        assert found.samples is not None
        return found.fill_logits, jnp.std(found.samples, axis=1)

    parts = []
    for first in range(0, len(grids.occupied) - OBJECTS_AT_A_TIME + 1, OBJECTS_AT_A_TIME):
        rows = slice(first, first + OBJECTS_AT_A_TIME)
        seen = jax.tree.map(lambda x, rows=rows: jnp.asarray(x[rows], jnp.float32), grids)
        logits, spread = jax.device_get(look(prior, seen, first))
        hidden = np.asarray(grids.occluded[rows]) > 0.5
        parts.append([x[hidden] for x in (logits, spread, np.asarray(surface[rows]))])
    return fit(*map(np.concatenate, zip(*parts, strict=True)))


def fit(
    logits: Float[np.ndarray, " voxel"],
    spread: Float[np.ndarray, " voxel"],
    occupied: Bool[np.ndarray, " voxel"],
) -> Calibration:
    """The calibration of greatest likelihood: a logistic regression, which has one optimum.

    Args:
        logits: Logits of voxels.
        spread: Standard deviation of their samples' logits.
        occupied: Whether they are occupied.
    """
    features = np.stack([logits, -spread * logits, np.ones_like(logits)], 1).astype(np.float64)

    def cost(weights):
        z = features @ weights
        residual = 1 / (1 + np.exp(-z)) - occupied
        return np.mean(np.logaddexp(0, z) - occupied * z), features.T @ residual / len(z)

    bounds = [(0, None), (0, None), (None, None)]
    found = minimize(cost, [1.0, 0.0, 0.0], jac=True, method="L-BFGS-B", bounds=bounds)
    return Calibration(*map(float, found.x))
