"""Measurements and reconstructions made by hand, for tests of what is written of them."""

import jax.numpy as jnp
import numpy as np

from jaxshape.geometry.grid import GridFrame
from jaxshape.results.output import Observation
from jaxshape.search.composition import compose
from jaxshape.search.reconstruction import Reconstruction
from jaxshape.search.refiner import StopReason, Trace

T_WORLD_OBJECT = np.array([[0, 0, 1, 5], [0, 1, 0, 6], [-1, 0, 0, 7], [0, 0, 0, 1]], float)


def solid(lower, upper):
    """A filled block of voxels."""
    grid = np.zeros((32, 32, 32), bool)
    grid[tuple(slice(a, b) for a, b in zip(lower, upper, strict=True))] = True
    return grid


def observation(occupied, occluded, truth, frame: GridFrame) -> Observation:
    """One depth image of a wall, and grids."""
    depth = [np.full((20, 30), 1.5, np.float32)]
    return Observation(depth, occupied, occluded, frame, T_WORLD_OBJECT, truth)


def reconstruction(seen: Observation, first, completed, *, steps: int) -> Reconstruction:
    """A search that stopped after three of `steps` iterations, and was constant from then on."""
    losses = jnp.array([[5.0, 4, 3, 3, 3]])[:, :steps]
    evaluations = jnp.array([[11, 21, 31, 31, 31]])[:, :steps]
    composed = compose(*map(jnp.asarray, (seen.occupied, seen.occluded, completed)))
    return Reconstruction(
        first_code=jnp.zeros((1, 10)),
        code=jnp.arange(10.0)[None],
        completed_first=jnp.asarray(first)[None],
        logits=jnp.where(completed, 1.0, -1.0)[None],
        completed=jnp.asarray(completed)[None],
        composed=composed[None],
        fill_logits=jnp.where(completed, 1.0, -1.0)[None],
        symmetric=jnp.array([True]),
        agreement=jnp.array([0.875]),
        first_objective=jnp.array([0.5]),
        objective=jnp.array([0.25]),
        trace=Trace(*(losses,) * 3, evaluations),
        path=jnp.zeros((1, steps, 10)),
        iterations=jnp.array([3]),
        stop=jnp.array([StopReason.TOLX]),
    )
