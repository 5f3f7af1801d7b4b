"""The objects in a room, from all keyframes at once: cells of space, and their clusters. [host]

A single frame separates things that belong together, and joins things that only look close. So the
points of all keyframes are put into cells of a grid of the world. A cell is dropped if more
keyframes saw through it than measured something in it. The remaining cells form clusters. As frames
come, clusters appear, join and part by themselves.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from jaxshape.mapping.placement.faces import Cutout, looked_at, world_points

CELL = 0.03
"""Edge length of a cell, in metres: things closer than that are one cluster."""

FLOOR_MARGIN = 0.03
"""Height above the floor, in metres and added to the depth noise, below which nothing is an object.
"""

LOW = 0.1
"""Height above the floor, in metres, below which cells do not join clusters: floors are uneven,
poses err, and a keyframe that shows little floor takes it for an object."""

THROUGH = 0.05
"""Least distance of a measured depth behind a cell, in metres and added to the depth noise, for the
cell to be free."""

NOISE = 4.8e-3
"""Three standard deviations of depth at 1 m, in metres; they grow with the square of depth."""

TOP_HEIGHT, TOP_AREA, TOP_FILLED = 0.58, 0.2, 0.6
"""Least height above the floor in metres, least area in square metres, and least share of the
rectangle around it, for a level slice of a cluster to be a table top. Seats are smaller or have a
back."""

LEAST_CELLS = 40
"""Number of cells of the smallest object."""

LONGEST, TALLEST, LEAST_HEIGHT = 2.6, 2.2, 0.1
"""Greatest diagonal of an object on the floor plan, greatest and least height, in metres."""

ABOVE_FLOOR = 0.3
"""Height of a cluster's lowest cell above the floor, in metres, from which it needs a support."""

FRAGMENT, COVERED, HIGHER = 0.3, 0.7, 0.45
"""A cluster is a fragment of a larger one if it has at most the first share of the larger one's
cells, at least the second share of it stands on the larger one's footprint, and the gap between
their heights is at most the third value, in metres."""

LOST = 2
"""Number of keyframes that must see through a cell, all of them after or all of them before others
measured something there, for the cell to have changed."""

CHANGED = 0.3
"""Share of cells that appeared or vanished above which a cluster was moved."""


class Cells(NamedTuple):
    """Cells of the world in which something was measured.

    Attributes:
        index: Index of each cell along the axes of the level frame `[n 3]`.
        hits: Number of keyframes that measured something in it `[n]`.
        through: Number of keyframes that saw through it `[n]`.
        is_changed: True where it was free at first and filled later, or the other way round `[n]`.
    """

    index: Int[np.ndarray, "n 3"]
    hits: Int[np.ndarray, " n"]
    through: Int[np.ndarray, " n"]
    is_changed: Bool[np.ndarray, " n"]


class Cluster(NamedTuple):
    """Something that stands in the room.

    Attributes:
        index: Its cells `[n 3]`.
        is_moved: Whether it appeared or vanished while the room was filmed.
        is_on_top: Whether it stands on a table.
    """

    index: Int[np.ndarray, "n 3"]
    is_moved: bool
    is_on_top: bool


class Level(NamedTuple):
    """The level frame of a room.

    Attributes:
        T_level_world: World to a frame with the same origin and +y up `[4 4]`.
        floor: Height of the floor in that frame, in metres.
    """

    T_level_world: Float[np.ndarray, "4 4"]
    floor: float


def cells_of(views: Sequence[Cutout], level: Level) -> Cells:
    """The cells in which keyframes measured something that is neither floor nor wall.

    Args:
        views: Keyframes in their order, with the pixels that show neither floor nor wall.
        level: The level frame.
    """
    met = [cells_met(view, level) for view in views]
    index = _each_once(np.concatenate([np.zeros((0, 3), int), *met]))
    T_world_level = np.linalg.inv(level.T_level_world)
    centers = (index + 0.5) * CELL @ T_world_level[:3, :3].T + T_world_level[:3, 3]
    key = keys_of(index)
    hit = np.array([np.isin(key, keys_of(one)) for one in met]).reshape(len(views), -1)
    passed = np.array([_seen_through(centers, view) for view in views]).reshape(hit.shape) & ~hit
    # Where poses err, a thin object is measured beside its cells; it has not vanished.
    near = np.array([_beside(index, one) for one in met]).reshape(hit.shape)
    return Cells(index, hit.sum(axis=0), passed.sum(axis=0), _changed(near, passed & ~near))


def _beside(index: Int[np.ndarray, "n 3"], met: Int[np.ndarray, "m 3"]) -> Bool[np.ndarray, " n"]:
    """Cells that are among other cells or touch them."""
    if not len(met):
        return np.zeros(len(index), bool)
    low = met.min(axis=0) - 1
    filled = np.zeros(met.max(axis=0) - low + 2, bool)
    filled[tuple((met - low).T)] = True
    for axis in range(3):  # axis by axis: much faster than a dilation
        before, after = (np.roll(filled, step, axis) for step in (1, -1))  # the rim is empty
        filled = filled | before | after
    inside = ((index >= low) & (index < low + filled.shape)).all(axis=1)
    inside[inside] = filled[tuple((index[inside] - low).T)]
    return inside


def cells_met(view: Cutout, level: Level) -> Int[np.ndarray, "n 3"]:
    """Cells that the marked pixels of a view lie in.

    Args:
        view: The view, with the pixels that count.
        level: The level frame.

    Returns:
        Indices of the cells `[n 3]`.
    """
    return _each_once(located(view, level)[1])


def _each_once(index: Int[np.ndarray, "n 3"]) -> Int[np.ndarray, "m 3"]:
    """Cells without repetitions, in the order of their keys."""
    return index[np.unique(keys_of(index), return_index=True)[1]]


def located(view: Cutout, level: Level) -> tuple[Bool[np.ndarray, "h w"], Int[np.ndarray, "n 3"]]:
    """The marked pixels of a view above the floor, and the cell that each of them lies in.

    Args:
        view: The view, with the pixels that count.
        level: The level frame.
    """
    marked = np.array(view.segmented, bool)
    points, z = world_points(view)[marked], np.asarray(view.depth, np.float64)[marked]
    R, t = level.T_level_world[:3, :3], level.T_level_world[:3, 3]
    points = points @ R.T + t
    kept = above_floor(points, z, level)
    marked[marked] = kept
    return marked, np.floor(points[kept] / CELL).astype(int)


def above_floor(
    points: Float[np.ndarray, "n 3"], z: Float[np.ndarray, " n"], level: Level
) -> Bool[np.ndarray, " n"]:
    """Points that surely do not belong to the floor.

    Args:
        points: Points in the level frame `[n 3]`, in metres.
        z: Depth at which each was measured `[n]`, in metres.
        level: The level frame.
    """
    return points[:, 1] > level.floor + FLOOR_MARGIN + NOISE / 2 * z**2


def keys_of(index: Int[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
    """One whole number for each cell.

    Args:
        index: Indices of the cells.
    """
    x, y, z = (index + (1 << 20)).astype(np.int64).T
    return (x << 42) | (y << 21) | z


def _seen_through(points: Float[np.ndarray, "n 3"], view: Cutout) -> Bool[np.ndarray, " n"]:
    """Points in the world that a view clearly sees through, at all pixels around."""
    inside, row, column, z = looked_at(points, view)
    depth = np.asarray(view.depth, np.float64)
    nearest = ndimage.minimum_filter(np.where(depth > 0, depth, 0), 3)
    return inside & (nearest[row, column] > z + THROUGH + NOISE * z**2)


def _changed(
    hit: Bool[np.ndarray, "k n"], passed: Bool[np.ndarray, "k n"]
) -> Bool[np.ndarray, " n"]:
    """Cells that were all filled and then all free, or the other way round."""
    if not len(hit):
        return np.zeros(hit.shape[1], bool)
    order = np.arange(len(hit))[:, None]
    first_hit = np.where(hit, order, len(hit)).min(axis=0)
    last_hit = np.where(hit, order, -1).max(axis=0)
    after = (passed & (order > last_hit)).sum(axis=0)
    before = (passed & (order < first_hit)).sum(axis=0)
    amid = passed.sum(axis=0) - after - before
    return (amid == 0) & (np.maximum(after, before) >= LOST) & (np.minimum(after, before) == 0)


# Clusters --------------------------------------------------------------------------------------


def clusters_of(cells: Cells, level: Level) -> list[Cluster]:
    """Things the size of furniture on the floor or on a table, the largest first.

    Args:
        cells: Cells in which something was measured.
        level: The level frame.
    """
    kept = (cells.through <= cells.hits) | cells.is_changed
    floor = level.floor / CELL
    index, hits = cells.index[kept], cells.hits[kept]
    is_low = (index[:, 1] - floor) * CELL < LOW
    parts = [
        _with_feet(part, index[is_low], floor) for part in _apart(index[~is_low], hits[~is_low])
    ]
    found = [one for part in parts for one in _off_the_table(part, floor)]
    joined = _joined([one for one, top in found if not top])
    things = [(one, False) for one in joined] + [(one, True) for one, top in found if top]
    changed = keys_of(cells.index[cells.is_changed])
    return sorted(
        (
            Cluster(one, bool(np.isin(keys_of(one), changed).mean() > CHANGED), top)
            for one, top in things
            if _is_furniture(one) and (top or _stands(one, floor))
        ),
        key=lambda cluster: -len(cluster.index),
    )


def _apart(
    index: Int[np.ndarray, "n 3"], hits: Int[np.ndarray, " n"], least: int = 1
) -> list[Int[np.ndarray, "_ 3"]]:
    """Clusters of cells; one too large for an object is cut where few keyframes measured it.

    Bridges between objects come from noise, and only one or two keyframes measure them.
    """
    kept = hits >= least
    found, of_cell = [], dict(zip(keys_of(index).tolist(), hits.tolist(), strict=True))
    for part in _connected(index[kept]):
        own = np.array([of_cell[key] for key in keys_of(part).tolist()])
        if _is_too_large(part) and own.max() > least:
            found += _apart(part, own, least + 1)
        else:
            found.append(part)
    return found


def _with_feet(
    part: Int[np.ndarray, "n 3"], low: Int[np.ndarray, "m 3"], floor: float
) -> Int[np.ndarray, "_ 3"]:
    """A cluster with the cells near the floor that lie under its own lowest ones."""
    near = part[(part[:, 1] - floor) * CELL < 2 * LOW]
    if not len(near) or not len(low):
        return part
    around = [near * (1, 0, 1) + (i, 0, k) for i in (-1, 0, 1) for k in (-1, 0, 1)]
    own = np.isin(keys_of(low * (1, 0, 1)), keys_of(np.concatenate(around)))
    return np.concatenate([part, low[own]])


def _connected(index: Int[np.ndarray, "n 3"]) -> list[Int[np.ndarray, "_ 3"]]:
    """Groups of cells that touch, at least at a corner, without specks."""
    if not len(index):
        return []
    low = index.min(axis=0)
    grid = np.zeros(index.max(axis=0) - low + 1, bool)
    grid[tuple((index - low).T)] = True
    labels, _ = ndimage.label(grid, np.ones((3, 3, 3)))  # pyright: ignore[reportGeneralTypeIssues]
    of_cell = labels[tuple((index - low).T)]
    counts = np.bincount(of_cell)
    return [index[of_cell == i] for i in np.flatnonzero(counts >= LEAST_CELLS // 4) if i > 0]


def _off_the_table(
    index: Int[np.ndarray, "n 3"], floor: float
) -> list[tuple[Int[np.ndarray, "_ 3"], bool]]:
    """A cluster, and separately the objects on its table top, each marked with True."""
    top = _table_top(index, floor)
    if top is None:
        return [(index, False)]
    above = index[:, 1] > top + 1
    on_top = [(one, True) for one in _connected(index[above])]
    return [(index[~above], False), *on_top]


def _table_top(index: Int[np.ndarray, "n 3"], floor: float) -> int | None:
    """The height of the highest large level slice, in cells; None where there is none."""
    heights = np.unique(index[:, 1])
    for y in heights[::-1]:
        if (y + 0.5 - floor) * CELL < TOP_HEIGHT:
            return None
        slab = np.unique(index[np.abs(index[:, 1] - y) <= 1][:, [0, 2]], axis=0)
        if len(slab) * CELL**2 < TOP_AREA:
            continue
        _, size, _ = rectangle(slab.astype(float))
        above = len(np.unique(index[index[:, 1] > y + 1][:, [0, 2]], axis=0))
        if len(slab) > TOP_FILLED * (size[0] + 1) * (size[1] + 1) and above < 0.6 * len(slab):
            return int(y)
    return None


def _joined(parts: list[Int[np.ndarray, "_ 3"]]) -> list[Int[np.ndarray, "_ 3"]]:
    """Clusters joined with the fragments on their footprints, such as a half hidden leg."""
    parts, whole = sorted(parts, key=len, reverse=True), []
    for part in parts:
        for i, other in enumerate(whole):
            if _is_fragment(part, other):
                whole[i] = np.concatenate([other, part])
                break
        else:
            whole.append(part)
    return whole


def _is_fragment(part: Int[np.ndarray, "n 3"], whole: Int[np.ndarray, "m 3"]) -> bool:
    gap = max(part[:, 1].min() - whole[:, 1].max(), whole[:, 1].min() - part[:, 1].max())
    if len(part) > FRAGMENT * len(whole) or gap * CELL >= HIGHER:
        return False
    yaw, size, middle = rectangle(whole[:, [0, 2]].astype(float))
    near = (part[:, [0, 2]] - middle) @ _axes(yaw).T
    within = (np.abs(near) < size / 2 + 1).all(axis=1).mean()
    return bool(within > COVERED)


def _is_furniture(index: Int[np.ndarray, "n 3"]) -> bool:
    is_high = np.ptp(index[:, 1]) + 1 > LEAST_HEIGHT / CELL
    return bool(len(index) >= LEAST_CELLS and is_high and not _is_too_large(index))


def _is_too_large(index: Int[np.ndarray, "n 3"]) -> bool:
    size = (np.ptp(index, axis=0) + 1) * CELL
    if size[1] > TALLEST:
        return True
    if np.hypot(size[0], size[2]) <= LONGEST:
        return False
    _, sides, _ = rectangle(index[:, [0, 2]].astype(float))  # whichever way it is turned
    return bool(np.hypot(*(sides + 1)) * CELL > LONGEST)


def _stands(index: Int[np.ndarray, "n 3"], floor: float) -> bool:
    """Whether a cluster reaches down to the floor or nearly so."""
    return bool((index[:, 1].min() - floor) * CELL < ABOVE_FLOOR)


# Rectangles ------------------------------------------------------------------------------------


def rectangle(
    points: Float[np.ndarray, "n 2"],
) -> tuple[float, Float[np.ndarray, " 2"], Float[np.ndarray, " 2"]]:
    """The smallest rectangle around points of the floor plan.

    Args:
        points: Points along x and z `[n 2]`.

    Returns:
        The turn of its axes in radians, as of a box about the vertical; its sides; its middle.
    """
    yaws = np.deg2rad(np.arange(0, 90, 1.5))
    axes = np.stack([_axes(yaw) for yaw in yaws])
    low, high = np.percentile(axes @ points.T, (0.5, 99.5), axis=2)
    best = int(np.argmin(np.prod(high - low + 1e-9, axis=1)))
    middle = (low[best] + high[best]) / 2 @ axes[best]
    return float(yaws[best]), high[best] - low[best], middle


def _axes(yaw: float) -> Float[np.ndarray, "2 2"]:
    """The x and z axes, in the floor plan, of a box that is turned about +y."""
    return np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
