"""From measurements to shapes: first code, search, completed and composed grids (paper, Fig. 4)."""

from collections.abc import Callable
from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from jaxshape.geometry.grid import RESOLUTION
from jaxshape.model.autoencoder import decode, encode
from jaxshape.model.weights import ShapePrior
from jaxshape.search.config import RefineConfig
from jaxshape.search.methods import build_refiner
from jaxshape.search.objective import BALANCED, PAPER, cross_entropy, target
from jaxshape.search.refiner import Refiner, Trace
from jaxshape.search.run import Penalty, refine
from jaxshape.search.space import LatentSpace, raw, whitened


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
    path: Float[Array, "object iteration d"] | None
    """The best code so far, after each iteration of the search."""
    iterations: Int[Array, " object"] | None
    """How many iterations the search took."""
    stop: Int[Array, " object"] | None
    """Why it ended, a `StopReason`."""


def compose(
    occupied: Bool[Array, "*batch x y z"],
    occluded: Bool[Array, "*batch x y z"],
    completed: Bool[Array, "*batch x y z"],
) -> Bool[Array, "*batch x y z"]:
    """Keep what was observed as measured; fill what was occluded with the completed shape."""
    return jnp.where(occluded, completed, occupied)


def refiner_for(method: str, prior: ShapePrior, config: RefineConfig) -> Refiner | None:
    """The search of a method (`methods`); none for "encoder", which only proposes a code."""
    if method == "encoder":
        return None
    return build_refiner(method, len(prior.code_mean), config)


def search_space(prior: ShapePrior, config: RefineConfig) -> LatentSpace:
    """The coordinates in which codes are searched."""
    if config.space == "whitened":
        return whitened(prior, config.bound)
    return raw(len(prior.code_mean), config.bound)


def unlikeliness(prior: ShapePrior, weight: float) -> Penalty:
    """What a code costs for lying far from those of the training set.

    Half its squared Mahalanobis distance, its negative log-density up to a constant, in nats per
    voxel as the objective is: with weight 1 the sum of both is least at the most probable code.
    """
    space, voxels = whitened(prior), RESOLUTION**3
    return lambda code: weight / voxels * 0.5 * jnp.sum(space.from_code(code) ** 2)


def reconstruct(
    keys: Key[Array, " object"],
    prior: ShapePrior,
    occupied: Bool[Array, "object x y z"],
    occluded: Bool[Array, "object x y z"],
    refiner: Refiner | None,
    config: RefineConfig,
    earlier: Float[Array, "object d"] | None = None,
) -> Reconstruction:
    """Rebuild a batch of objects from their measurement grids F and occlusion masks M.

    `keys` holds one random key per object. `earlier` are codes found when less was measured: the
    search starts from them where they explain the grids better than what the encoder proposes.
    """
    first_code = encode(prior.params, occupied)
    first_logits = decode(prior.params, first_code)
    weights = BALANCED if config.objective == "balanced" else PAPER
    targets = target(occupied, occluded, first_logits, weights)
    first_objective = cross_entropy(first_logits, targets)
    start, start_objective = first_code, first_objective
    if earlier is not None:
        again = cross_entropy(decode(prior.params, earlier), targets)
        start = jnp.where((again < first_objective)[:, None], earlier, first_code)
        start_objective = jnp.minimum(again, first_objective)
    if refiner is None:
        code, logits, objective, found = first_code, first_logits, first_objective, None
    else:
        # A prior adds to the objective, and a bound may move the first code.
        is_first_loss = not config.prior_weight and config.bound is None
        found = refine(
            keys,
            prior.params,
            start,
            targets,
            refiner,
            config.iterations,
            space=search_space(prior, config),
            penalty=unlikeliness(prior, config.prior_weight),
            first_losses=start_objective if is_first_loss else None,
            target_loss=config.target,
            precision=config.precision,
        )
        code, logits = found.code, found.logits
        objective = cross_entropy(logits, targets)
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
        trace=found and found.trace,
        path=found and found.path,
        iterations=found and found.iterations,
        stop=found and found.stop,
    )


@cache
def reconstruct_jit(refiner: Refiner | None, config: RefineConfig) -> Callable[..., Reconstruction]:
    """`reconstruct` with a fixed search, compiled once for each number of objects.

    The same function for the same refiner and settings, so that who asks again need not compile.
    """
    return jax.jit(partial(reconstruct, refiner=refiner, config=config))


def fit_surface(
    prior: ShapePrior, surface: Bool[Array, "object x y z"], *, iterations: int = 150
) -> Bool[Array, "object x y z"]:
    """The shapes of the space nearest to complete surfaces: the ceiling of any reconstruction.

    Codes start where the encoder puts the complete surface and are fitted by Adam, in raw codes, to
    the balanced cross-entropy with all of it.
    """
    config = RefineConfig(iterations=iterations, space="raw", tolerance=0.0)
    nothing = jnp.zeros_like(surface)
    found = refine(
        jax.random.split(jax.random.key(0), len(surface)),  # Adam draws none
        prior.params,
        encode(prior.params, surface),
        target(surface, nothing, jnp.zeros(surface.shape)),
        build_refiner("gradient:adam", len(prior.code_mean), config),
        iterations,
        space=search_space(prior, config),
    )
    return found.logits > 0


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
