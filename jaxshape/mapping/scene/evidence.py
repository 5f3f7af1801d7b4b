"""Class and front of an object, from how well each prior predicts hidden parts of it.

A decoder that sees the measurement explains whatever it is shown, so that agreement with the
measurement says nothing about the class. Here a part of the measurement is hidden from the prior,
the shape is decoded from the rest, and the prediction of the hidden part is scored. A prior of
chairs predicts the lower half of a chair from its upper half, but not the lower half of a plant.
Where no prior predicts well enough, the object is of none of the classes.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxshape.geometry.grids import Grids
from jaxshape.model.shapes import ShapePrior, decode, encode

TURNS = 4
"""Fronts that are compared: the box of an object, turned by quarters about the vertical."""


class Stance(NamedTuple):
    """How an object stands in the box that a prior is given.

    Attributes:
        quarters: Quarters of a turn of its front, from +z to +x.
        is_upside_down: Whether it is mirrored from top to bottom.
    """

    quarters: int
    is_upside_down: bool = False


UPRIGHT = tuple(Stance(quarters) for quarters in range(TURNS))
"""An object with its front at each side."""

TOPPLED = tuple(Stance(quarters, is_upside_down=True) for quarters in range(TURNS))
"""The same, upside down."""

BLOCK = 8
"""Voxels along each side of the blocks that are hidden."""


def hidden_parts(resolution: int) -> Bool[np.ndarray, "part x y z"]:
    """Parts of a grid that are hidden in turn: halves, and the blocks of a 3D chessboard.

    Args:
        resolution: Voxels along each axis.
    """
    n = resolution
    x, y, z = np.indices((n, n, n))
    board = (x // BLOCK + y // BLOCK + z // BLOCK) % 2 == 0
    return np.stack([y < n // 2, y >= n // 2, z < n // 2, z >= n // 2, board, ~board])


def turned(grid: Array, quarters: int) -> Array:
    """A grid `[... x y z]` in a box whose front is turned by quarters about the vertical.

    Args:
        grid: The grid.
        quarters: Quarters of a turn of the front, from +z to +x.
    """
    return jnp.rot90(grid, quarters, axes=(-3, -1))


def _standing(grid: Array, stance: Stance) -> Array:
    """A grid `[... x y z]` in a stance."""
    return turned(jnp.flip(grid, -2) if stance.is_upside_down else grid, stance.quarters)


@partial(jax.jit, static_argnums=2)
def predict_hidden(
    prior: ShapePrior, grids: Grids, stances: tuple[Stance, ...] = UPRIGHT
) -> Float[Array, "object stance"]:
    """Score the predictions of a prior for hidden parts, for each stance.

    All hidden parts of all objects in all stances go through one call of the decoder.

    Args:
        prior: The shape prior.
        grids: F and M of each object `[object x y z]`.
        stances: The stances.

    Returns:
        Log-likelihood of the hidden surface voxels, in nats per voxel: the mean over the voxels of
        each hidden part, then over the parts.
    """
    F, M = (
        jnp.stack([_standing(jnp.float32(x), one) for one in stances], axis=1)[:, :, None]
        for x in grids[:2]
    )  # [object stance 1 x y z]
    hidden = jnp.asarray(hidden_parts(F.shape[-1]))  # [part x y z]
    shape = jnp.broadcast_shapes(F.shape, hidden.shape)
    rows = Grids(
        jnp.broadcast_to(jnp.where(hidden, 0.0, F), shape).reshape(-1, *shape[-3:]),
        jnp.broadcast_to(jnp.where(hidden, 1.0, M), shape).reshape(-1, *shape[-3:]),
    )
    code = encode(prior, rows)
    logits = decode(prior, code, rows if prior.model.conditional else None).reshape(shape)
    surface = F * (1 - M) * hidden
    total = jnp.sum(surface, (-3, -2, -1))
    found = jnp.sum(jax.nn.log_sigmoid(logits) * surface, (-3, -2, -1)) / jnp.maximum(total, 1e-6)
    counts = total > 1  # a part in which nothing was measured says nothing
    return jnp.sum(jnp.where(counts, found, 0), -1) / jnp.maximum(counts.sum(-1), 1)
