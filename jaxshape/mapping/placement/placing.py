"""The object's box, found without hand work: where it stands, how it is turned, how large it is.

The paper (section 4.2) is given the first pose by hand. Here the prior finds it: of many boxes
around the measured points, the object's own is that in which the network explains them best. In a
level world a box has seven numbers: its turn about the vertical and two opposite corners.

    propose    boxes with their fronts all around, that reach more or less far into the unseen
    encoded    the code that the encoder gives for the points in each box
    improve    boxes and codes, moved together down the gradient of their misfit
    place      all of it: the best box, and by how much it is better than one turned otherwise

Boxes are compared by how well points are explained, always the same ones: Eq. 7, a mean over
voxels, would favour boxes with much free space in them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
from jax import lax
from jax.scipy.ndimage import map_coordinates
from jaxtyping import Array, Bool, Float, Int

from jaxshape import checks
from jaxshape.geometry import fusion, grid
from jaxshape.geometry.grid import MARGIN
from jaxshape.geometry.grids import Grids
from jaxshape.mapping.placement.race import race
from jaxshape.mapping.placement.rays import RaySamples
from jaxshape.model.shapes import ShapePrior, decode_prepared, encode, pick
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
        overhangs: Distances by which boxes reach beyond the measured points where they face away
            from the camera, in typical sizes, 0 or more.
        kept: Boxes that are improved, of all those proposed, 1 or more.
        steps: Steps of Adam that improve the two best boxes, 1 or more; the others take a fifth.
        steps_again: Steps of Adam where an earlier placement is known, 1 or more.

    Raises:
        ValueError: A setting is outside its range, or more boxes are kept than proposed.
    """

    typical_size: tuple[float, float, float] = (0.58, 0.86, 0.60)
    size_spread: tuple[float, float, float] = (0.34, 0.21, 0.29)
    yaws: int = 24
    overhangs: tuple[float, ...] = (0.0, 0.2, 0.5)
    kept: int = 8
    steps: int = 60
    steps_again: int = 25

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
            wanted = f"at most the {proposed} boxes that yaws and overhangs propose"
            checks.refuse("kept", self.kept, wanted)


COMPARED_POINTS = 2048
"""Points on the object that shapes are compared with."""

FREE_WEIGHT = 3.0
"""Weight of free points against measured ones: most are far from any surface, and say little."""

OUTSIDE_WEIGHT = 0.1
"""Nats for every voxel by which a measured point lies outside its box, up to four voxels."""

SIZE_WEIGHT, CODE_WEIGHT = 0.003, 2e-4
"""Nats per point for one nat of unlikely sizes, and of an unlikely code: points say the same thing
over and over, so they count far less than independent ones would."""

OUTLIERS = 0.03
"""Share of the points that may be anything: stray depths, a badly cut mask."""

EMPTY = -8.0
"""Logit outside the grid."""

OTHERWISE = jnp.pi / 6
"""Yaws further apart than this, in radians, are different answers."""


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
        margin: Misfit of the best box that is turned otherwise, by over 30 degrees, less that of
            this one, 0 or more. Below 0.01 the front is not to be trusted: the object is as good as
            symmetric, or was seen from a side that does not tell. Infinite where no other box was
            worth improving.
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
            is not known: the bottom then lies where the points end, or below, as far as a side
            that faces away.
        config: Settings of the placement.
    """
    yaw = jnp.arange(config.yaws) * (2 * jnp.pi / config.yaws)
    ordered = jnp.sort(seen.surface @ turn(yaw), axis=1)
    stray = len(seen.surface) // 400
    lower, upper = ordered[:, stray], ordered[:, -1 - stray]
    # Seen at 45 degrees all four sides end within sight, hence the square.
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

    It sums three terms: the measured points, where the shape should be; the free points, where it
    should not be, each a mean over points; and the size of the box. Differentiable in the logits
    and in the box.
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


def _look_up(values: Float[Array, "x y z"], index: Float[Array, "n 3"]) -> Float[Array, " n"]:
    """Values between those of a lattice."""
    return map_coordinates(values, list(index.T), order=1, mode="constant", cval=EMPTY)


def _corners(logits: Float[Array, "x y z"]) -> Float[Array, "x+1 y+1 z+1"]:
    """The largest logit of the voxels around each corner.

    Interpolated between corners, a point has at least the logit of its voxel, wherever in it the
    point lies. Between centres it has to lie in the middle of thin surfaces: that turns the box
    more exactly, but lets it grow until those at its faces do. Hence the mean of both.
    """
    corners = jnp.pad(logits, 1, constant_values=EMPTY)
    for axis in range(3):
        count = corners.shape[axis]
        before = lax.slice_in_dim(corners, 0, count - 1, axis=axis)
        after = lax.slice_in_dim(corners, 1, count, axis=axis)
        corners = jnp.maximum(before, after)
    return corners


def _surprise(logit: Float[Array, " n"]) -> Float[Array, " n"]:
    """Negative log-probability of being true, or an outlier."""
    return -jnp.log(OUTLIERS + (1 - OUTLIERS) * jax.nn.sigmoid(logit))


# ------------------------------------------------------------------------ the search


def place(
    prior: ShapePrior,
    seen: RaySamples,
    floor: Float[Array, ""],
    known: Placement,
    config: PlacementConfig = PlacementConfig(),
) -> Placement:
    """Find the box of an object in a level world, +y up, from what depth frames say of it.

    The paper (section 4.2) is given the first pose by hand; here the box is found in which the
    prior explains the points best.

    Args:
        prior: The shape prior.
        seen: Points on the object and points that rays passed, in the level world; where they are
            not finite the misfit is infinite.
        floor: Height of the floor on which the object stands, in metres; NaN where it is not known.
        known: An earlier placement, which joins the boxes to improve, or `nothing_known(prior)`:
            the same program serves both.
        config: Settings of the placement; the defaults are for chairs.
    """
    # A turn of a box must not sweep it through the world.
    center = jnp.median(seen.surface, axis=0)
    seen = seen._replace(surface=seen.surface - center, free=seen.free - center)
    floor = floor - center[1]
    space, n = whitened(prior), prior.resolution

    def holds(box, points):
        return fusion.count_points(to_voxels(box, points, n), n) > 0

    boxes = propose(seen, floor, config)
    earlier = _standing(_box_of(known, center), floor)
    boxes = jax.tree.map(lambda x, y: jnp.concatenate([x[None], y]), earlier, boxes)
    occupied = jax.vmap(holds, (0, None))(boxes, seen.surface)
    occluded = ~(occupied | jax.vmap(holds, (0, None))(boxes, seen.free))
    grids = Grids(occupied, occluded)
    codes = encode(prior, grids).at[0].set(known.code)
    proposed = Hypothesis(boxes, jax.vmap(space.from_code)(codes))
    decoder = prior.model.prepare(prior.params, grids, "float32")

    def misfits(hypothesis, decoder):
        codes = jax.vmap(space.to_code)(hypothesis.point)
        logits = decode_prepared(prior.model, decoder, codes)
        fit = jax.vmap(partial(misfit, seen=seen, config=config))(logits, hypothesis.box)
        return fit + CODE_WEIGHT * 0.5 * jnp.sum(hypothesis.point**2, axis=-1)

    first = finite_or_inf(misfits(proposed, decoder))
    chosen = _most_promising(first, config)

    def of_chosen(hypothesis, those):
        own = pick(decoder.own, chosen[those])
        return misfits(hypothesis, decoder._replace(own=own))

    width = 0.015 * jnp.array(config.typical_size)
    on_floor = width.at[1].multiply(jnp.isnan(floor))
    unit = Hypothesis(UprightBox(jnp.float32(0.02), on_floor, width), jnp.float32(0.1))
    steps = jnp.where(jnp.isnan(known.misfit), config.steps, config.steps_again)
    improved, after = race(pick(proposed, chosen), of_chosen, unit, steps, _finalists)
    return _best_of(improved, after, center, space.to_code)


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


def _most_promising(misfits: Float[Array, " h"], config: PlacementConfig) -> Int[Array, " k"]:
    """Indices of the boxes to improve: those that no neighbour in yaw outdoes, then the others.

    The first one is the earlier placement, the others come yaw by yaw.
    """
    by_yaw = misfits[1:].reshape(-1, config.yaws)
    neighbours = jnp.minimum(jnp.roll(by_yaw, 1, axis=1), jnp.roll(by_yaw, -1, axis=1))
    outdone = jnp.concatenate([jnp.array([False]), (by_yaw > neighbours).ravel()])
    return jnp.lexsort((misfits, outdone))[: config.kept]


def _finalists(hypotheses: Hypothesis, misfits: Float[Array, " h"]) -> Int[Array, " 2"]:
    """The best box, and the best of those that are turned otherwise, or the next best."""
    best = jnp.argmin(misfits)
    apart = _turned_otherwise(hypotheses.box, best)
    itself = jnp.arange(len(misfits)) == best
    rival = jnp.lexsort((misfits, ~apart, jnp.isinf(misfits), itself))[0]
    return jnp.stack([best, rival])


def _turned_otherwise(boxes: UprightBox, one: Int[Array, ""]) -> Bool[Array, " h"]:
    """True for boxes whose fronts are far from that of one of them."""
    return jnp.cos(boxes.yaw - boxes.yaw[one]) < jnp.cos(OTHERWISE)


def _best_of(
    hypotheses: Hypothesis,
    misfits: Float[Array, " h"],
    center: Float[Array, " 3"],
    to_code: Callable[[Array], Array],
) -> Placement:
    best = jnp.argmin(misfits)
    box, point = jax.tree.map(lambda x: x[best], hypotheses)
    apart = _turned_otherwise(hypotheses.box, best)
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
