"""A problem of the benchmark: the objective of one object as a function of a code."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from functools import partial
from numbers import Integral
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxshape import checks
from jaxshape.bench.config import FRAMES, KINDS
from jaxshape.bench.problem_set import ProblemSet, packaged_set
from jaxshape.data.dataset import unpack, unpack_measured
from jaxshape.geometry.grids import Grids
from jaxshape.geometry.overlap import iou
from jaxshape.model.shapes import ShapePrior, decode, encode, pick, share_all
from jaxshape.model.weights import fingerprint, load_prior
from jaxshape.search.curvature import Composed
from jaxshape.search.objective import ObjectTerms, objective_of
from jaxshape.search.residuals import BALANCED, SOFT, Residual, Target, cross_entropy
from jaxshape.search.space import LatentSpace

WEIGHTS = "chair-autoencoder"
"""The packaged weights whose codes are searched."""

RESIDUALS = {"clean": BALANCED, "noisy": SOFT}
"""The default objective of each kind of grids."""

EQUATION_7 = Residual(BALANCED.target, cross_entropy)
"""Residual that scores the targets of both kinds."""


BOX = 10.0
"""Half side of the box of a problem, in standard deviations of the codes; codes found by searches
stay within 7."""


class Problem(NamedTuple):
    """One object after some number of frames, and the search for its code.

    Attributes:
        name: Name of the problem: `object/frames/kind`.
        prior: The shape prior whose codes are searched.
        decoder: The same prior with its parameters prepared in advance; it cannot encode.
        grids: The measurement, F and M `[x y z]`, as probabilities.
        surface: True surface voxels `[x y z]`, which no search may use.
        target: Weights of Eq. 7 for each voxel.
        first_code: The encoder's code `[d]`, where every search starts.
        first_objective: Objective of the first code, in nats per voxel.
        best_objective: The lowest objective known when the set was made.
    """

    name: str
    prior: ShapePrior
    decoder: ShapePrior
    grids: Grids
    surface: Bool[Array | np.ndarray, "x y z"]
    target: Target
    first_code: Float[Array, " d"]
    first_objective: Float[Array, ""]
    best_objective: float

    def objective(self, code: Float[Array, " d"]) -> Float[Array, ""]:
        """The objective of a search (Eq. 7), in nats per voxel.

        A pure function of JAX: differentiate it, and `jax.vmap` it over codes.

        Args:
            code: A code `[d]`.
        """
        return problem_objective(self.decoder, self.target)(code)

    def iou(self, code: Float[Array, " d"]) -> Float[Array, ""]:
        """Overlap of the decoded shape with the true surface, 0 to 1.

        Args:
            code: A code `[d]`.
        """
        return iou(decode(self.decoder, code) > 0, self.surface)

    @property
    def bounds(self) -> tuple[Float[Array, " d"], Float[Array, " d"]]:
        """Lower and upper corner of a box of codes, for searches that need bounds; not enforced."""
        half = BOX * jnp.sqrt(jnp.diag(self.prior.code_covariance))
        return self.prior.code_mean - half, self.prior.code_mean + half


def stacked_targets(problems: Sequence[Problem]) -> Target:
    """The targets of problems `[problem ...]`."""
    return jax.tree.map(lambda *x: jnp.stack(x), *[one.target for one in problems])


def objectives(
    decoder: ShapePrior, targets: Target, space: LatentSpace | None = None
) -> Callable[[Int[Array, ""]], Composed]:
    """The objectives of problems, by index.

    Args:
        decoder: The shape prior, its parameters prepared.
        targets: Targets of the problems `[problem ...]`.
        space: Coordinates of the points that the objectives take; None for codes.
    """
    return lambda number: problem_objective(decoder, pick(targets, number), space)


def problem_objective(
    decoder: ShapePrior, target: Target, space: LatentSpace | None = None
) -> Composed:
    """The objective of one problem, also inside of branches and loops under `jax.vmap`.

    JAX copies what a branch closes over to each element of a batch, which `search.objective` would
    take for several networks. All problems have the same one.

    Args:
        decoder: The shape prior, its parameters prepared.
        target: Target of the problem.
        space: Coordinates of the points that the objective takes; None for codes.
    """
    prepared = decoder.model.prepare(decoder.params, None, "float32")
    own = ObjectTerms(pick(prepared.own, 0), target, jnp.float32(0))
    return objective_of(decoder, prepared, own, EQUATION_7, space=space)


def problems(
    *,
    objects: int | None = None,
    frames: Sequence[int] = FRAMES,
    kinds: Sequence[str] = KINDS,
    problem_set: ProblemSet | None = None,
    prior: ShapePrior | None = None,
) -> list[Problem]:
    """The problems of the benchmark, or some of them. [host]

    Args:
        objects: Number of objects, starting with the first of the set; None for all. Two of three
            are procedural chairs, the third is a CAD seat.
        frames: Numbers of fused frames, among 1, 4 and 8.
        kinds: `clean` for points of the paper's camera without noise, `noisy` for signed distances
            of a Kinect's noisy frames.
        problem_set: Another set of problems; None for the one that comes with the package.
        prior: The shape prior that the set was made for; None for the package's.

    Returns:
        One problem for each object, number of frames and kind.

    Raises:
        ValueError: The set has no such objects, frames or kinds, or it was made for other weights.
    """
    found = packaged_set() if problem_set is None else problem_set
    checks.instance("problem_set", found, ProblemSet, "read_set")
    count = len(found.objects) if objects is None else objects
    is_count = isinstance(count, Integral) and 1 <= count <= len(found.objects)
    if not (is_count and _are_among(frames, FRAMES) and _are_among(kinds, KINDS)):
        raise ValueError(
            f"{found.name} has no matching problem; give objects from 1 to {len(found.objects)},"
            f" a tuple of frames among {', '.join(map(str, FRAMES))} and a tuple of kinds among"
            f" {', '.join(KINDS)}."
        )
    prior = load_prior(WEIGHTS) if prior is None else prior
    if fingerprint(prior) != found.weights:
        raise ValueError(
            f"{found.name} searches the codes of other weights than these; give the shape prior"
            " that it was made for, or leave it out."
        )
    chosen = [
        key
        for key in found.keys()
        if key[1] < count and FRAMES[key[2]] in frames and key[3] in kinds
    ]
    both = prior, _prepared(prior)
    made = {one.name: one for kind in KINDS for one in _of_kind(found, both, kind, chosen)}
    return [made[name] for name, *_ in chosen]


def _are_among(values: Any, choices: Sequence[Any]) -> bool:
    """Whether values are one or more of the choices, in a collection that is no text."""
    is_collection = isinstance(values, Collection) and not isinstance(values, str)
    return is_collection and len(values) > 0 and all(value in choices for value in values)


def _prepared(prior: ShapePrior) -> ShapePrior:
    """A prior with prepared parameters."""
    params = jax.jit(lambda prior: prior.model.prepare(prior.params, None, "float32").shared)(prior)
    return prior._replace(model=replace(prior.model, prepare=share_all), params=params)


def _of_kind(
    found: ProblemSet, priors: tuple[ShapePrior, ShapePrior], kind: str, keys: Sequence
) -> list[Problem]:
    """The problems of one kind among some keys."""
    keys = [key for key in keys if key[3] == kind]
    if not keys:
        return []
    packed = np.stack([found.measured[kind][o, place] for _, o, place, _ in keys])
    grids = Grids(*map(jnp.asarray, unpack_measured(packed)[:2]))
    codes, logits = _first(priors[0], grids)
    targets, losses = jax.device_get(_objectives(grids, logits, RESIDUALS[kind]))
    return [
        Problem(
            name=name,
            prior=priors[0],
            decoder=priors[1],
            grids=jax.tree.map(lambda x, i=i: x[i], grids),
            surface=unpack(found.surfaces[o]),
            target=jax.tree.map(lambda x, i=i: x[i], targets),
            first_code=codes[i],
            first_objective=losses[i],
            best_objective=found.best.get(name, float("nan")),
        )
        for i, (name, o, _, _) in enumerate(keys)
    ]


@jax.jit
def _first(prior, grids):
    """First codes of grids `[b x y z]`, and their decoded shapes."""
    codes = encode(prior, grids)
    return codes, decode(prior, codes)


@partial(jax.jit, static_argnums=2)
def _objectives(grids, logits, residual):
    """Targets of grids `[b x y z]`, and the objectives of their first codes."""
    targets = jax.vmap(residual.target)(grids, logits)
    return targets, jax.vmap(residual.score)(logits, targets)
