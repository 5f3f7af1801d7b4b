"""Dominant planes of a depth image, and the floor among them. [host]

Points are in the camera frame, metres. A plane's normal looks towards the camera, so heights above
it grow towards the camera too.
"""

from itertools import combinations
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from jaxshape.geometry import camera
from jaxshape.geometry.sensor import tolerance

SAMPLE = 4000
"""Number of points in which planes are searched: enough for a plane that holds 2 % of them."""

HYPOTHESES = 256
"""Number of plane hypotheses, all fitted at once, each to a few neighbouring points."""

NEIGHBOURS = 24
"""Number of points that a hypothesis is fitted to: they span half a metre of a wall at three
metres."""

REFINED = 6
"""Number of hypotheses that are refined, those with most inliers: the best one may lie across a
corner."""

MAX_TILT = 65.0
"""Largest angle, in degrees, between the floor's normal and up in the image of a hand-held
camera."""

WALL = 0.05
"""Least share of the points that a wall holds."""

CORNER = 60.0
"""Smallest angle, in degrees, at which two walls meet."""


class Plane(NamedTuple):
    """The points `p` with `normal . p + offset = 0`.

    Attributes:
        normal: Unit vector towards the camera.
        offset: Distance of the camera from the plane, in metres.
        share: Share of the points that lie on the plane, from 0 to 1.
    """

    normal: Float[np.ndarray, " 3"]
    offset: float
    share: float


class Floor(NamedTuple):
    """The plane on which the object stands.

    Attributes:
        plane: The plane: `plane.normal` is up, `plane.offset` the height of the camera above it.
        confidence: From 0 to 1: high where enough of the plane is seen, little lies below it, and
            the object stands on it.
    """

    plane: Plane
    confidence: float


def camera_points(
    depth: Float[np.ndarray, "h w"], K: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "h w 3"]:
    """The camera-frame point of each pixel, in metres; NaN where no depth was measured."""
    measured = np.where((depth > 0) & np.isfinite(depth), depth, np.nan)
    return np.asarray(camera.unproject(camera.intrinsics_of(K), jnp.float32(measured)))


def height_above(plane: Plane, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n"]:
    """Signed distance from the plane, in metres: positive on the camera's side."""
    return points @ plane.normal + plane.offset


def on_plane(plane: Plane, points: Float[np.ndarray, "*n 3"]) -> Bool[np.ndarray, "*n"]:
    """Whether points lie on the plane as far as a depth camera can tell; False for NaN."""
    return np.abs(height_above(plane, points)) < tolerance(points[..., 2])


# Dominant planes -------------------------------------------------------------------------------


def dominant_planes(
    points: Float[np.ndarray, "n 3"], *, count: int = 8, min_share: float = 0.02, seed: int = 0
) -> list[Plane]:
    """The planes that hold most points, one after the other, by RANSAC; largest first.

    The points of each plane are removed before the next plane is searched. At most `count` planes
    that hold at least `min_share` of all points are returned, and none for a cloud without planes
    or with fewer than `NEIGHBOURS` points. The same points, in the same order, give the same
    planes.
    """
    rng = np.random.default_rng(seed)
    sample = subsample(points[np.isfinite(points).all(axis=-1)], SAMPLE, rng)
    if len(sample) < NEIGHBOURS:
        return []
    normals, offsets = _hypotheses(sample, rng)
    distance = (sample @ normals.T + offsets) / tolerance(sample[:, 2])[:, None]
    credit = np.clip(1 - distance**2, 0, None)  # as MSAC does: a near miss is worth little
    free, planes = np.ones(len(sample), bool), []
    while len(planes) < count:
        best = np.argsort(free @ credit)[-REFINED:]
        found = [_refined(normals[i], float(offsets[i]), sample, free) for i in best]
        largest = max(found, key=lambda plane: plane.share)
        if largest.share < min_share:
            break
        free &= ~on_plane(largest, sample)
        planes.append(largest)
    return sorted(planes, key=lambda plane: -plane.share)


def subsample(
    points: Float[np.ndarray, "n 3"], count: int, rng: np.random.Generator
) -> Float[np.ndarray, "m 3"]:
    """At most `count` of the points, chosen at random without repetition, as float64."""
    if len(points) > count:
        points = points[rng.choice(len(points), count, replace=False)]
    return points.astype(np.float64)


def _hypotheses(
    points: Float[np.ndarray, "n 3"], rng: np.random.Generator
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, " k"]]:
    """Planes through the neighbours of random points, which mostly lie on one surface.

    Three points drawn from the whole cloud would all lie on a plane that holds a tenth of the
    points in only one of a thousand draws.
    """
    anchors = rng.choice(len(points), min(HYPOTHESES, len(points)), replace=False)
    _, near = KDTree(points).query(points[anchors], k=NEIGHBOURS)
    return _fit(points[near], np.ones(near.shape))


def _refined(
    normal: Float[np.ndarray, " 3"],
    offset: float,
    points: Float[np.ndarray, "n 3"],
    free: Bool[np.ndarray, " n"],
) -> Plane:
    """Least squares on the inliers, weighted by their certainty, until they stay the same."""
    plane = Plane(normal, offset, 0.0)
    inlier = free & on_plane(plane, points)
    for _ in range(10):
        if inlier.sum() < 3:
            break
        # The square would be exact for pure noise, but a few near strays would turn a far wall.
        certainty = inlier / tolerance(points[:, 2])
        normals, offsets = _fit(points[None], certainty[None])
        plane = Plane(normals[0], float(offsets[0]), float(inlier.mean()))
        before, inlier = inlier, free & on_plane(plane, points)
        if (before == inlier).all():
            break
    return plane._replace(share=float(inlier.mean()))


def _fit(
    points: Float[np.ndarray, "k n 3"], weight: Float[np.ndarray, "k n"]
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, " k"]]:
    """Normals, towards the camera, and offsets of the planes of least weighted squared distance."""
    weight = weight / weight.sum(axis=1, keepdims=True)
    center = np.einsum("kn,knd->kd", weight, points)
    centered = points - center[:, None]
    covariance = np.einsum("kn,kni,knj->kij", weight, centered, centered)
    normal = np.linalg.eigh(covariance)[1][:, :, 0]  # eigenvalues ascend
    offset = -np.sum(normal * center, axis=1)
    side = np.where(offset < 0, -1.0, 1.0)
    return normal * side[:, None], offset * side


# The floor -------------------------------------------------------------------------------------


def floor_plane(
    points: Float[np.ndarray, "n 3"],
    planes: list[Plane],
    object_points: Float[np.ndarray, "m 3"] | None = None,
) -> Floor | None:
    """The floor among the planes of a view, or None where no plane can be it.

    A floor is roughly horizontal for a hand-held camera and, unlike a table top or a seat, has next
    to nothing below it. The object, if its points are given, stands on it. Of several planes, the
    most certain one is the floor. If only a table top is seen, its normal still points up, and the
    certainty is small.
    """
    rng = np.random.default_rng(0)
    sample = subsample(points[np.isfinite(points).all(axis=-1)], SAMPLE, rng)
    level = [plane for plane in planes if -plane.normal[1] > np.cos(np.deg2rad(MAX_TILT))]
    floors = [Floor(plane, _floor_evidence(plane, sample, object_points)) for plane in level]
    return max(floors, key=lambda floor: (floor.confidence, floor.plane.share), default=None)


def _floor_evidence(
    plane: Plane,
    points: Float[np.ndarray, "n 3"],
    object_points: Float[np.ndarray, "m 3"] | None,
) -> float:
    """Evidence, from 0 to 1, that a level plane is the floor."""
    seen = min(1.0, plane.share / 0.05)
    lowest = nothing_below(plane, points)
    if object_points is None or len(object_points) == 0:
        return seen * lowest
    feet = float(np.percentile(height_above(plane, object_points), 2))
    touched = float(np.clip((0.6 - feet) / 0.4, 0, 1))  # feet may be hidden, or cut a little
    return seen * lowest * touched * nothing_below(plane, object_points)


def nothing_below(plane: Plane, points: Float[np.ndarray, "n 3"]) -> float:
    """1 if no point lies clearly below the plane, 0 if 5 % of them do."""
    known = points[np.isfinite(points).all(axis=-1)]
    below = np.mean(height_above(plane, known) < -2 * tolerance(known[:, 2]))
    return float(np.clip(1 - below / 0.05, 0, 1))


# Walls -----------------------------------------------------------------------------------------


def along_walls(planes: list[Plane]) -> Float[np.ndarray, " 3"] | None:
    """The vertical of a room whose floor is not seen: the direction that lies in two of its walls.

    Any two large planes that meet at an angle of `CORNER` or more count as walls if their line of
    intersection is roughly upright in the image of a hand-held camera. Of several pairs, the one
    whose smaller wall holds most points is used.

    Args:
        planes: Planes of the view, as `dominant_planes` finds them.

    Returns:
        The upward unit vector in the camera frame, or None where no two walls are seen.
    """
    largest = np.cos(np.deg2rad(CORNER))
    walls = [plane for plane in planes if plane.share >= WALL]
    pairs = []
    for one, other in combinations(walls, 2):
        if abs(one.normal @ other.normal) > largest:
            continue
        line = np.cross(one.normal, other.normal)
        line *= -np.sign(line[1]) / np.linalg.norm(line)
        if -line[1] > np.cos(np.deg2rad(MAX_TILT)):
            pairs.append((min(one.share, other.share), line))
    return max(pairs, key=lambda pair: pair[0])[1] if pairs else None
