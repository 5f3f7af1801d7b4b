"""The classes that objects of a scene may be of, and how one is decided. [host]

Each class has a prior. An object belongs to the class whose prior predicts hidden parts of it
clearly better as the object stands than in a wrong stance: with its front turned away or, where
objects of the class have no front, upside down. The prior of chairs predicts a plant equally badly
from all sides, a cube equally well from all sides, and a chair well only with the right front. The
prior of tables predicts a cube equally well either way up, and a table well only on its legs.
Likelihoods of different priors are not compared: a network that is better trained, or more
confident, would win every object.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxshape.geometry.grids import Grids, binary
from jaxshape.mapping.config import MappingConfig, TrackingConfig
from jaxshape.mapping.map.mapper import Mapper, build_mapper
from jaxshape.mapping.map.state import power_of_two
from jaxshape.mapping.placement.placing import PlacementConfig
from jaxshape.mapping.scene.evidence import TOPPLED, TURNS, UPRIGHT, Stance, predict_hidden
from jaxshape.model.shapes import ShapePrior
from jaxshape.search.config import RefineConfig
from jaxshape.search.reconstruction import Reconstruction, refiner_for, usual_method

NOTHING = -20.0
"""Logit of all voxels of a shape that no prior predicts."""


class SceneClass(NamedTuple):
    """A class of objects.

    Attributes:
        name: Its name, such as "chair".
        prior: The prior that decides the class, and rebuilds its objects.
        placer: The prior that finds boxes of its objects.
        mapper: Tracking and mapping with that prior.
        sizes: Usual sizes of its objects, and the length of the search for boxes.
    """

    name: str
    prior: ShapePrior
    placer: ShapePrior
    mapper: Mapper
    sizes: PlacementConfig


class SceneClasses(NamedTuple):
    """All classes of a scene.

    Attributes:
        known: The classes, in the order in which they go through the decoder.
        unknown: Mapper for objects whose class is not decided, or that are of no class: it searches
            no shapes.
    """

    known: tuple[SceneClass, ...]
    unknown: Mapper

    def named(self, name: str | None) -> SceneClass | None:
        """The class of a name.

        Args:
            name: The name; None for no class.
        """
        return next((one for one in self.known if one.name == name), None)


class Decision(NamedTuple):
    """The class and the front of an object.

    Attributes:
        name: Name of its class; None for none of them.
        quarters: Quarters of a turn by which its front is turned from that of its box.
        sure: Probability of the answer, from 0 to 1.
        scores: Evidence for each class, in nats per hidden surface voxel: the margin of the
            likelihood under its prior over that in a wrong stance. An object with the size of no
            class has none, and a class without a front has none where the size or the likelihood
            alone excludes it.
    """

    name: str | None
    quarters: int
    sure: float
    scores: dict[str, float]


_CHAIRS = PlacementConfig()

SIZES: dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "chair": (_CHAIRS.typical_size, _CHAIRS.size_spread),
    "table": ((1.05, 0.68, 0.72), (0.50, 0.25, 0.42)),
}
"""Geometric means of the extents of procedural objects along x, y and z, in metres, and the
standard deviations of their logarithms."""


_SEARCH, _MAPPING, _TRACKING = RefineConfig(), MappingConfig(), TrackingConfig()


FRONTLESS = ("table",)
"""Classes whose objects look alike from all sides."""


def sizes_of(name: str) -> PlacementConfig:
    """Usual sizes of a class, for a short search that starts from a known box.

    Args:
        name: Name of the class; objects of a class with unknown sizes may have any size.
    """
    typical, spread = SIZES.get(name, ((0.6, 0.6, 0.6), (0.7, 0.7, 0.7)))
    return PlacementConfig(
        typical, spread, yaws=12, overhangs=(0.0, 0.3), kept=3, steps=30, steps_again=12
    )


def build_classes(
    priors: Mapping[str, ShapePrior],
    *,
    placers: Mapping[str, ShapePrior] | None = None,
    method: str | None = None,
    search: RefineConfig = _SEARCH,
    mapping: MappingConfig = _MAPPING,
    track: TrackingConfig = _TRACKING,
    seed: int = 0,
) -> SceneClasses:
    """The classes of a scene, one for each prior. [host]

    Args:
        priors: The prior of each class, by the name of the class; one or more.
        placers: Priors that find boxes, by the name of the class; None, and classes that are not
            named, use the priors themselves.
        method: How codes are searched (`refiner_for`); None for the usual way of each prior.
        search: Settings of the search.
        mapping: When a frame becomes a keyframe, and how keyframes are fused.
        track: How the pose of a frame is found, and when it is believed.
        seed: Seed of the random numbers of the search, 0 or more.

    Raises:
        ValueError: There is no prior, or their grids differ in resolution.
    """
    if not priors:
        raise ValueError("There are no priors; give one for each class: {'chair': load_prior()}.")
    sides = {name: prior.resolution for name, prior in priors.items()}
    if len(set(sides.values())) > 1:
        raise ValueError(f"The priors have grids of different sides, {sides}; give them one side.")
    known = []
    for name, prior in priors.items():
        refiner = refiner_for(method or usual_method(prior), prior, search)
        mapper = build_mapper(prior, refiner, search, mapping, track, seed=seed)
        placer = (placers or {}).get(name, prior)
        known.append(SceneClass(name, prior, placer, mapper, sizes_of(name)))
    first = next(iter(priors.values()))
    unknown = build_mapper(first, None, search, mapping, track, seed=seed, is_searched=False)
    return SceneClasses(tuple(known), unknown)


# Decisions -------------------------------------------------------------------------------------


class Standard(NamedTuple):
    """The evidence that an object needs to be of a class, in nats per hidden surface voxel.

    Attributes:
        margin: Least margin.
        spread: Width over which the answer goes from unlikely to likely.
        likelihood: Least log-likelihood.
    """

    margin: float
    spread: float
    likelihood: float


WITH_FRONT, WITHOUT_FRONT = Standard(0.14, 0.025, -1.4), Standard(0.065, 0.01, -1.25)
"""Evidence over other fronts, and over the object upside down. It was chosen on procedural chairs
and tables, boxes, plants, lamps, bins and balls. The median margin of chairs over other fronts is
0.31, that of tables over tables upside down 0.18. Of 48 objects of neither class, none reaches the
first margin, and only a box and a few plants the second; most of these plants are too unlikely."""

OPPOSITE = 0.5
"""Weight of the margin over the opposite front: backs differ from fronts more than sides do."""


UNUSUAL = 14.0
"""Largest sum of squared deviations of an object's three extents from the usual extents of a class
for the object to be of that class. Each deviation is in standard deviations of the extent's
logarithm; 0.3 % of the objects of a class have a larger sum."""


EXCLUDED = 0.1
"""Largest probability of a class that the size or the likelihood of an object excludes."""


def decide(
    priors: Mapping[str, ShapePrior],
    grids: Grids,
    sizes: Float[np.ndarray, "object 3"] | None = None,
) -> list[Decision]:
    """The class and the front of each object; all objects go through one call for each class.

    Args:
        priors: The prior of each class, by its name; one or more.
        grids: F and M of each object `[object x y z]`, in boxes with any front.
        sizes: Extents of these boxes, in metres; None where objects of any size may be of a class.
    """
    every = range(len(grids.occupied))
    found: list[dict[str, np.ndarray]] = [{} for _ in every]
    usual = {
        name: [i for i in every if sizes is None or _is_usual(name, sizes[i])] for name in priors
    }
    # A class with a front matters to the others, whatever the size; an object with the size of no
    # class is not scored at all.
    possible = sorted(set().union(*usual.values()))
    for name, prior in priors.items():
        if name not in FRONTLESS:
            fronts = _likelihoods(prior, grids, possible, UPRIGHT)
            for i, own in zip(possible, fronts, strict=True):
                found[i][name] = own
            continue
        # Nothing else depends on these classes, so that what cannot be of one is not scored.
        upright = _likelihoods(prior, grids, usual[name], UPRIGHT)
        likely = [k for k, own in enumerate(upright) if own.max() >= WITHOUT_FRONT.likelihood]
        toppled = _likelihoods(prior, grids, [usual[name][k] for k in likely], TOPPLED)
        for k, own in zip(likely, toppled, strict=True):
            found[usual[name][k]][name] = np.concatenate([upright[k], own])
    return [decided(found[i], None if sizes is None else sizes[i]) for i in every]


def _likelihoods(
    prior: ShapePrior, grids: Grids, which: Sequence[int], stances: tuple[Stance, ...]
) -> list[Float[np.ndarray, " stance"]]:
    """Likelihoods of some objects, in one call for a few numbers of objects (`predict_hidden`)."""
    if not which:
        return []
    rows = jnp.array([which[min(k, len(which) - 1)] for k in range(power_of_two(len(which)))])
    some = Grids(grids.occupied[rows], grids.occluded[rows])
    return list(np.asarray(predict_hidden(prior, some, stances))[: len(which)])


def _is_usual(name: str, size: Float[np.ndarray, " 3"]) -> bool:
    """Whether an object with its front at some side has the extents of a class."""
    return min(deviation(name, size, quarters) for quarters in (0, 1)) <= UNUSUAL


def stances_of(name: str) -> tuple[Stance, ...]:
    """The stances that are compared for a class, the upright ones first.

    Args:
        name: Name of the class.
    """
    return UPRIGHT + TOPPLED if name in FRONTLESS else UPRIGHT


def decided(
    found: Mapping[str, Float[np.ndarray, " stance"]], size: Float[np.ndarray, " 3"] | None = None
) -> Decision:
    """The class and the front of one object, from what each prior predicts.

    Chairs stand on legs as tables do, but no side of a table looks like the front of a chair. So
    classes with a front take precedence, and an object with half the evidence for one of them is of
    no class without a front.

    Args:
        found: Log-likelihood of hidden surface voxels for each class in its stances (`stances_of`);
            a class that is missing is excluded.
        size: Extents of the object's box, in metres; None where it may have any size.
    """
    margins = {name: _margin(name, own) for name, own in found.items()}
    fronts = {name: int(own[:TURNS].argmax()) for name, own in found.items()}
    front_evidence = max((x for name, x in margins.items() if name not in FRONTLESS), default=0.0)
    likely = {}
    for name, own in found.items():
        is_frontless = name in FRONTLESS
        standard = WITHOUT_FRONT if is_frontless else WITH_FRONT
        is_excluded = (
            own[:TURNS].max() < standard.likelihood
            or (is_frontless and front_evidence > WITH_FRONT.margin / 2)
            or (size is not None and deviation(name, size, fronts[name]) > UNUSUAL)
        )
        most = EXCLUDED if is_excluded else 1.0
        likely[name] = min(_sigmoid((margins[name] - standard.margin) / standard.spread), most)
    scores = {name: round(margin, 3) for name, margin in margins.items()}
    possible = [name for name in found if likely[name] > 0.5]
    if not possible:
        return Decision(None, 0, 1 - max(likely.values(), default=EXCLUDED), scores)
    best = max(possible, key=lambda name: margins[name])
    return Decision(best, fronts[best], likely[best], scores)


def deviation(name: str, size: Float[np.ndarray, " 3"], quarters: int) -> float:
    """How far the extents of an object are from the usual ones of a class (`UNUSUAL`).

    Args:
        name: Name of the class.
        size: Extents of the object's box along x, y and z, in metres.
        quarters: Quarters of a turn of its front from that of the box.
    """
    usual = sizes_of(name)
    typical, spread = np.array(usual.typical_size), np.array(usual.size_spread)
    own = np.asarray(size)[[2, 1, 0]] if quarters % 2 else np.asarray(size)
    return float(np.sum((np.log(own / typical) / spread) ** 2))


def _margin(name: str, own: Float[np.ndarray, " stance"]) -> float:
    """Evidence for a class: the margin of its likelihood over that in wrong stances."""
    if name in FRONTLESS:
        return float(own[:TURNS].max() - own[TURNS:].max())
    k = int(own.argmax())
    beside = max(own[(k + 1) % TURNS], own[(k - 1) % TURNS])
    return float(min(own[k] - beside, OPPOSITE * (own[k] - own[(k + 2) % TURNS])))


def _sigmoid(x: float) -> float:
    return float(1 / (1 + np.exp(-x)))


def unfilled(grids: Grids, code: Float[Array, " d"]) -> Reconstruction:
    """The shape of an object of no class: the measured voxels and nothing else.

    Args:
        grids: Its F and M `[x y z]`.
        code: Any code `[d]`, as a placeholder.
    """
    measured = jnp.asarray(binary(grids).occupied)[None]
    nothing = jnp.full(measured.shape, NOTHING)
    empty = jnp.zeros_like(measured)
    unknown = jnp.full(1, jnp.nan)
    return Reconstruction(
        code[None], code[None], empty, nothing, empty, measured, nothing, None, None,
        unknown, unknown, None, None, None, None,
    )  # fmt: skip
