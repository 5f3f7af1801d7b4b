"""Which parts of many frames are the object, decided together. [host]

A part of one frame belongs to the object if it lies in the object's box and next to, above or below
known points of the object. A part also belongs to the object if it shows known points again and
ends within the prior's reach. So a box that is too short does not exclude parts of the object, and
a box that is too large does not include the table beside it. A part that two frames show together
with the object belongs to it, too: for example the seat, if the first frame showed only the back
above it. Parts that other frames show apart from the object, or that extend beyond its reach, are
something else. A part under a table top may be the leg of the table, and a part at the border of
the image may be the corner of something nearer: such parts are the object only where other frames
show it there.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import ConvexHull, KDTree

from jaxshape.data.boxes import Box, in_object, points_in_box
from jaxshape.mapping.segmentation.parts import SPECK
from jaxshape.mapping.segmentation.specks import confirmed

NEAR = 0.03
"""Distance between points of two frames, in metres, within which both measured the same surface."""

MOSTLY, WHOLLY = 0.5, 0.95
"""Least share of a part in the object's box, and least share within its reach, for the part to
belong to the object."""

AGAIN = 0.1
"""Least share of a part that lies at known points of the object for the part to show it again."""

BESIDE, ALONG = 0.06, 1.0
"""Largest distance, sideways and along the vertical, at which a part adjoins the object, in
metres."""

EDGE, UNDER = 0.03, 0.95
"""Distance in metres by which a table top reaches beyond its measured points, and the least share
of a part below the table top for the part to stand under it."""

FOREIGN = 0.2
"""Share of a part at measured points of other things above which the part is cut."""

ROUNDS = 4
"""Largest number of rounds; each judges all parts again with the points added by the last one."""

_SAMPLE = 500  # points of each part that are compared
_SPACING = 0.01  # metres between the points of the object that are kept


class Seen(NamedTuple):
    """One frame, in the world.

    Attributes:
        points: Points of the pixels, in metres; NaN where nothing was measured `[h w 3]`.
        labels: Part of each pixel, from 1; 0 for floor, walls and table tops, `SPECK` for pieces
            that are too small to be a part `[h w]`.
        sure: True on pixels that are known to show the object `[h w]`.
        corners: Labels of the parts that may be corners of something nearer `[n]`.
        tops: Number of the table top of each pixel, from 1; 0 elsewhere `[h w]`; None for none.
        pairs: Pairs of labels of parts that belong together in this frame `[m 2]`.
    """

    points: Float[np.ndarray, "h w 3"]
    labels: Int[np.ndarray, "h w"]
    sure: Bool[np.ndarray, "h w"]
    corners: Int[np.ndarray, " n"] = np.zeros(0, int)
    tops: Int[np.ndarray, "h w"] | None = None
    pairs: Int[np.ndarray, "m 2"] = np.zeros((0, 2), int)


class _Part(NamedTuple):
    """One part of a frame, and its position relative to the object.

    Attributes:
        frame: Number of the frame that it is in.
        label: Its label in that frame.
        points: Some of its points, in the world `[n 3]`.
        in_box: Share of it in the box of the object.
        in_reach: Share of it within the reach of the object.
        in_column: Share of it in the reach above and below the box.
        is_doubtful: Whether it may be the corner of something nearer, or the leg of a table.
    """

    frame: int
    label: int
    points: Float[np.ndarray, "n 3"]
    in_box: float
    in_reach: float
    in_column: float
    is_doubtful: bool


class _Known(NamedTuple):
    """Measured points, in trees that find the nearest point.

    Attributes:
        ours: Points of the object.
        columns: The same points in the frame of its box, with compressed heights, so that points
            above and below them are near.
        others: Points of other things.
    """

    ours: KDTree
    columns: KDTree
    others: KDTree


def belonging(
    frames: list[Seen], box: Box, reach: Box, column: Box
) -> list[Bool[np.ndarray, "h w"]]:
    """The pixels of each frame that show the object.

    Args:
        frames: The frames, in the world.
        box: The object's box, as far as it is known.
        reach: The largest box that the object may turn out to fill.
        column: The part of the reach above and below the box: a part that lies there and is not
            known to be the object is still undecided, not something else.

    Returns:
        For each frame, True on the object `[h w]`.
    """
    tops = [top for seen in frames for top in _tops(seen, box)]
    parts = [
        part for i, seen in enumerate(frames) for part in _parts(i, seen, box, reach, column, tops)
    ]
    sure = [seen.points[seen.sure & points_in_box(seen.points, reach)] for seen in frames]
    background = [_background(seen, column) for seen in frames]
    known = _Known(*_trees(sure, box), _tree(background))
    whole, clouds = set(), sure
    for _ in range(ROUNDS):
        ours = [part for part in parts if _is_ours(part, known, box)]
        if beside := _together(parts, ours, whole, frames):
            more = [*clouds, *(part.points for part in beside)]
            known = _Known(*_trees(more, box), known.others)
            ours = [part for part in parts if _is_ours(part, known, box)]
        taken = {part[:2] for part in ours}
        apart = [part for part in parts if part[:2] not in taken and _is_apart(part)]
        known = known._replace(others=_tree([*background, *(part.points for part in apart)]))
        ours = [part for part in ours if float(_foreign(part.points, known).mean()) < MOSTLY]
        before, whole = whole, {part[:2] for part in ours if _is_whole(part, known)}
        if whole == before:
            break
        clouds = [*sure, *(part.points for part in ours if part[:2] in whole)]
        known = _Known(*_trees(clouds, box), known.others)
    found = [
        _pixels(seen, [p for p in ours if p.frame == i], whole, known, box, reach)
        for i, seen in enumerate(frames)
    ]
    return _with_specks(frames, found, known, reach)


def _is_ours(part: _Part, known: _Known, box: Box) -> bool:
    """Whether a part is the object, entirely or in part.

    A doubtful part is the object only if other frames show it as the object.
    """
    again = float(_near(part.points, known.ours).mean())
    if part.is_doubtful:
        return again > MOSTLY
    return again > AGAIN or (part.in_box > MOSTLY and _adjoins(part, known.columns, box))


def _adjoins(part: _Part, columns: KDTree, box: Box) -> bool:
    """Whether some of a part lies next to, above or below the object."""
    away, _ = columns.query(_flat(part.points, box), distance_upper_bound=BESIDE)
    return float(np.isfinite(away).mean()) > AGAIN


def _trees(clouds: list[Float[np.ndarray, "_ 3"]], box: Box) -> tuple[KDTree, KDTree]:
    """Trees of the object's points, at their heights and at compressed heights."""
    return _tree(clouds), _tree([_flat(points, box) for points in clouds])


def _flat(points: Float[np.ndarray, "n 3"], box: Box) -> Float[np.ndarray, "n 3"]:
    """Points in the frame of the box, its height scaled so that `ALONG` is as far as `BESIDE`."""
    return in_object(points, box) * (1.0, BESIDE / ALONG, 1.0)


def _together(
    parts: list[_Part], ours: list[_Part], whole: set[tuple[int, int]], frames: list[Seen]
) -> list[_Part]:
    """The parts that their frames pair with the object, if two frames agree on them."""
    sure = {part[:2] for part in ours if part[:2] in whole}
    partners = {
        (frame, int(b))
        for frame, seen in enumerate(frames)
        for pair in seen.pairs
        for a, b in (pair, pair[::-1])
        if (frame, int(a)) in sure
    }
    known = {part[:2] for part in ours}
    may_be = [p for p in parts if p.in_reach > WHOLLY and not p.is_doubtful]
    found = [p for p in may_be if p[:2] in partners - known]
    clouds = {i: _tree([p.points for p in found if p.frame != i]) for i in {p.frame for p in found}}
    return [p for p in found if float(_near(p.points, clouds[p.frame]).mean()) > MOSTLY]


def _is_apart(part: _Part) -> bool:
    """Whether a part that is not the object is surely something else."""
    return part.in_column < MOSTLY or part.in_reach < WHOLLY


def _is_whole(part: _Part, known: _Known) -> bool:
    """Whether a part of the object contains nothing else."""
    return part.in_reach > WHOLLY and float(_foreign(part.points, known).mean()) < FOREIGN


def _foreign(points: Float[np.ndarray, "n 3"], known: _Known) -> Bool[np.ndarray, " n"]:
    """Points at which other things were measured, but not the object."""
    return _near(points, known.others) & ~_near(points, known.ours)


def _near(points: Float[np.ndarray, "n 3"], tree: KDTree) -> Bool[np.ndarray, " n"]:
    return np.isfinite(tree.query(points, distance_upper_bound=NEAR)[0])


def _pixels(
    seen: Seen, ours: list[_Part], whole: set[tuple[int, int]], known: _Known, box: Box, reach: Box
) -> Bool[np.ndarray, "h w"]:
    """Pixels of the parts of the object; of parts that contain other things, pixels in its box."""
    in_whole = np.isin(seen.labels, [part.label for part in ours if part[:2] in whole])
    found = (seen.sure | in_whole) & points_in_box(seen.points, reach)
    mixed = np.isin(seen.labels, [part.label for part in ours if part[:2] not in whole])
    mixed &= points_in_box(seen.points, box) & ~found
    found[mixed] = ~_foreign(seen.points[mixed], known)
    return found


def _with_specks(
    frames: list[Seen], found: list[Bool[np.ndarray, "h w"]], known: _Known, reach: Box
) -> list[Bool[np.ndarray, "h w"]]:
    """The object's pixels, together with the specks that other frames confirm."""
    loose = [(seen.labels == SPECK) & points_in_box(seen.points, reach) for seen in frames]
    for seen, pixels in zip(frames, loose, strict=True):
        pixels[pixels] = ~_foreign(seen.points[pixels], known)
    points = [seen.points[pixels] for seen, pixels in zip(frames, loose, strict=True)]
    ours = [seen.points[pixels] for seen, pixels in zip(frames, found, strict=True)]
    for pixels, both, more in zip(found, loose, confirmed(points, ours, reach), strict=True):
        pixels[both] |= more
    return found


# Points ------------------------------------------------------------------------------------------


def _parts(
    index: int, seen: Seen, box: Box, reach: Box, column: Box, tops: list["_Top"]
) -> list[_Part]:
    """The parts of a frame that lie, at least a little, within the reach of the object."""
    within = [points_in_box(seen.points, one) for one in (box, reach, column)]
    found = []
    for label in np.unique(seen.labels[within[1] & (seen.labels > 0)]):
        pixels = seen.labels == label
        points = seen.points[pixels]
        in_box, in_reach, in_column = (float(inside[pixels].mean()) for inside in within)
        some = points[:: 1 + len(points) // _SAMPLE]
        is_doubtful = label in seen.corners or _is_under(in_object(some, box), tops)
        found.append(_Part(index, int(label), some, in_box, in_reach, in_column, is_doubtful))
    return found


class _Top(NamedTuple):
    """A table top in the frame of the object's box.

    Attributes:
        height: Its height, in metres.
        hull: The lines around it `[n 3]`: inside, the product of (x, z, 1) with each is negative.
    """

    height: float
    hull: Float[np.ndarray, "n 3"]


def _tops(seen: Seen, box: Box) -> list[_Top]:
    """The table tops of a frame."""
    if seen.tops is None:
        return []
    found = []
    for number in range(1, seen.tops.max() + 1):
        points = in_object(seen.points[seen.tops == number], box)
        hull = ConvexHull(points[:, ::2]).equations
        found.append(_Top(float(np.median(points[:, 1])), hull))
    return found


def _is_under(points: Float[np.ndarray, "n 3"], tops: list[_Top]) -> bool:
    """Whether points in the frame of the box are below a table top."""
    for top in tops:
        outside = (points[:, ::2] @ top.hull[:, :2].T + top.hull[:, 2]).max(axis=1)
        if float(((outside < EDGE) & (points[:, 1] < top.height)).mean()) > UNDER:
            return True
    return False


def _background(seen: Seen, column: Box) -> Float[np.ndarray, "n 3"]:
    """Some points of walls and table tops around the object; the floor is excluded from its box."""
    points = seen.points[(seen.labels == 0) & ~seen.sure]
    return points[points_in_box(points, column)][::3]


def _tree(clouds: list[Float[np.ndarray, "_ 3"]]) -> KDTree:
    """A tree of the points of some clouds, one point in each small cell."""
    points = np.concatenate([np.zeros((0, 3)), *clouds])
    cells = np.floor(points / _SPACING).astype(np.int64)
    return KDTree(points[np.sort(np.unique(cells, axis=0, return_index=True)[1])])
