"""Class and front of an object, from how well each prior predicts hidden parts of it.

A decoder that sees the measurement explains whatever it is shown, so that agreement with the
measurement says nothing about the class. Here a part of the measurement is hidden from the prior,
the shape is decoded from the rest, and the prediction of the hidden part is scored. A prior of
chairs predicts the lower half of a chair from its upper half, but not the lower half of a plant.
Where no prior predicts well enough, the object is of none of the classes.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxshape.geometry.grids import Grids
from jaxshape.model.shapes import ShapePrior, decode, encode

TURNS = 4
"""Fronts that are compared: the box of an object, turned by quarters about the vertical."""

BLOCK = 8
"""Voxels along each side of the blocks that are hidden."""


class Predicted(NamedTuple):
    """How well hidden parts were predicted; means over hidden voxels, then over hidden parts.

    Attributes:
        surface: Log-likelihood of hidden surface voxels `[*batch]`, in nats per voxel.
        free: Log-likelihood of hidden free voxels `[*batch]`, in nats per voxel.
        overlap: Intersection over union of predicted and hidden surface `[*batch]`, from 0 to 1.
        surprise: Log-likelihood minus its value expected by the prior itself `[*batch]`, in nats
            per voxel; near 0 for an object like those of the prior, negative for others.
    """

    surface: Float[Array, "*batch"]
    free: Float[Array, "*batch"]
    overlap: Float[Array, "*batch"]
    surprise: Float[Array, "*batch"]


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


@jax.jit
def predict_hidden(prior: ShapePrior, grids: Grids) -> Predicted:
    """Score the predictions of a prior for hidden parts, for each front.

    All hidden parts of all objects in all turns go through one call of the decoder.

    Args:
        prior: The shape prior.
        grids: F and M of each object `[object x y z]`.

    Returns:
        Scores `[object turn]`.
    """
    F, M = (
        jnp.stack([turned(jnp.float32(x), k) for k in range(TURNS)], axis=1)[:, :, None]
        for x in grids[:2]
    )  # [object turn 1 x y z]
    hidden = jnp.asarray(hidden_parts(F.shape[-1]))  # [part x y z]
    shape = jnp.broadcast_shapes(F.shape, hidden.shape)
    rows = Grids(
        jnp.broadcast_to(jnp.where(hidden, 0.0, F), shape).reshape(-1, *shape[-3:]),
        jnp.broadcast_to(jnp.where(hidden, 1.0, M), shape).reshape(-1, *shape[-3:]),
    )
    code = encode(prior, rows)
    logits = decode(prior, code, rows if prior.model.conditional else None).reshape(shape)
    return _scored(logits, F, (1 - M) * hidden)


def _scored(
    logits: Float[Array, "object turn part x y z"],
    F: Float[Array, "object turn 1 x y z"],
    known: Float[Array, "object turn part x y z"],
) -> Predicted:
    axes = (-3, -2, -1)

    def mean(values, weight):
        total = jnp.sum(weight, axes)
        found = jnp.sum(values * weight, axes) / jnp.maximum(total, 1e-6)
        counts = total > 1  # a part in which nothing was measured says nothing
        return jnp.sum(jnp.where(counts, found, 0), -1) / jnp.maximum(counts.sum(-1), 1)

    occupied, free = -jax.nn.softplus(-logits), -jax.nn.softplus(logits)
    p = jax.nn.sigmoid(logits)
    surface, empty = F * known, (1 - F) * known
    both = jnp.sum(jnp.where(p > 0.5, surface, 0), axes)
    either = jnp.sum(jnp.where(p > 0.5, known, surface), axes)
    expected = p * occupied + (1 - p) * free
    got = F * occupied + (1 - F) * free
    nearby = known * jnp.maximum(p, F)  # most of a grid is free space and easy to predict
    return Predicted(
        surface=mean(occupied, surface),
        free=mean(free, empty),
        overlap=jnp.mean(both / jnp.maximum(either, 1e-6), -1),
        surprise=mean(got - expected, nearby),
    )
