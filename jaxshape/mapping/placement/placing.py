"""The object's box, found without hand work: its position, its turn and its size.

In the paper (section 4.2) the first pose is given by hand. Here the prior finds it: among many
boxes around the measured points, it takes the box in which the network explains the points best. In
a level world a box has seven numbers: its turn about the vertical and two opposite corners.

    propose     boxes with fronts in all directions, which reach more or less far into unseen space
    encode      the shape that the network makes of the points in each box
    fit         the best boxes, moved down the gradient of their misfit while the shapes are held
    encode, fit once more, in the boxes that were found
    improve     the best few, boxes and codes together
    place       the whole search: the best box, and its margin over boxes with other fronts

Moving a box alone costs a tenth of moving it together with its code. A code that is encoded anew
also follows the box further than the gradient of the code does.

Boxes are compared by how well they explain one fixed set of points: Eq. 7, a mean over voxels,
would favour boxes that contain much free space.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
from jax import lax
from jaxtyping import Array, Float, Int, PyTree

from jaxshape import checks
from jaxshape.geometry import fusion, grid
from jaxshape.geometry.grid import MARGIN
from jaxshape.geometry.grids import Grids
from jaxshape.mapping.placement.descent import descend
from jaxshape.mapping.placement.rays import RaySamples
from jaxshape.model.shapes import ShapePrior, decode_prepared, encode, pick
from jaxshape.search.batching import select
from jaxshape.search.refiner import finite_or_inf
from jaxshape.search.space import whitened


@dataclass(frozen=True)
class PlacementConfig:
    """Settings of the search for the object's box; the defaults are for chairs.

    Attributes:
        typical_size: Usual extents of the object along x, y and z, in metres, above 0: the
            geometric means of the procedural chairs.
        size_spread: Standard deviations of the logarithms of the extents, above 0.
        yaws: Directions of the front to start from, evenly spaced, 1 or more.
        overhangs: Distances by which boxes reach beyond the measured points on the sides that face
            away from the camera, in typical sizes, 0 or more.
        kept: Number of boxes that are improved together with their codes, 1 or more.
        steps: Steps of Adam that improve each box and its code, 1 or more.
        steps_again: Steps of Adam where an earlier placement is known, 1 or more.

    Raises:
        ValueError: A setting is outside its range, or more boxes are kept than proposed.
    """

    typical_size: tuple[float, float, float] = (0.58, 0.86, 0.60)
    size_spread: tuple[float, float, float] = (0.34, 0.21, 0.29)
    yaws: int = 24
    overhangs: tuple[float, ...] = (0.0, 0.2, 0.5)
    kept: int = 4
    steps: int = 30
    steps_again: int = 12

    def __post_init__(self) -> None:
        for name in ("typical_size", "size_spread"):
            for extent in getattr(self, name):
                checks.positive(name, extent)
        checks.whole("yaws", self.yaws, 1)
        for overhang in self.overhangs:
            checks.at_least("overhangs", overhang, 0)
        for name in ("kept", "steps", "steps_again"):
            checks.whole(name, getattr(self, name), 1)
        proposed = 1 + self.yaws * len(self.overhangs)
        if self.kept > proposed:
            checks.refuse("kept", self.kept, f"at most the {proposed} boxes that are proposed")


COMPARED_POINTS = 2048
"""Points on the object that shapes are compared with."""

FREE_WEIGHT = 2.0
"""Weight of free points against measured ones: most are not next to a surface, and say little."""

OUTSIDE_WEIGHT = 0.1
"""Nats for every voxel by which a measured point lies outside its box, up to four voxels."""

SIZE_WEIGHT, CODE_WEIGHT = 0.003, 2e-4
"""Weights of the size penalty and of the code penalty, in nats per point for one nat: the points
are strongly correlated, so they count far less than independent ones would."""

OUTLIERS = 0.03
"""Share of the points that may be outliers, from stray depths or a badly cut mask."""

EMPTY = -8.0
"""Logit outside the grid."""

OTHERWISE, APART = jnp.pi / 6, jnp.pi / 18
"""Differences of yaw, in radians, above which two boxes are different answers, and above which they
are improved separately."""

FIT_STEPS = 15
"""Number of steps of Adam that fit a box while its shape is held."""


class UprightBox(NamedTuple):
    """An upright box: its corners in a frame that is turned about +y.

    Attributes:
        yaw: Turn of the frame about +y, in radians.
        lower: Corner with the smallest coordinates in the turned frame, in metres.
        upper: Corner with the largest coordinates in the turned frame, in metres.
    """

    yaw: Float[Array, "*batch"]
    lower: Float[Array, "*batch 3"]
    upper: Float[Array, "*batch 3"]


class Hypothesis(NamedTuple):
    """A box and the shape in it.

    Attributes:
        box: The upright box.
        point: Code of the shape, as a point of the whitened space.
    """

    box: UprightBox
    point: Float[Array, "*batch d"]


class Placement(NamedTuple):
    """The object's frame, box and first shape.

    Attributes:
        T_world_object: Pose of the object frame: origin at the centre of the box, +y up, front
            along +z.
        size: Extents of the box along the axes of the object `[3]`, in metres.
        code: Code of the shape that explains the points `[d]`.
        misfit: Negative log-likelihood of the points, in nats per point; infinite where nothing
            could be placed.
        margin: Misfit of the best box with another front, turned by over 30 degrees, minus the
            misfit of this box, 0 or more. Below 0.01 the front is not to be trusted: the object is
            nearly symmetric, or was seen from a side that does not show its front. Infinite where
            no other box was worth improving.
    """

    T_world_object: jaxlie.SE3
    size: Float[Array, " 3"]
    code: Float[Array, " d"]
    misfit: Float[Array, ""]
    margin: Float[Array, ""]


# ------------------------------------------------------------------------ boxes


def propose(seen: RaySamples, floor: Float[Array, ""], config: PlacementConfig) -> UprightBox:
    """Boxes around the measured points: `overhangs * yaws` of them, yaw by yaw.

    A side that faces the camera lies where the points end; one that faces away may lie beyond.

    Args:
        seen: Points on the object, and points that rays passed.
        floor: Height of the floor, on which the bottom of the boxes lies, in metres; NaN where it
            is not known: the bottom then lies at the lowest points, or as far below them as a side
            that faces away lies beyond the points.
        config: Settings of the placement.
    """
    yaw = jnp.arange(config.yaws) * (2 * jnp.pi / config.yaws)
    ordered = jnp.sort(seen.surface @ turn(yaw), axis=1)
    stray = len(seen.surface) // 400
    lower, upper = ordered[:, stray], ordered[:, -1 - stray]
    # At 45 degrees the camera sees the ends of all four sides, hence the square.
    away = jnp.array([1.0, 0.0, 1.0]) * (seen.away @ turn(yaw))
    away = away.at[:, 1].set(jnp.where(jnp.isnan(floor), -1.0, 0.0))  # legs out of sight
    typical = jnp.mean(jnp.array(config.typical_size)[::2])
    overhang = typical * jnp.array(config.overhangs)[:, None, None]
    lower = lower - overhang * jnp.minimum(away, 0) ** 2
    upper = upper + overhang * jnp.maximum(away, 0) ** 2
    boxes = UprightBox(jnp.broadcast_to(yaw, lower.shape[:2]), lower, upper)
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), _standing(boxes, floor))


def _standing(box: UprightBox, floor: Float[Array, ""]) -> UprightBox:
    """The box with its bottom on the floor, where that is known."""
    bottom = jnp.where(jnp.isnan(floor), box.lower[..., 1], floor)
    return box._replace(lower=box.lower.at[..., 1].set(bottom))


def turn(yaw: Float[Array, "*batch"]) -> Float[Array, "*batch 3 3"]:
    """The rotation about +y that takes +z to (sin yaw, 0, cos yaw)."""
    return jaxlie.SO3.from_y_radians(yaw).as_matrix()


def to_voxels(box: UprightBox, points: Float[Array, "n 3"], resolution: int) -> Float[Array, "n 3"]:
    """Take points to the voxel coordinates of the grid that a box fills."""
    frame = grid.fit_box(box.lower, box.upper, resolution=resolution)
    return grid.voxel_from_object(frame, points @ turn(box.yaw))


# ------------------------------------------------------------------------ how well they explain


def misfit(
    logits: Float[Array, "x y z"], box: UprightBox, seen: RaySamples, config: PlacementConfig
) -> Float[Array, ""]:
    """Negative log-likelihood of the points given a shape in a box, in nats per point.

    It sums four terms: the measured points, where the shape should be; the free points, where it
    should not be; the measured points outside of the box; and the size of the box. The first three
    are means over points. Differentiable in the logits and in the box.
    """
    n = logits.shape[-1]
    surface, free = to_voxels(box, seen.surface[:COMPARED_POINTS], n), to_voxels(box, seen.free, n)
    outside = jnp.abs(surface - jnp.clip(surface, MARGIN, n - MARGIN)).sum(axis=-1)
    unusual = jnp.log((box.upper - box.lower) / jnp.array(config.typical_size))
    anywhere, amid = _look_up(_corners(logits), surface), _look_up(logits, surface - 0.5)
    return (
        jnp.mean(_surprise((anywhere + amid) / 2))
        + FREE_WEIGHT * jnp.mean(_surprise(-_look_up(logits, free - 0.5)))
        + OUTSIDE_WEIGHT * jnp.mean(jnp.minimum(outside, 4.0))
        + SIZE_WEIGHT * 0.5 * jnp.sum((unusual / jnp.array(config.size_spread)) ** 2)
    )


@jax.custom_vjp
def _look_up(values: Float[Array, "x y z"], index: Float[Array, "n 3"]) -> Float[Array, " n"]:
    """Values of a lattice, interpolated linearly between its nodes; `EMPTY` outside of it.

    Value and slope come from one gather of the eight nodes around each point: on CPUs three times
    as fast as the derivatives of `map_coordinates`.
    """
    return _value_and_slope(values, index)[0]


def _value_and_slope(values, index):
    place = jnp.clip(index + 1, 0, len(values) + 1)  # in the lattice with a margin of one node
    first = jnp.clip(jnp.int32(place), 0, len(values))

    def around(values):
        padded = jnp.pad(values, 1, constant_values=EMPTY)
        return jax.vmap(lambda node: lax.dynamic_slice(padded, node, (2, 2, 2)))(first)

    nodes, spread = jax.vjp(around, values)
    shares, slopes, value = tuple((place - first).T), [], nodes
    for axis, share in enumerate(shares):
        slopes.append(_mixed(value[:, 1] - value[:, 0], shares[axis + 1 :]))
        value = _mixed(value, (share,))
    slope = jnp.where(place == index + 1, jnp.stack(slopes, axis=-1), 0)
    return value, (slope, shares, spread)


def _mixed(nodes: Array, shares: tuple[Array, ...]) -> Array:
    """Interpolate between the two nodes along each axis in turn."""
    for share in shares:
        share = share.reshape(-1, *[1] * (nodes.ndim - 2))
        nodes = nodes[:, 0] + share * (nodes[:, 1] - nodes[:, 0])
    return nodes


def _pull_back(saved, gradient):
    slope, shares, spread = saved
    x, y, z = (jnp.stack([1 - share, share], axis=-1) for share in shares)
    each = x[:, :, None, None] * y[:, None, :, None] * z[:, None, None, :]
    return *spread(gradient[:, None, None, None] * each), gradient[:, None] * slope


_look_up.defvjp(_value_and_slope, _pull_back)


def _corners(logits: Float[Array, "x y z"]) -> Float[Array, "x+1 y+1 z+1"]:
    """The largest logit of the voxels around each corner.

    With interpolation between corners, a point gets at least the logit of its voxel, wherever it
    lies in the voxel. With interpolation between centres, a point must lie in the middle of a thin
    surface: this turns the box more exactly, but lets it grow until the points at its faces lie in
    the middle of a surface, too. Hence the misfit uses the mean of both.
    """
    corners = jnp.pad(logits, 1, constant_values=EMPTY)
    for axis in range(3):
        count = corners.shape[axis]
        before = lax.slice_in_dim(corners, 0, count - 1, axis=axis)
        after = lax.slice_in_dim(corners, 1, count, axis=axis)
        corners = jnp.maximum(before, after)
    return corners


def _surprise(logit: Float[Array, " n"]) -> Float[Array, " n"]:
    """Negative log-probability that a point fits its logit or is an outlier."""
    return -jnp.log(OUTLIERS + (1 - OUTLIERS) * jax.nn.sigmoid(logit))


# ------------------------------------------------------------------------ the search


def place(
    prior: ShapePrior,
    seen: RaySamples,
    floor: Float[Array, ""],
    known: Placement,
    config: PlacementConfig = PlacementConfig(),
) -> Placement:
    """Find the box of an object in a level world, +y up, from points of depth frames.

    In the paper (section 4.2) the first pose is given by hand; here the search finds the box in
    which the prior explains the points best.

    Args:
        prior: The shape prior.
        seen: Points on the object and points that rays passed, in the level world; where they are
            not finite the misfit is infinite.
        floor: Height of the floor on which the object stands, in metres; NaN where it is not known.
        known: An earlier placement, which joins the boxes to improve, or `nothing_known(prior)`:
            the same program serves both.
        config: Settings of the placement; the defaults are for chairs.
    """
    # Boxes are relative to the object's centre, so that a turn does not move them far.
    center = jnp.median(seen.surface, axis=0)
    seen = seen._replace(surface=seen.surface - center, free=seen.free - center)
    floor = floor - center[1]
    space, n = whitened(prior), prior.resolution
    width = 0.015 * jnp.array(config.typical_size)
    unit = UprightBox(jnp.float32(0.02), width.at[1].multiply(jnp.isnan(floor)), width)
    fits = jax.vmap(partial(misfit, seen=seen, config=config))

    def holds(box, points):
        return fusion.count_points(to_voxels(box, points, n), n) > 0

    @jax.jit  # traced once for all calls
    def judged(boxes, codes):
        """Boxes with their shapes: of the codes, or of what the network makes of the points."""
        occupied = jax.vmap(holds, (0, None))(boxes, seen.surface)
        occluded = ~(occupied | jax.vmap(holds, (0, None))(boxes, seen.free))
        grids = Grids(occupied, occluded)
        codes = jnp.where(jnp.isnan(codes), encode(prior, grids), codes)
        decoder = prior.model.prepare(prior.params, grids, "float32")
        logits = decode_prepared(prior.model, decoder, codes)
        hypotheses = Hypothesis(boxes, jax.vmap(space.from_code)(codes))
        total = finite_or_inf(fits(logits, boxes) + _code_penalty(hypotheses.point))
        return _Candidate(hypotheses, decoder.own, logits, total)

    @jax.jit
    def fitted(candidates):
        held = lambda boxes: fits(candidates.logits, boxes)  # noqa: E731
        boxes, fit = descend(candidates.hypothesis.box, held, _longer(unit), FIT_STEPS, rise=3)
        hypothesis = candidates.hypothesis._replace(box=boxes)
        total = fit + _code_penalty(hypothesis.point)
        return candidates._replace(hypothesis=hypothesis, misfit=total)

    # Boxes are judged in rounds of all fronts, the smallest boxes first. Where an earlier box is
    # known, one round is enough to find a better front.
    earlier = _standing(_box_of(known, center), floor)
    boxes = jax.tree.map(
        lambda x, y: jnp.concatenate([x[None], y]), earlier, propose(seen, floor, config)
    )
    each, is_known = max(1 + config.yaws, config.kept), jnp.isfinite(known.misfit)
    unknown = jnp.full((each, prior.code_size), jnp.nan)

    def one_round(i, best):
        index = (i * each + jnp.arange(each)) % len(boxes.yaw)
        codes = jnp.where((index == 0)[:, None], known.code, unknown)
        more = judged(pick(boxes, index), codes)
        both = jax.tree.map(lambda *x: jnp.concatenate(x), best, more)
        return pick(both, jnp.argsort(both.misfit)[:each])

    shapes = jax.eval_shape(judged, pick(boxes, jnp.arange(each)), unknown)
    none = jax.tree.map(jnp.zeros_like, shapes)._replace(misfit=jnp.full(each, jnp.inf))
    rounds = jnp.where(is_known, 1, -(-len(boxes.yaw) // each))
    tried = fitted(lax.fori_loop(0, rounds, one_round, none))
    again = judged(tried.hypothesis.box, unknown)
    tried = fitted(jax.vmap(select)(again.misfit < tried.misfit, again, tried))

    best = pick(tried, _most_promising(tried, config.kept))
    decoder = prior.model.prepare(prior.params, None, "float32")._replace(own=best.own)

    def misfits(hypothesis):
        logits = decode_prepared(prior.model, decoder, jax.vmap(space.to_code)(hypothesis.point))
        return fits(logits, hypothesis.box) + _code_penalty(hypothesis.point)

    steps = jnp.where(is_known, config.steps_again, config.steps)
    whole = Hypothesis(unit, jnp.float32(0.1))
    improved, lowest = descend(best.hypothesis, misfits, whole, steps, rise=8)
    return _best_of(improved, lowest, center, space.to_code)


class _Candidate(NamedTuple):
    """A hypothesis with its shape and misfit.

    Attributes:
        hypothesis: The box and the code.
        own: Features of the measurement in the box, for a decoder that uses them.
        logits: The shape in the box.
        misfit: Misfit of the hypothesis, infinite where it is not finite.
    """

    hypothesis: Hypothesis
    own: PyTree
    logits: Float[Array, "*batch x y z"]
    misfit: Float[Array, "*batch"]


def _code_penalty(point: Float[Array, "*batch d"]) -> Float[Array, "*batch"]:
    """The part of the misfit that depends on the code alone, a point of the whitened space."""
    return CODE_WEIGHT * 0.5 * jnp.sum(point**2, axis=-1)


def _longer(unit: UprightBox) -> UprightBox:
    """Longer unit steps for moving boxes alone, because that takes only a few steps."""
    return jax.tree.map(lambda x: 1.5 * x, unit)


def nothing_known(prior: ShapePrior) -> Placement:
    """The value that stands for an earlier placement where there is none."""
    unknown = jaxlie.SE3.identity()
    nan = jnp.float32(jnp.nan)
    return Placement(unknown, jnp.full(3, nan), jnp.full_like(prior.code_mean, nan), nan, nan)


def _box_of(known: Placement, center: Float[Array, " 3"]) -> UprightBox:
    front = known.T_world_object.rotation() @ jnp.array([0.0, 0.0, 1.0])
    yaw = jnp.arctan2(front[0], front[2])
    middle = (known.T_world_object.translation() - center) @ turn(yaw)
    return UprightBox(yaw, middle - known.size / 2, middle + known.size / 2)


def _most_promising(tried: _Candidate, count: int) -> Int[Array, " k"]:
    """Indices of the best boxes, with different fronts as long as there are enough fronts."""
    yaw, misfits = tried.hypothesis.box.yaw, tried.misfit

    def add(i, carry):
        chosen, is_left, is_new = carry
        best = jnp.lexsort((misfits, ~is_new, ~is_left))[0]
        is_new &= jnp.cos(yaw - yaw[best]) < jnp.cos(APART)
        return chosen.at[i].set(best), is_left.at[best].set(False), is_new

    everything = jnp.ones(len(yaw), bool)
    return lax.fori_loop(0, count, add, (jnp.zeros(count, int), everything, everything))[0]


def _best_of(
    hypotheses: Hypothesis,
    misfits: Float[Array, " h"],
    center: Float[Array, " 3"],
    to_code: Callable[[Array], Array],
) -> Placement:
    best = jnp.argmin(misfits)
    box, point = jax.tree.map(lambda x: x[best], hypotheses)
    apart = jnp.cos(hypotheses.box.yaw - box.yaw) < jnp.cos(OTHERWISE)
    other = jnp.min(misfits, where=apart, initial=jnp.inf)
    R_world_object = jaxlie.SO3.from_y_radians(box.yaw)
    middle = R_world_object @ ((box.lower + box.upper) / 2) + center
    return Placement(
        jaxlie.SE3.from_rotation_and_translation(R_world_object, middle),
        size=box.upper - box.lower,
        code=to_code(point),
        misfit=misfits[best],
        margin=other - misfits[best],
    )
