"""Overlap of two voxel grids."""

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Shaped

AXES = (-3, -2, -1)


def iou(
    predicted: Shaped[Array | np.ndarray, "*#batch x y z"],
    truth: Shaped[Array | np.ndarray, "*#batch x y z"],
) -> Float[Array, "..."]:
    """Intersection over union of the occupied voxels.

    |A and B| / |A or B|, with the true union; the paper prints a sum instead (section 4). Two empty
    grids have an IoU of 1.

    Args:
        predicted: Occupied voxels `[*batch x y z]`: booleans, or integers that are 0 or 1. Leading
            axes broadcast.
        truth: Occupied voxels of the true shape `[*batch x y z]`, in the same form.

    Returns:
        One number from 0 to 1 for each pair of grids `[*batch]`.

    Raises:
        ValueError: A grid holds other values, such as probabilities or logits. Under `jax.jit` the
            values of integers are not known: every value other than 0 is occupied.
    """
    a, b = _occupied(predicted, "predicted"), _occupied(truth, "truth")
    intersection = jnp.sum(a & b, axis=AXES)
    union = jnp.sum(a | b, axis=AXES)
    return jnp.where(union == 0, 1.0, intersection / jnp.maximum(union, 1))


def _occupied(
    grid: Shaped[Array | np.ndarray, "..."], name: str
) -> Bool[Array | np.ndarray, "..."]:
    """The voxels of a grid as booleans; raises `ValueError` for values other than 0 and 1."""
    if grid.dtype == bool:
        return grid
    if not jnp.issubdtype(grid.dtype, jnp.integer):
        raise ValueError(
            f"The {name} grid holds {grid.dtype}; booleans, or integers that are 0 or 1, are "
            "expected. Compare probabilities with 0.5, or logits with 0, first."
        )
    if not isinstance(grid, Tracer) and not np.isin(grid, (0, 1)).all():
        raise ValueError(
            f"The {name} grid holds integers other than 0 and 1, such as labels; say which of them "
            "are occupied, for example by `grid > 0`."
        )
    return grid != 0
