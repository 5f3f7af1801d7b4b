"""The classes that objects of a scene may be of, and how one is decided. [host]

Each class has a prior. An object belongs to the class whose prior predicts hidden parts of it
clearly better than its rivals do. The rivals are the priors of other classes and, where objects of
the class have a front, the same prior with the front turned away. The prior of chairs predicts a
plant equally badly from all sides, a cube equally well from all sides, and a chair well only with
the right front.
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxshape.geometry.grids import Grids, binary
from jaxshape.mapping.config import MappingConfig, TrackingConfig
from jaxshape.mapping.map.mapper import Mapper, build_mapper
from jaxshape.mapping.map.state import power_of_two
from jaxshape.mapping.placement.placing import PlacementConfig
from jaxshape.mapping.scene.evidence import TURNS, Predicted, predict_hidden
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
        scores: Evidence for each class, in nats per hidden surface voxel: the margin of its
            likelihood over that of its best rival.
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
        typical, spread, yaws=12, overhangs=(0.0, 0.3), kept=3, steps=30, steps_again=30
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

MARGIN, SPREAD = 0.14, 0.025
"""Least evidence, in nats per hidden surface voxel, for an object to be of a class, and the width
over which the answer goes from unlikely to likely. 31 of 40 procedural chairs have more evidence;
the others, most of them stools without a back, have at most 0.05. 2 of 40 tables have more. Among
80 objects of neither class, only balls and a plant have more, and `WORST` excludes these."""

OPPOSITE = 0.5
"""Weight of the margin over the opposite front: backs differ from fronts more than sides do."""

WORST = -1.4
"""Least log-likelihood of hidden surface voxels for an object to be of any class. It is -1.57 or
less for balls, and -1.58 or less for plants."""


UNUSUAL = 14.0
"""Largest sum of squared deviations of an object's three extents from the usual extents of a class
for the object to be of that class. Each deviation is in standard deviations of the extent's
logarithm; 0.3 % of the objects of a class have a larger sum."""


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
    count = len(grids.occupied)
    rows = jnp.minimum(jnp.arange(power_of_two(count)), count - 1)
    padded = Grids(grids.occupied[rows], grids.occluded[rows])
    found = {name: predict_hidden(prior, padded) for name, prior in priors.items()}
    return [
        decided(
            {name: Predicted(*(np.asarray(x)[i] for x in of)) for name, of in found.items()},
            None if sizes is None else sizes[i],
        )
        for i in range(count)
    ]


def decided(
    found: Mapping[str, Predicted], size: Float[np.ndarray, " 3"] | None = None
) -> Decision:
    """The class and the front of one object, from what each prior predicts.

    Args:
        found: Scores `[turn]` of each class.
        size: Extents of the object's box, in metres; None where it may have any size.
    """
    total = {name: np.asarray(one.surface) for name, one in found.items()}
    fronts = {name: int(own.argmax()) for name, own in total.items()}
    margins = {name: _margin(name, total) for name in total}
    best = max(margins, key=lambda name: margins[name])
    likely = _sigmoid((margins[best] - MARGIN) / SPREAD)
    is_odd = size is not None and deviation(best, size, fronts[best]) > UNUSUAL
    if total[best].max() < WORST or is_odd:
        likely = min(likely, 0.1)
    scores = {name: round(margin, 3) for name, margin in margins.items()}
    if likely > 0.5:
        return Decision(best, fronts[best], likely, scores)
    return Decision(None, 0, 1 - likely, scores)


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


def _margin(name: str, total: Mapping[str, Float[np.ndarray, " turn"]]) -> float:
    """Evidence for a class: its least margin over other classes and over its own other fronts."""
    own = total[name]
    k = int(own.argmax())
    margins = [own[k] - other.max() for rival, other in total.items() if rival != name]
    if name not in FRONTLESS:
        beside = max(own[(k + 1) % TURNS], own[(k - 1) % TURNS])
        margins += [own[k] - beside, OPPOSITE * (own[k] - own[(k + 2) % TURNS])]
    return float(min(margins, default=0.0))


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
