"""Clusters of a depth frame once floor, walls and table tops are removed. [host]"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_dilation
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, KDTree, QhullError

from jaxshape.geometry.sensor import tolerance
from jaxshape.mapping.segmentation.planes import (
    Floor,
    Plane,
    camera_points,
    dominant_planes,
    floor_plane,
    height_above,
    nothing_below,
    on_plane,
)  # fmt: skip

WORKING_WIDTH = 320
"""Clusters are found in images of about this width, in pixels."""

WALL, TABLE, SHEET = 0.75, 0.5, 1.2
"""Limits of the shorter side of a plane, in metres, above which it is no part of the object: for a
plane with nothing seen behind it, for a level plane higher than a seat, and for any plane."""

SEAT = 0.6
"""Level planes higher than this above the floor, in metres, are seats only if they are small."""

FURNITURE = 1.5
"""A cluster longer than this, in metres, is not joined to one that is already chosen."""

HIDDEN = 0.4
"""Largest hidden gap in height between two parts of an object, in metres."""

GROWTH = 0.1
"""Largest distance of legs outside the footprint of the parts above them, in metres."""

LARGER, BESIDE = 5, 4
"""A corner of something nearer hides a cluster that is more than the first number times larger. It
lies within the second number of pixels of that cluster and of the border of the image: shadows of
depth cameras are that wide, and so is the border where they measure nothing."""

MOST = 9
"""Largest number of groups of clusters that are proposed as objects."""

SPECK = 0.003
"""Share of the image below which a group of clusters is not proposed."""

SMALLEST = 12
"""Clusters of fewer pixels are noise."""

SURE_FLOOR = 0.3
"""A floor less certain than this may be a table top, and would remove everything below it."""

Image = Bool[np.ndarray, "h w"]
Pixel = tuple[float, float]


class Scene(NamedTuple):
    """A depth frame reduced to the working width, and its planes.

    Attributes:
        stride: Number of rows, and of columns, of the frame of which the middle one is kept.
        points: Points in the camera frame, in metres; NaN where nothing was measured.
        spacing: Distance between the rays of neighbouring pixels at a depth of 1 m, in metres.
        planes: Dominant planes of the frame, largest first.
        floor: The floor among them; None where no plane is sure to be the floor.
    """

    stride: int
    points: Float[np.ndarray, "h w 3"]
    spacing: float
    planes: list[Plane]
    floor: Floor | None

    @property
    def z(self) -> Float[np.ndarray, "h w"]:
        return self.points[..., 2]


def look(
    depth: Float[np.ndarray, "h w"], K: Float[np.ndarray, "3 3"], stride: int | None = None
) -> Scene:
    """The reduced frame, its planes, and the floor among them.

    Args:
        depth: Depth image `[h w]`, in metres; 0 or infinite where nothing was measured.
        K: Camera matrix `[3 3]`, in pixels.
        stride: Number of rows, and of columns, of which one is kept; None for about the working
            width.
    """
    stride = stride or max(1, round(depth.shape[1] / WORKING_WIDTH))
    points = reduced(camera_points(depth, K), stride)
    cloud = points.reshape(-1, 3)
    planes = dominant_planes(cloud)
    floor = floor_plane(cloud, planes)
    if floor is not None and floor.confidence < SURE_FLOOR:
        floor = None
    return Scene(stride, points, stride / float(K[0, 0]), planes, floor)


def reduced(image: np.ndarray, stride: int) -> np.ndarray:
    """The middle one of every `stride` rows and columns."""
    return image[stride // 2 :: stride, stride // 2 :: stride]


def enlarged(segmented: Image, view: Scene, depth: Float[np.ndarray, "H W"]) -> np.ndarray:
    """Upsample a segmentation to full size.

    Each pixel copies the value of the neighbouring reduced pixel that is closest in depth.
    """
    (h, w), stride = segmented.shape, view.stride
    if stride == 1:
        return segmented
    row, column = (np.arange(size) // stride for size in depth.shape)
    best, found = tolerance(depth), np.zeros(depth.shape, bool)
    for down, right in ((0, 0), (0, 1), (1, 0), (0, -1), (-1, 0)):
        pixel = np.ix_(np.clip(row + down, 0, h - 1), np.clip(column + right, 0, w - 1))
        apart = np.abs(view.z[pixel] - depth)
        nearer = apart < best  # False for NaN
        found = np.where(nearer, segmented[pixel], found)
        best = np.where(nearer, apart, best)
    return found


# Background -----------------------------------------------------------------------------------


class Background(NamedTuple):
    """Pixels that are no part of an object.

    Attributes:
        pixels: True on and behind floor and walls, and on table tops `[h w]`.
        tops: Number of the table top of each pixel, from 1; 0 elsewhere `[h w]`.
    """

    pixels: Image
    tops: Int[np.ndarray, "h w"]


def background(view: Scene, click: Pixel | None, *, with_tables: bool = True) -> Background:
    """Floor, walls and table tops, unless they were clicked on.

    Args:
        view: The reduced frame.
        click: Row and column of a pixel that shows the object; None for none.
        with_tables: Whether table tops are background; False where tables are objects.
    """
    floor = None if view.floor is None else view.floor.plane
    found = np.zeros(view.z.shape, bool) if floor is None else _beyond(view, floor)
    tops = np.zeros(found.shape, int)
    for plane in view.planes:
        if plane is floor:
            continue
        # A plane continues through objects that cross it, so its connected parts are judged.
        labels = clusters(view, on_plane(plane, view.points) & ~found)
        parts = [labels == label for label in range(1, labels.max() + 1)]
        parts = [part for part in parts if not _is_clicked(part, click)]
        sides = [_shorter_side(view.points[part]) for part in parts]
        if _is_wall(plane, parts, sides, view):
            found |= _beyond(view, plane)
        is_table = with_tables and floor is not None and _is_table_top(plane, floor)
        for part, side in zip(parts, sides, strict=True):
            if side > (TABLE if is_table else SHEET):
                found |= part
                tops[part] = is_table * (tops.max() + 1)
    return Background(found, tops)


def _beyond(view: Scene, plane: Plane) -> Image:
    """True on a plane and behind it."""
    return height_above(plane, view.points) < tolerance(view.z)


def _is_clicked(part: Image, click: Pixel | None) -> bool:
    return click is not None and distance(part, click) < 2


def distance(segmented: Image, target: Pixel) -> float:
    """Distance, in pixels, from a point to the nearest pixel that is segmented."""
    row, column = np.nonzero(segmented)
    return float(np.hypot(row - target[0], column - target[1]).min(initial=np.inf))


def _shorter_side(points: Float[np.ndarray, "n 3"]) -> float:
    """The shorter side, in metres, of a rectangle whose points scatter as much as these."""
    return float(np.sqrt(12 * np.linalg.eigvalsh(np.cov(points.T))[1]))


def _is_wall(plane: Plane, parts: list[Image], sides: list[float], view: Scene) -> bool:
    """Whether a plane is large, cut by the image border, and has next to nothing behind it."""
    large = any(side > WALL and cut(part) > 0 for part, side in zip(parts, sides, strict=True))
    return large and nothing_below(plane, view.points.reshape(-1, 3)) > 0


def _is_table_top(plane: Plane, floor: Plane) -> bool:
    """Whether a plane is level, and higher above the floor than a seat."""
    level = plane.normal @ floor.normal > np.cos(np.deg2rad(8))
    return bool(level) and floor.offset - plane.offset > SEAT


def cut(segmented: Image) -> float:
    """Share, from 0 to 1, of an outline that lies on the border of the image."""
    border = segmented[[0, -1]].sum() + segmented[:, [0, -1]].sum()
    return min(1.0, float(border / max(1.0, 4 * np.sqrt(segmented.sum()))))


# Clusters --------------------------------------------------------------------------------------


def clusters(view: Scene, free: Image) -> Int[np.ndarray, "h w"]:
    """Connected free pixels without a jump in depth between them: 1, 2, ...; 0 elsewhere."""
    index = np.arange(free.size).reshape(free.shape)
    across = free[:, 1:] & free[:, :-1] & ~jumps(view.z[:, 1:], view.z[:, :-1], view.spacing)
    down = free[1:] & free[:-1] & ~jumps(view.z[1:], view.z[:-1], view.spacing)
    first = np.concatenate([index[:, 1:][across], index[1:][down]])
    second = np.concatenate([index[:, :-1][across], index[:-1][down]])
    edges = coo_array((np.ones(len(first), bool), (first, second)), shape=(free.size,) * 2)
    labels = connected_components(edges, directed=False)[1].reshape(free.shape)
    kept = np.bincount(labels[free], minlength=labels.max() + 1) >= SMALLEST
    return np.where(free & kept[labels], np.cumsum(kept)[labels], 0)


def jumps(
    z: Float[np.ndarray, "h w"], other: Float[np.ndarray, "h w"], spacing: float
) -> Bool[np.ndarray, "h w"]:
    """Whether neighbouring pixels lie on two surfaces; noise and slopes do not count as jumps."""
    nearer = np.fmin(z, other)
    return np.abs(z - other) > tolerance(nearer) + 2.5 * spacing * nearer


def joined(labels: Int[np.ndarray, "h w"], main: int, view: Scene) -> list[int]:
    """The main cluster and those that belong to it: legs and slats cut off by its other parts.

    Clusters belong together if most of one stands on the footprint of the other, which is no larger
    than furniture, or if one is much smaller and next to the other in space. The corner of
    something nearer that reaches into the image belongs to no cluster.
    """
    present = np.unique(labels[labels > 0]).tolist()
    clouds = {label: view.points[labels == label] for label in present}
    chosen, others = [main], set(clouds) - {main, *corners(labels, view)}
    while True:
        body = np.concatenate([clouds[label] for label in chosen])
        new = [label for label in sorted(others) if _belongs(clouds[label], body, view.floor)]
        if not new:
            return chosen
        chosen, others = chosen + new, others - set(new)


def pairs(labels: Int[np.ndarray, "h w"], view: Scene) -> list[tuple[int, int]]:
    """Pairs of clusters that belong together: a back and the seat below it, a seat and its legs.

    Corners of something nearer are in none of them.
    """
    at_border = corners(labels, view)
    present = [i for i in np.unique(labels[labels > 0]).tolist() if i not in at_border]
    clouds = {label: _some(view.points[labels == label]) for label in present}
    sizes = np.bincount(np.maximum(labels, 0).ravel())
    present = sorted(present, key=lambda label: int(sizes[label]))
    return [
        (one, other)
        for i, one in enumerate(present)
        for other in present[i + 1 :]
        if _may_touch(clouds[one], clouds[other])
        and _belongs(clouds[one], clouds[other], view.floor)
    ]


def _some(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """A regular subset of the points, a few hundred in all."""
    return points[:: 1 + len(points) // 500]


def _may_touch(one: Float[np.ndarray, "n 3"], other: Float[np.ndarray, "m 3"]) -> bool:
    """Whether the boxes around two clusters, along the axes of the camera, are near each other."""
    gap = np.maximum(one.min(axis=0) - other.max(axis=0), other.min(axis=0) - one.max(axis=0))
    return bool((gap < HIDDEN).all())


def corners(labels: Int[np.ndarray, "h w"], view: Scene) -> list[int]:
    """Small clusters at the border of the image that hide some of a far larger one.

    They may be the corners of something nearer that lies mostly outside of the image.
    """
    border = np.ones(labels.shape, bool)
    border[BESIDE:-BESIDE, BESIDE:-BESIDE] = False
    at_border = np.unique(labels[border])
    sizes = np.bincount(np.maximum(labels, 0).ravel())
    found = []
    for label in at_border[at_border > 0].tolist():
        piece = labels == label
        beside = np.asarray(binary_dilation(piece, iterations=BESIDE), bool) & (labels > 0)
        beside[beside] = sizes[labels[beside]] > LARGER * sizes[label]
        if beside.any():
            z, behind = np.median(view.z[piece]), np.median(view.z[beside], keepdims=True)
            found += [label] * bool(behind - z > tolerance(behind))
    return found


def groups(labels: Int[np.ndarray, "h w"], view: Scene) -> list[list[int]]:
    """The largest clusters, each with the clusters that belong to it and to no larger one."""
    sizes = np.bincount(labels.ravel())[1:]
    found, left = [], labels.copy()
    for seed in np.argsort(-sizes, kind="stable")[: 4 * MOST] + 1:
        if (left == seed).any():
            found.append(joined(left, int(seed), view))
            left[np.isin(left, found[-1])] = 0
    total = {tuple(group): sizes[np.array(group) - 1].sum() for group in found}
    found = [group for group in found if total[tuple(group)] >= SPECK * labels.size]
    return sorted(found, key=lambda group: -total[tuple(group)])[:MOST]


def _belongs(
    piece: Float[np.ndarray, "n 3"], body: Float[np.ndarray, "m 3"], floor: Floor | None
) -> bool:
    if floor is not None and _apart_in_height(piece, body, floor.plane) < HIDDEN:
        above = over_footprint(piece, body, floor.plane).mean() > 0.6
        below = over_footprint(body, piece, floor.plane).mean() > 0.8
        if above or (below and np.ptp(piece, axis=0).max() < FURNITURE):
            return True
    gap = float(tolerance(piece[:, 2]).mean())
    nearest = KDTree(body).query(piece, distance_upper_bound=gap)[0].min()
    return len(piece) < 0.2 * len(body) and bool(nearest < gap)


def _apart_in_height(
    first: Float[np.ndarray, "n 3"], second: Float[np.ndarray, "m 3"], floor: Plane
) -> float:
    """The gap, in metres, between the heights that two clusters span; negative if they overlap."""
    a, b = height_above(floor, first), height_above(floor, second)
    return float(max(a.min() - b.max(), b.min() - a.max()))


def over_footprint(
    points: Float[np.ndarray, "n 3"], body: Float[np.ndarray, "m 3"], floor: Plane
) -> Bool[np.ndarray, " n"]:
    """Whether points lie above the slightly enlarged convex footprint of a body on the floor.

    A body hides its own far side, so the footprint is made as deep as it is wide.
    """
    ahead = np.array([0.0, 0.0, 1.0]) - floor.normal[2] * floor.normal
    ahead = ahead / max(np.linalg.norm(ahead), 1e-9)
    axes = np.stack([np.cross(floor.normal, ahead), ahead])
    seen = body @ axes.T
    width, depth = np.ptp(seen, axis=0)
    hidden = seen + [0, max(0.0, width - depth)]
    try:
        hull = ConvexHull(np.concatenate([seen, hidden])).equations
    except QhullError:  # fewer than three points
        return np.zeros(len(points), bool)
    return (points @ axes.T @ hull[:, :2].T + hull[:, 2]).max(axis=1) < GROWTH
