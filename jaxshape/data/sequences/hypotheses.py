"""Detect the convention of a recording by the agreement of its poses with its depth images."""

from collections.abc import Iterator
from itertools import combinations
from typing import NamedTuple

import numpy as np

from jaxshape.data.sequences.conventions import CONVENTIONS, DEPTH_RULES, Convention
from jaxshape.data.sequences.evidence import (
    TOLERANCE,
    ConvertedPair,
    Pair,
    agreement,
    seen_by,
    stored_by_columns,
    telling_pairs,
)
from jaxshape.data.sequences.frames import USUAL_DEPTH_SCALES, Sequence

FITS = 0.7
"""Smallest agreement of a convention that fits; with noise and occlusion, correct poses have .8 to
.99."""

GOOD = 0.9
"""Agreement below which conventions with several differences are also tried."""

SURE, DOUBT = 3.0, 2.0
"""Factors by which another convention must reduce the number of disagreeing pixels: to be used
automatically, and to be suggested."""

FINE, FINER = 0.01, 1.5
"""Tolerance at which similar depth scales are compared, and the factor, like `DOUBT`, from which
one is suggested: if 1200 units are read as 1000, 94 % of the pixels agree to 2 %, and 76 % to 1 %
instead of 86 %."""

LEAST = 0.05
"""Least gain of agreement for another convention to be used or suggested."""

SIMPLE = 0.03
"""Loss of agreement allowed for a simpler convention."""

_DEPTHS = (0.3, 7.0)  # metres: range of plausible median depths
_APART = (("centimetres", "millimetres"), ("wxyz", "transposed"))  # never both


class Hypothesis(NamedTuple):
    """A convention and how well the recording agrees with it.

    Attributes:
        convention: The convention.
        share: Share of pixels on which neighbouring frames agree, from 0 to 1.
    """

    convention: Convention
    share: float


class Reading(NamedTuple):
    """The conventions in which a recording may be written, with the evidence.

    Attributes:
        given: Agreement of poses and depth images as they are written, from 0 to 1.
        pairs: Number of pairs of frames that were compared; with 0, nothing is known.
        best: The convention that fits best; None if no other is better than the written one.
        rival: Another convention that is equally simple and fits nearly as well; None without one.
        by_columns: Whether matrices are certainly stored by columns.
        tolerance: Relative difference of depth up to which pixels agree.
    """

    given: float
    pairs: int
    best: Hypothesis | None
    rival: Hypothesis | None
    by_columns: bool
    tolerance: float = TOLERANCE

    @property
    def is_sure(self) -> bool:
        """Whether the evidence suffices to use the best convention automatically."""
        if self.best is None:
            return False
        if self.by_columns and self.best.convention.names == ("transposed",):
            return True
        clear = _is_better(self.best.share, self.given, SURE)
        return self.best.share >= FITS and clear and self.rival is None


def reading_of(sequence: Sequence, median: float) -> Reading:
    """Compare the conventions in which a recording may be written.

    Args:
        sequence: The recording, read as written.
        median: Median depth of the recording, in metres.
    """
    pairs = telling_pairs(sequence)
    by_columns = any(pair.by_columns for pair in pairs) or stored_by_columns(sequence)
    search = _Search(pairs, sequence, median)
    given = 0.0 if by_columns else search.share(())
    found = [*search.simple(by_columns)]
    if pairs and max([given, *(one.share for one in found)]) < GOOD:
        found += search.combined(by_columns)
    best = _simplest(found, given)
    if best is None and not by_columns and (finer := search.finer()):
        return finer
    if best is None and by_columns:
        best = Hypothesis(Convention(("transposed",)), search.share(("transposed",)))
    rival = None if best is None else _rival(found, best)
    return Reading(given, len(pairs), best, rival, by_columns)


class _Search:
    """Agreement of a recording's pairs under conventions; depth images are converted only once."""

    def __init__(self, pairs: tuple[Pair, ...], sequence: Sequence, median: float) -> None:
        self.own, self.median = sequence.depth_scale, median
        self.pairs = pairs
        self.seen: dict[tuple[str, ...], tuple[ConvertedPair, ...]] = {}

    def share(
        self, names: tuple[str, ...], longer: float = 1.0, tolerance: float = TOLERANCE
    ) -> float:
        of_depth = tuple(name for name in names if name in DEPTH_RULES)
        if of_depth not in self.seen:
            self.seen[of_depth] = seen_by(self.pairs, of_depth)
        seen = self.seen[of_depth]
        return agreement(seen, names, longer=longer, tolerance=tolerance)

    def simple(self, by_columns: bool) -> Iterator[Hypothesis]:
        """Conventions with one difference from ours."""
        base = ("transposed",) * by_columns
        for names in (base,) if base else ((name,) for name in CONVENTIONS):
            if self.is_plausible(names):
                yield Hypothesis(Convention(names), self.share(names))
        if not base:
            yield from self.scaled(())

    def combined(self, by_columns: bool) -> Iterator[Hypothesis]:
        """Conventions with two or three differences from ours."""
        for count in (2, 3):
            for names in combinations(CONVENTIONS, count):
                apart = any(set(pair) <= set(names) for pair in _APART)
                if apart or (by_columns and "transposed" not in names):
                    continue
                if self.is_plausible(names):
                    yield Hypothesis(Convention(names), self.share(names))
        for names in (("transposed",),) if by_columns else ((name,) for name in CONVENTIONS):
            if not any(name.endswith("metres") for name in names):
                yield from self.scaled(names)

    def finer(self) -> Reading | None:
        """A slightly different depth scale that is better only at a smaller tolerance."""
        given = self.share((), tolerance=FINE)
        for convention, _ in self.scaled(()):
            share = self.share((), (convention.depth_scale or self.own) / self.own, FINE)
            if _is_better(share, given, FINER):
                return Reading(
                    given, len(self.pairs), Hypothesis(convention, share), None, False, FINE
                )
        return None

    def is_plausible(self, names: tuple[str, ...]) -> bool:
        """Other units of poses are tried only if the depth scale is plausible: both act alike."""
        has_unit = any(name.endswith("metres") for name in names)
        return not has_unit or _DEPTHS[0] <= self.median <= _DEPTHS[1]

    def scaled(self, names: tuple[str, ...]) -> Iterator[Hypothesis]:
        """The best depth scale, or a common one if the poses cannot distinguish the two."""
        if not self.pairs or self.median <= 0:
            return
        low, high = (self.median * self.own / depth for depth in reversed(_DEPTHS))
        scales = np.geomspace(low, high, 64)
        coarse = [self.share(names, scale / self.own) for scale in scales]
        middle = scales[int(np.argmax(coarse))]
        near = np.array([*(middle * np.linspace(0.92, 1.08, 17)), *USUAL_DEPTH_SCALES])
        near = np.unique(near[np.abs(near / middle - 1) < 0.081])
        fine = np.array([self.share(names, scale / self.own, 0.01) for scale in near])
        best = near[int(np.argmax(fine))]
        usual = [s for s in USUAL_DEPTH_SCALES if abs(s / best - 1) < 0.05 and s in near]
        scale = next((s for s in usual if fine[near == s][0] >= fine.max() - SIMPLE), best)
        if abs(scale / self.own - 1) > 0.02:
            rounded = float(scale if scale in USUAL_DEPTH_SCALES else f"{scale:.3g}")
            share = self.share(names, scale / self.own)
            yield Hypothesis(Convention(names, rounded), share)


def _is_better(share: float, other: float, factor: float) -> bool:
    """Whether an agreement leaves fewer pixels in disagreement than another, by a factor."""
    return share >= other + LEAST and factor * (1 - share) <= 1 - other


def _changes(one: Hypothesis) -> int:
    """Number of differences of a convention from ours."""
    return len(one.convention.names) + (one.convention.depth_scale is not None)


def _simplest(found: list[Hypothesis], given: float) -> Hypothesis | None:
    """The simplest hypothesis that fits nearly as well as the best, if it is better than
    `given`."""
    top = max((one.share for one in found), default=0.0)
    if not _is_better(top, given, DOUBT):
        return None
    good = [one for one in found if one.share >= top - SIMPLE]
    return min(good, key=lambda one: (_changes(one), -one.share))


def _rival(found: list[Hypothesis], best: Hypothesis) -> Hypothesis | None:
    """Another convention that is equally simple and fits nearly as well."""
    others = [
        one
        for one in found
        if one.convention != best.convention
        and _changes(one) <= _changes(best)
        and not _is_better(best.share, one.share, DOUBT)
    ]
    return max(others, key=lambda one: one.share, default=None)
