"""From measurements to shapes: first code, search, completed and composed grids (paper, Fig. 4)."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from jaxshape import checks
from jaxshape.checks import is_traced
from jaxshape.geometry.grids import Grid, Grids
from jaxshape.model.calibration import UNCALIBRATED
from jaxshape.model.shapes import ShapePrior, decode, encode
from jaxshape.search.composition import complete, known_or
from jaxshape.search.config import RefineConfig, objective_for
from jaxshape.search.devices import over_devices
from jaxshape.search.keys import one_key_each
from jaxshape.search.loop import Callback, require_rows
from jaxshape.search.methods import build_refiner
from jaxshape.search.objective import Penalty
from jaxshape.search.posterior import sample_codes
from jaxshape.search.refiner import Refiner, Trace
from jaxshape.search.residuals import BALANCED, RESIDUALS, Residual, one_loss
from jaxshape.search.run import refine, require_types
from jaxshape.search.space import LatentSpace, raw, whitened


class Reconstruction(NamedTuple):
    """Shapes of a batch of objects, from first code to composed grid.

    Attributes:
        first_code: Code that the model predicts from the measurement `[object d]`.
        code: Code that the search found `[object d]`.
        completed_first: The decoded first code, G(lambda_0) > 0.5 `[object x y z]`.
        logits: Logits of the refined shape `[object x y z]`.
        completed: The refined shape, G(lambda) > 0.5 `[object x y z]`.
        composed: The measurement in measured voxels, the filling elsewhere `[object x y z]`
            (`complete`).
        fill_logits: Logits of the filling `[object x y z]`: the refined shape or, for a symmetric
            object, its average with the mirror image plus the evidence measured on the other side.
        symmetric: Whether the filling is mirrored `[object]`; None without `config.symmetry`.
        agreement: Share of the surface measured on both sides that agrees, 0 to 1 `[object]`; None
            without `config.symmetry`.
        first_objective: Residual of the first code `[object]`, in nats per voxel.
        objective: Residual of the refined code `[object]`, in nats per voxel.
        trace: Trace of the search `[object iteration ...]`; None without a search.
        path: Best code so far after each iteration `[object iteration d]`; None without a search.
        iterations: Iterations that the search took `[object]`; None without a search.
        stop: Why the search ended `[object]`, as a `StopReason`; None without a search.
        samples: Logits of shapes that explain the measurement as well as this one does
            `[object sample x y z]`, filled as `fill_logits`; None without `config.samples`.
        probability: Probability that each voxel is surface `[object x y z]`, from 0 to 1: the
            measurement in measured voxels, elsewhere calibrated with the spread of the samples;
            None without `config.samples`.
    """

    first_code: Float[Array, "object d"]
    code: Float[Array, "object d"]
    completed_first: Bool[Array, "object x y z"]
    logits: Float[Array, "object x y z"]
    completed: Bool[Array, "object x y z"]
    composed: Bool[Array, "object x y z"]
    fill_logits: Float[Array, "object x y z"]
    symmetric: Bool[Array, " object"] | None
    agreement: Float[Array, " object"] | None
    first_objective: Float[Array, " object"]
    objective: Float[Array, " object"]
    trace: Trace | None
    path: Float[Array, "object iteration d"] | None
    iterations: Int[Array, " object"] | None
    stop: Int[Array, " object"] | None
    samples: Float[Array, "object sample x y z"] | None = None
    probability: Float[Array, "object x y z"] | None = None


def refiner_for(method: str, prior: ShapePrior, config: RefineConfig) -> Refiner | None:
    """The search of a method, for the codes of a prior.

    Args:
        method: Name of the search (`build_refiner`), or "encoder" to keep the first code without a
            search.
        prior: The shape prior whose codes are searched.
        config: Settings of the search.

    Returns:
        The refiner; None for "encoder".

    Raises:
        ValueError: There is no such method.
    """
    if method == "encoder":
        return None
    return build_refiner(method, prior.code_size, config)


def usual_method(prior: ShapePrior) -> str:
    """The default search for a prior.

    Args:
        prior: The shape prior.

    Returns:
        "encoder", no search, for a conditional model: its decoder takes the measurement, and codes
        that explained the measurement better did not improve the hidden parts. For others
        "gradient:adam": on the benchmark it reaches lower objectives than CMA-ES in a quarter of
        the decoder calls, and stops by itself (docs/benchmark.md).
    """
    return "encoder" if prior.model.conditional else "gradient:adam"


def search_space(prior: ShapePrior, config: RefineConfig) -> LatentSpace:
    """The coordinates in which codes are searched, which `config.space` names."""
    return {"whitened": whitened, "raw": raw}[config.space](prior, config.bound)


def residual_for(grids: Grids, config: RefineConfig) -> Residual:
    """The residual that the settings name, or else the one that suits F and M."""
    is_soft = jnp.issubdtype(jnp.result_type(grids.occupied), jnp.floating)
    return RESIDUALS[config.objective or objective_for("distance" if is_soft else "points")]


def code_penalty(prior: ShapePrior) -> Penalty:
    """The cost of a code for its distance from the codes of the training set.

    It is half the squared Mahalanobis distance, the negative log-density up to a constant, in nats
    per voxel like the objective: with weight 1 the sum of both is least at the most probable code.

    Args:
        prior: The shape prior.
    """
    space, voxels = whitened(prior), prior.resolution**3
    return lambda code: 0.5 / voxels * jnp.sum(space.from_code(code) ** 2)


def reconstruct(
    keys: Key[Array, "*object"],
    prior: ShapePrior,
    occupied: Grid,
    occluded: Grid,
    refiner: Refiner | None,
    config: RefineConfig,
    *,
    residual: Residual | None = None,
    earlier: Float[Array, "object d"] | None = None,
    data: Any = None,
    callback: Callback | None = None,
    devices: int | None = None,
) -> Reconstruction:
    """Rebuild a batch of objects from their measurement grids F and occlusion masks M.

    Objects are spread over all devices of the process (`jaxshape.search.devices`).

    Args:
        keys: One random key for each object `[object]`, or one for all.
        prior: The shape prior.
        occupied: F of each object `[object x y z]`, binary or soft.
        occluded: M of each object `[object x y z]`, binary or soft.
        refiner: The search (`refiner_for`); None keeps the first code.
        config: Settings of the search.
        residual: The residual to minimise; None for the one that `config.objective` names.
        earlier: Codes found from earlier, less complete measurements `[object d]`; the search
            starts from them if they explain the grids better than the first code does. None starts
            from the first code.
        data: Further arrays that your own model or residual needs for each object, as a pytree
            whose arrays have a leading axis over objects; `residual.target` and `encode` get them
            as `grids.data`.
        callback: `(objects [n], iterations [n], trace [n ...])`, called on the host after each
            iteration of the search (`refine`); None costs nothing.
        devices: Devices of this process to spread objects over, 1 or more; None for all.

    Raises:
        ValueError: An argument is of another type; the grids have no batch axis, differ in shape,
            are not of the prior's resolution, or hold NaN or values outside 0 to 1 (which is
            checked outside `jax.jit` only); or the number of keys is neither 1 nor that of the
            objects.
    """
    grids = Grids(occupied, occluded, data)
    checks.instance("config", config, RefineConfig, "RefineConfig()")
    require_batch(grids)
    require_rows(len(grids.occupied), data=data, earlier=earlier)
    residual = residual_for(grids, config) if residual is None else residual
    require_types(prior, refiner, residual)

    def rebuild(prior, rows):
        keys, grids, earlier = rows
        first_code = encode(prior, grids)
        first_logits = decode(prior, first_code, grids)
        targets = jax.vmap(residual.target)(grids, first_logits)
        score_one = lambda *x: one_loss("score of the residual", residual.score(*x))  # noqa: E731
        score = jax.vmap(score_one)
        first_objective = score(first_logits, targets)
        start, start_objective = first_code, first_objective
        if earlier is not None:
            again = score(decode(prior, earlier, grids), targets)
            start = jnp.where((again < first_objective)[:, None], earlier, first_code)
            start_objective = jnp.minimum(again, first_objective)
        if refiner is None:
            code, logits, objective, found = first_code, first_logits, first_objective, None
        else:
            # A prior adds to the objective, and a bound may move the first code.
            has_prior = is_traced(config.prior_weight) or config.prior_weight > 0
            found = refine(
                keys,
                prior,
                start,
                targets,
                refiner,
                config.iterations,
                residual=residual,
                grids=grids,
                space=search_space(prior, config),
                penalty=code_penalty(prior) if has_prior else None,
                penalty_weight=config.prior_weight if has_prior else 1.0,
                first_losses=None if has_prior or config.bound is not None else start_objective,
                target_loss=config.target,
                callback=callback,
                devices=devices,
                precision=config.precision,
            )
            code, logits, objective = found.code, found.logits, score(found.logits, targets)
        filled = complete(
            grids,
            logits,
            symmetry=config.symmetry,
            conditional=prior.model.conditional,
            calibration=prior.calibration,
        )
        shape = Reconstruction(
            first_code=first_code,
            code=code,
            completed_first=first_logits > 0,
            logits=logits,
            completed=logits > 0,
            composed=filled.composed,
            fill_logits=filled.logits,
            symmetric=filled.symmetric,
            agreement=filled.agreement,
            first_objective=first_objective,
            objective=objective,
            trace=found and found.trace,
            path=found and found.path,
            iterations=found and found.iterations,
            stop=found and found.stop,
        )
        return sampled(keys, prior, grids, shape, config, residual) if config.samples else shape

    rows = one_key_each(keys, len(grids.occupied)), grids, earlier
    return over_devices(rebuild, prior, rows, devices)


def sampled(
    keys: Key[Array, " object"],
    prior: ShapePrior,
    grids: Grids,
    found: Reconstruction,
    config: RefineConfig,
    residual: Residual,
) -> Reconstruction:
    """Add samples of the posterior and the probability of each voxel to a reconstruction.

    Args:
        keys: One random key for each object `[object]`.
        prior: The shape prior.
        grids: F and M of the objects `[object x y z]`.
        found: Their reconstruction without samples.
        config: Settings; `samples` is 1 or more.
        residual: The residual that scores codes.
    """
    fill = partial(complete, symmetry=config.symmetry, conditional=prior.model.conditional)
    target = None
    if not prior.model.conditional:
        target = jax.vmap(residual.target)(grids, decode(prior, found.first_code, grids))
    codes = sample_codes(
        keys, prior, grids, found.code, config.samples, residual=residual, target=target
    )
    decoded = decode(prior, codes, grids)
    each = [jnp.broadcast_to(x[:, None], decoded.shape) for x in grids[:2]]
    samples = fill(Grids(*each), decoded).logits
    calibration = prior.calibration or UNCALIBRATED
    hidden = calibration.probability(found.fill_logits, jnp.std(samples, axis=1))
    return found._replace(samples=samples, probability=known_or(grids, hidden))


@cache
def reconstruct_jit(
    refiner: Refiner | None, config: RefineConfig, residual: Residual | None = None
) -> Callable[..., Reconstruction]:
    """`reconstruct` with a fixed search, compiled once for each number of objects.

    Equal refiners, settings and residuals give the same function, which is compiled only once. A
    separate program draws the samples, so the program of the search does not depend on them.

    Args:
        refiner: The search; None keeps the first code.
        config: Settings of the search.
        residual: The residual to minimise; None for the one that `config.objective` names.
    """
    if not config.samples:
        return jax.jit(partial(reconstruct, refiner=refiner, config=config, residual=residual))
    search = reconstruct_jit(refiner, replace(config, samples=0), residual)

    @jax.jit
    def draw(keys, prior, grids, found):
        def rows(prior, rows):
            keys, grids, found = rows
            wanted = residual_for(grids, config) if residual is None else residual
            return sampled(keys, prior, grids, found, config, wanted)

        return over_devices(rows, prior, (one_key_each(keys, len(found.code)), grids, found))

    def run(keys, prior, occupied, occluded, *, data=None, **more):
        found = search(keys, prior, occupied, occluded, data=data, **more)
        return draw(keys, prior, Grids(jnp.asarray(occupied), jnp.asarray(occluded), data), found)

    return run


def fit_surface(
    prior: ShapePrior, surface: Bool[Array, "object x y z"], *, iterations: int = 150
) -> Bool[Array, "object x y z"]:
    """The decoded shapes nearest to complete surfaces: the best that any reconstruction can reach.

    Codes start at the encoding of the complete surface. Adam then fits them, in the raw space, by
    the balanced cross-entropy with the complete surface.

    Args:
        prior: The shape prior.
        surface: Surface voxels of each object `[object x y z]`.
        iterations: Steps of Adam, 1 or more.

    Returns:
        The fitted shapes `[object x y z]`, True where occupied.

    Raises:
        ValueError: The grids have no batch axis or are not of the prior's resolution.
    """
    config = RefineConfig(iterations=iterations, space="raw", tolerance=0.0)
    require_batch(Grids(surface, surface))

    def fit(prior, surface):
        grids = Grids(surface, jnp.zeros_like(surface))
        found = refine(
            jax.random.key(0),  # Adam uses no random numbers
            prior,
            encode(prior, grids),
            jax.vmap(BALANCED.target)(grids, jnp.zeros(surface.shape)),
            build_refiner("gradient:adam", prior.code_size, config),
            iterations,
            grids=grids,
            space=search_space(prior, config),
        )
        return found.logits > 0

    return over_devices(fit, prior, surface)


def require_batch(grids: Grids) -> None:
    """Raise `ValueError` unless F and M are batches of probabilities of the same shape."""
    shapes = jnp.shape(grids.occupied), jnp.shape(grids.occluded)
    if len(shapes[0]) != 4 or shapes[0] != shapes[1]:
        raise ValueError(
            f"occupied has shape {shapes[0]} and occluded {shapes[1]}; give both as "
            "[object, x, y, z], with an axis over objects: occupied[None] for a single one."
        )
    require_rows(shapes[0][0])
    for name, grid in zip(("occupied", "occluded"), grids[:2], strict=True):
        if not is_traced(grid) and not _are_probabilities(grid):
            raise ValueError(
                f"{name} holds NaN or values outside 0 to 1; give booleans, or probabilities."
            )


def _are_probabilities(grid: Array | np.ndarray) -> bool:
    """Whether all values are from 0 to 1, up to rounding; also where a trace closes over them."""
    with jax.ensure_compile_time_eval():
        return bool(jnp.all(abs(jnp.asarray(grid, jnp.float32) - 0.5) < 0.501))


def all_measured(occupied: Bool[Array | np.ndarray, "*batch x y z"]) -> bool:
    """Whether every grid has an occupied voxel, so that there is something to rebuild from."""
    return bool(np.asarray(occupied).any(axis=(-3, -2, -1)).all())


def require_measured(occupied: Bool[Array | np.ndarray, "*batch x y z"]) -> None:
    """Raise `ValueError` when a grid has no occupied voxel: there is nothing to rebuild from."""
    if not all_measured(occupied):
        raise ValueError(
            "Nothing was measured inside the object's box: no segmented depth pixel falls into it. "
            "Check the box, the masks, the depth scale and which way the poses go."
        )
