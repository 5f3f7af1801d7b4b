"""A shape prior that knows one shape and compiles at once, for tests of tracking and mapping.

Tracking leans on the predicted shape, so that a random network would lead it astray. Here the mean
of the code space is the shape, and codes add smooth waves to it.
"""

import jax.numpy as jnp
import numpy as np
import trimesh

from jaxshape.data.capture import SURFACE_SAMPLES, discretize
from jaxshape.data.meshes import sample_surface
from jaxshape.geometry import grid
from jaxshape.model.pca import PCA
from jaxshape.model.shapes import ShapePrior

CODE, SLOPE = 6, 6.0


def known_shape(mesh: trimesh.Trimesh, size: np.ndarray) -> ShapePrior:
    """A prior whose mean is the surface of a mesh in a box of this size."""
    frame = grid.fit_box(jnp.float32(-size / 2), jnp.float32(size / 2))
    points = sample_surface(mesh, SURFACE_SAMPLES, 0).astype(np.float32)
    shape = discretize(points, frame)
    axis = np.arange(32) / 32
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    waves = [np.sin(2 * np.pi * k * a) for k in (1, 2) for a in (x, y, z)]
    params = {
        "components": jnp.float32(0.3 / SLOPE * np.stack(waves)),
        "mean": shape.astype(jnp.float32),
        "variances": jnp.ones(CODE),
        "slope": jnp.float32(SLOPE),
        "noise": jnp.float32(1e3),
    }
    return ShapePrior(PCA, params, jnp.zeros(CODE), jnp.eye(CODE))
