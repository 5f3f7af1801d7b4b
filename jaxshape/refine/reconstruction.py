"""From measurements to shapes: first code, search, completed and composed grids (paper, Fig. 4)."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from jaxshape.model.autoencoder import decode, encode
from jaxshape.model.weights import ShapePrior
from jaxshape.refine.cma import cma
from jaxshape.refine.config import Method, RefineConfig
from jaxshape.refine.gradient import gradient
from jaxshape.refine.objective import BALANCED_WEIGHT, cross_entropy, target
from jaxshape.refine.refiner import Refiner, Trace
from jaxshape.refine.run import refine


class Reconstruction(NamedTuple):
    """Shapes of a batch of objects, from first code to composed grid."""

    first_code: Float[Array, "object d"]
    code: Float[Array, "object d"]
    completed_first: Bool[Array, "object x y z"]
    """The encoder's answer, G(lambda_0) > 0.5."""
    logits: Float[Array, "object x y z"]
    """Of the refined shape."""
    completed: Bool[Array, "object x y z"]
    """The refined shape, G(lambda) > 0.5."""
    composed: Bool[Array, "object x y z"]
    """What was observed as it was measured, and the refined shape where nothing was."""
    first_objective: Float[Array, " object"]
    objective: Float[Array, " object"]
    """Eq. 7, in nats per voxel, of the first and of the refined code."""
    trace: Trace | None
    """Of the search, per object and iteration; None for the encoder alone."""


def compose(
    occupied: Bool[Array, "*batch x y z"],
    occluded: Bool[Array, "*batch x y z"],
    completed: Bool[Array, "*batch x y z"],
) -> Bool[Array, "*batch x y z"]:
    """Keep what was observed as measured; fill what was occluded with the completed shape."""
    return jnp.where(occluded, completed, occupied)


def refiner_for(method: Method, prior: ShapePrior, config: RefineConfig) -> Refiner | None:
    """The search of a method; none for the encoder alone."""
    if method == "cma":
        return cma(
            dim=len(prior.code_mean),
            sigma0=config.sigma0,
            population=config.population,
            covariance=np.asarray(prior.code_covariance, np.float64),
        )
    return gradient(config.step_size) if method == "gradient" else None


def reconstruct(
    keys: Key[Array, " object"],
    prior: ShapePrior,
    occupied: Bool[Array, "object x y z"],
    occluded: Bool[Array, "object x y z"],
    refiner: Refiner | None,
    config: RefineConfig,
) -> Reconstruction:
    """Rebuild a batch of objects from their measurement grids F and occlusion masks M.

    `keys` holds one random key per object.
    """
    first_code = encode(prior.params, occupied)
    first_logits = decode(prior.params, first_code)
    weight = BALANCED_WEIGHT if config.objective == "balanced" else 1.0
    targets = target(occupied, occluded, first_logits, occupied_weight=weight)
    first_objective = cross_entropy(first_logits, targets)
    if refiner is None:
        code, logits, objective, trace = first_code, first_logits, first_objective, None
    else:
        found = refine(keys, prior.params, first_code, targets, refiner, config.iterations)
        code, objective, trace = found.code, found.loss, found.trace
        logits = decode(prior.params, code)
    completed = logits > 0
    return Reconstruction(
        first_code=first_code,
        code=code,
        completed_first=first_logits > 0,
        logits=logits,
        completed=completed,
        composed=compose(occupied, occluded, completed),
        first_objective=first_objective,
        objective=objective,
        trace=trace,
    )


def reconstruct_jit(refiner: Refiner | None, config: RefineConfig) -> Callable[..., Reconstruction]:
    """`reconstruct` with a fixed search, compiled once for each number of objects."""
    return jax.jit(partial(reconstruct, refiner=refiner, config=config))


def all_measured(occupied: Bool[Array | np.ndarray, "*batch x y z"]) -> bool:
    """Whether every grid has an occupied voxel, something to rebuild from."""
    return bool(np.asarray(occupied).any(axis=(-3, -2, -1)).all())


def require_measured(occupied: Bool[Array | np.ndarray, "*batch x y z"]) -> None:
    """Raise `ValueError` when a grid has no occupied voxel: there is nothing to rebuild from."""
    if not all_measured(occupied):
        raise ValueError(
            "Nothing was measured inside the object's box: no segmented depth pixel falls into it. "
            "Check the box, the masks, the depth scale and which way the poses go."
        )
