"""What is solved: test chairs as measured by four frames, with the weights that are shipped."""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

import jaxshape as js
from jaxshape.data.capture import camera_distance
from jaxshape.geometry.grids import Grids
from jaxshape.model.completion import evidence_of
from jaxshape.model.config import Precision
from jaxshape.model.shapes import ShapePrior
from jaxshape.search.objective import ObjectTerms, evaluation
from jaxshape.search.residuals import Target
from jaxshape.search.run import Refined
from jaxshape.search.space import whitened

PRECISIONS: tuple[Precision, ...] = ("float32", "bfloat16")

FIRST_CHAIR = 1_000_000
"""Seeds from here on are kept for tests: no network has seen these chairs."""


class Problem(NamedTuple):
    """A batch of objects to refine."""

    prior: ShapePrior
    occupied: Bool[Array, "object x y z"]
    occluded: Bool[Array, "object x y z"]
    surface: Bool[Array, "object x y z"]
    code: Float[Array, "object d"]
    target: Target


@lru_cache
def chairs(count: int, frames: int = 4) -> Problem:
    """The first test chairs, after some frames of an orbit."""
    prior = js.load_prior("chair-autoencoder")
    measured, surface = zip(*[_look_at(FIRST_CHAIR + i, frames) for i in range(count)], strict=True)
    measured, surface = jax.tree.map(lambda *x: jnp.stack(x), *measured), jnp.stack(surface)
    F, M = js.occupied(measured), js.occluded(measured)

    @jax.jit
    def start(prior, grids):
        code = js.encode(prior, grids)
        return code, jax.vmap(js.BALANCED.target)(grids, js.decode(prior, code))

    return Problem(prior, F, M, surface, *start(prior, js.Grids(F, M)))


def _look_at(seed: int, frames: int) -> tuple[js.Measurement, Bool[Array, "x y z"]]:
    mesh = js.random_chair(seed)
    seen = js.capture(mesh, js.orbit(frames, camera_distance(mesh)), noise=False, seed=seed)
    return js.merge_all(js.measure_frames(seen)), seen.surface


def tiled(count: int) -> Problem:
    """As many objects, of few different ones: for measuring time and memory."""
    few = chairs(min(count, 4))
    batch = jax.tree.map(lambda x: x[jnp.arange(count) % len(x)], few[1:])
    return Problem(few.prior, *batch)


def nearby_codes(problem: Problem, count: int, seed: int = 0) -> Float[Array, "n d"]:
    """Candidates about the first object's code, as a search would draw them."""
    z = jax.random.normal(jax.random.key(seed), (count, problem.code.shape[-1]))
    return problem.code[0] + 0.1 * z @ jnp.linalg.cholesky(problem.prior.code_covariance).T


def channels_first(grids: Grids) -> Float[np.ndarray, "b 4 x y z"]:
    """The evidence that the conditional network sees, with its channels as PyTorch orders them."""
    return np.moveaxis(np.array(jax.jit(evidence_of)(grids)), -1, 1).copy()


# ------------------------------------------------------------------ our side of the comparisons


def score(
    model: js.ShapeModel, decoder: js.Prepared, codes: Float[Array, "n d"], target: Target
) -> Float[Array, " n"]:
    """Eq. 7 of each candidate of one object, as a search scores them."""
    own = ObjectTerms(decoder.own, target, jnp.float32(0))
    how = evaluation(model, decoder, js.BALANCED, None, codes[0], own)
    return jax.vmap(how.loss, (None, 0, None))(how.shared, codes, own)


def search(
    prior: ShapePrior, iterations: int, population: int = 17
) -> Callable[[Key[Array, " object"], Float[Array, "object d"], Target], Refined]:
    """CMA-ES of objects with `keys, codes, targets`, for a fixed number of iterations."""
    config = js.RefineConfig(iterations=iterations, population=population, tolerance=0)
    refiner, space = js.refiner_for("cma", prior, config), whitened(prior)

    def run(keys, codes, targets):
        return js.refine(keys, prior, codes, targets, refiner, iterations, space=space)

    return run


def keys(count: int) -> Key[Array, " object"]:
    """One random key per object."""
    return jax.random.split(jax.random.key(0), count)


def whitening(prior: ShapePrior) -> Float[np.ndarray, "d d"]:
    """L with code = first code + L u, where u has unit covariance over the training codes."""
    return np.linalg.cholesky(np.asarray(prior.code_covariance, np.float64))
