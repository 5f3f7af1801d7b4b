"""How good a result is where no truth is known, in figures and in words. [host]

quality_of(...)         figures: of the mesh, and of the keyframes that it has to explain
quality_of_cloud(...)   the same, for a point cloud
judged(quality)         good; doubtful because ...; failed because ...
"""

from collections.abc import Iterator, Sequence
from typing import Literal, NamedTuple

import numpy as np
import trimesh
from jaxtyping import Bool, Float
from scipy import ndimage
from scipy.spatial import KDTree

from jaxshape.mapping.map.doubts import ALL_SEEN, Unseen, joined

CLOSE = 0.01
"""Distance from the mesh, in metres and combined with the depth noise, within which a measured
point is explained."""

THROUGH = 0.03
"""Least distance, in metres and combined with the depth noise, from a point of the mesh to the
surface that a frame sees behind it, for the point to lie in free space."""

LITTLE = 0.05
"""Share of the object's pixels, relative to the keyframe with most of them, below which a keyframe
adds nothing."""

PIECE = 0.01
"""Least area of a loose piece that counts, as a share of the largest piece's area."""

_POINTS = 20_000  # points that are compared: the shares get exact to half a percent
_NEAREST = 4  # faces whose distance is computed, of those with the nearest centres


class SeenView(NamedTuple):
    """A keyframe, in the form that is compared with the mesh.

    Attributes:
        depth: Depth image `[h w]`, in metres; 0 where nothing is known, infinite where the ray met
            nothing.
        segmented: Pixels that show the object `[h w]`.
        intrinsics: fx, fy, cx, cy, in pixels.
        T_object_camera: Camera to object `[4 4]`.
    """

    depth: Float[np.ndarray, "h w"]
    segmented: Bool[np.ndarray, "h w"]
    intrinsics: tuple[float, float, float, float]
    T_object_camera: Float[np.ndarray, "4 4"]


class Quality(NamedTuple):
    """Figures of a result that need no truth; shares are from 0 to 1.

    Attributes:
        explained: Share of the measured points of the object that the mesh explains within 1 cm and
            twice the depth's noise.
        measured: Share of the mesh's area on measured surface; NaN where this is not known.
        mirrored: Share of the area whose mirror image was measured, where the mesh was completed
            from it.
        predicted: Share of the area from the prior alone; NaN where this is not known.
        free_violated: Share of the area that a keyframe sees through.
        size: Extents of the mesh along the object's x, y and z `[3]`, in metres.
        floor_gap: Height of the mesh's lowest point above the floor, in metres; NaN where no floor
            is known.
        pieces: Number of disconnected pieces of the mesh, without crumbs.
        keyframes: Number of keyframes.
        empty_keyframes: Number of keyframes in which almost no pixel was taken for the object.
        unseen_faces: Names of the faces of its box where no keyframe saw the object end.
        unseen_below: Share of its height, from the bottom, in which nothing was measured.
    """

    explained: float
    measured: float
    mirrored: float
    predicted: float
    free_violated: float
    size: tuple[float, float, float]
    floor_gap: float
    pieces: int
    keyframes: int
    empty_keyframes: int
    unseen_faces: tuple[str, ...] = ()
    unseen_below: float = 0.0


class Verdict(NamedTuple):
    """A judgement in words.

    Attributes:
        word: "good", "doubtful" or "failed".
        reasons: Why, in sentences without capitals and full stops; empty for "good".
    """

    word: Literal["good", "doubtful", "failed"]
    reasons: tuple[str, ...]

    @property
    def sentence(self) -> str:
        """The word, and its reasons."""
        return f"{self.word} because {'; '.join(self.reasons)}" if self.reasons else self.word


# Figures ---------------------------------------------------------------------------------------


def quality_of(
    mesh: trimesh.Trimesh,
    measured: Bool[np.ndarray, " n"] | None,
    views: Sequence[SeenView],
    *,
    axial: float,
    is_mirrored: bool = False,
    floor: float = np.nan,
    unseen: Unseen = ALL_SEEN,
) -> Quality:
    """Compare a mesh with the keyframes it was made from.

    Args:
        mesh: The mesh in the object frame, in metres.
        measured: True for its vertices on measured surface; None where that is not known.
        views: The keyframes.
        axial: Standard deviation of depth, in metres at 1 m.
        is_mirrored: Whether hidden parts were completed from their mirror image.
        floor: Height of the floor in the object frame, in metres; NaN where it is not known.
        unseen: Parts of the object that no keyframe saw.
    """
    counts = np.array([view.segmented.sum() for view in views])
    return _of_mesh(mesh, measured, is_mirrored)._replace(
        explained=explained(mesh, views, axial),
        free_violated=free_violated(mesh, views, axial),
        floor_gap=float(mesh.bounds[0, 1] - floor),
        keyframes=len(views),
        empty_keyframes=int(np.sum(counts < LITTLE * max(counts.max(initial=0), 1))),
        unseen_faces=unseen.faces,
        unseen_below=unseen.below,
    )


def quality_of_cloud(
    mesh: trimesh.Trimesh,
    points: Float[np.ndarray, "n 3"],
    *,
    voxel: float,
    is_mirrored: bool = False,
    unseen: Unseen = ALL_SEEN,
) -> Quality:
    """Compare a mesh with the point cloud it was completed from.

    Args:
        mesh: The mesh in the object frame, in metres.
        points: The points, in the same frame.
        voxel: Largest edge of the voxels that the mesh was made from, in metres: mesh and points
            cannot be told apart at smaller distances.
        is_mirrored: Whether hidden parts were completed from their mirror image.
        unseen: Parts of the object of which the cloud shows nothing.

    Returns:
        The figures; nothing is known about free space and the floor.
    """
    close = max(CLOSE, voxel)
    measured = np.isfinite(KDTree(points).query(mesh.vertices, distance_upper_bound=close)[0])
    some = points[:: max(1, len(points) // _POINTS)]
    is_near = _distance(mesh, some) < close
    return _of_mesh(mesh, measured, is_mirrored)._replace(
        explained=float(np.mean(is_near)), unseen_faces=unseen.faces, unseen_below=unseen.below
    )


def _of_mesh(
    mesh: trimesh.Trimesh, measured: Bool[np.ndarray, " n"] | None, is_mirrored: bool
) -> Quality:
    """The figures of the mesh alone; all other figures are as if the mesh were right."""
    x, y, z = map(float, mesh.extents)
    of_area = _shares(mesh, measured, is_mirrored)
    return Quality(1.0, *of_area, 0.0, (x, y, z), np.nan, pieces(mesh), 0, 0)


def explained(mesh: trimesh.Trimesh, views: Sequence[SeenView], axial: float) -> float:
    """Share of the measured points of the object that lie on the mesh; 0 without points."""
    found = [_object_points(view) for view in views]
    points, depth = (np.concatenate(parts) for parts in zip(*found, strict=True))
    if len(points) == 0:
        return 0.0
    every = max(1, len(points) // _POINTS)
    points, noise = points[::every], 2 * axial * depth[::every] ** 2
    return float(np.mean(_distance(mesh, points) < np.hypot(CLOSE, noise)))


def free_violated(mesh: trimesh.Trimesh, views: Sequence[SeenView], axial: float) -> float:
    """Share of the mesh's area through which a keyframe sees a surface behind it."""
    centers, through = mesh.triangles_center, np.zeros(len(mesh.faces), bool)
    for view in views:
        through |= _sees_through(view, centers, axial)
    return float(mesh.area_faces @ through / max(mesh.area, 1e-12))


def pieces(mesh: trimesh.Trimesh) -> int:
    """Connected pieces of a mesh whose area is at least `PIECE` of the largest."""
    labels = trimesh.graph.connected_component_labels(mesh.edges, node_count=len(mesh.vertices))
    area = np.bincount(labels[mesh.faces[:, 0]], weights=mesh.area_faces)
    return int(np.sum(area > PIECE * area.max()))


# Words -----------------------------------------------------------------------------------------

# Shares of the points explained and of the area seen through, on the kitchen chair (every fourth
# frame): .93 and .01 with 3 keyframes and correct input, .80 and .03 with 8; .75 and .30 with a
# focal length 10 % too long; .93 and .33 with a depth scale 25 % too large; 1.0 and 0 with poses in
# millimetres, because 6 of 7 keyframes then hold nothing of the object.

FAILED, DOUBTFUL = 0.5, 0.75
"""Share of explained points below which a mesh has failed, and share below which it is doubtful."""

LITTLE_MEASURED = 0.12
"""Share of measured area below which a mesh comes from the prior rather than from the camera."""

MOSTLY_PREDICTED = 0.7
"""Share of predicted area above which a mesh is doubtful. Of 24 seats that were filmed by hand,
none has more than 0.65; a round stool with a wrong path of the camera, 15 cm off, has 0.72."""

SEEN_THROUGH, TORN = 0.1, 0.25
"""Share of the area that keyframes see through, from which a mesh is doubtful, and share from which
it has failed: poses, camera or depth scale are wrong."""

GAP = 0.05
"""Distance between the mesh and the floor, in metres, from which a part of the object is missing or
too much."""

ODD = 0.4, 2.6
"""Least and greatest size of an object, relative to the usual size of its class: the geometric mean
of the three ratios. A stool for children has 0.5, a sofa for three 2.2."""

SIZES = (0.05, 4.0)
"""Shortest and longest length of the longest side of an object in a room, in metres."""

GUESSED, ALL_GUESSED = 2, 4
"""Numbers of unseen sides of the box, where no keyframe saw the object end: from the first number
on, the object's size is doubtful; from the second on, it comes from the prior alone. One unseen
side is usual: the back of a chair that was filmed from the front was right to 4 cm."""

BARE, MOSTLY_BARE = 0.15, 0.4
"""Shares of the height, from the bottom, without a measurement: from the first share on, legs are
doubtful; from the second on, too little was seen, for example only the back of a chair behind a
table."""


def judged(quality: Quality, usual: tuple[float, float, float] | None = None) -> Verdict:
    """A verdict by fixed thresholds.

    Args:
        quality: Figures of a result.
        usual: Usual extents of its class along x, y and z, in metres; None where they are not
            known.
    """
    if failures := tuple(_failures(quality)):
        return Verdict("failed", failures)
    doubts = (*_doubts(quality), *(_odd_size(quality, usual) if usual else ()))
    return Verdict("doubtful" if doubts else "good", doubts)


def _failures(q: Quality) -> Iterator[str]:
    yield from _contradictions(q, FAILED, TORN)
    if not SIZES[0] <= max(q.size) <= SIZES[1]:
        yield f"the object would be {max(q.size):.2g} m large"
    if q.keyframes and 2 * q.empty_keyframes >= q.keyframes:
        yield f"in {q.empty_keyframes} of {q.keyframes} keyframes the object has almost no pixels"
    if len(_unseen_sides(q)) >= ALL_GUESSED:
        yield "the end of the object was not seen at any side"
    if q.unseen_below > MOSTLY_BARE:
        yield f"nothing was measured in its lower {q.unseen_below:.0%}"


def _doubts(q: Quality) -> Iterator[str]:
    yield from _contradictions(q, DOUBTFUL, SEEN_THROUGH)
    if q.measured < LITTLE_MEASURED:
        yield f"only {q.measured:.0%} of the mesh was measured"
    elif q.predicted > MOSTLY_PREDICTED:
        yield f"{q.predicted:.0%} of the mesh is predicted, not measured"
    if abs(q.floor_gap) > GAP:
        where = "above" if q.floor_gap > 0 else "below"
        yield f"its lowest point lies {100 * abs(q.floor_gap):.0f} cm {where} the floor"
    if q.pieces > 1:
        yield f"the mesh is in {q.pieces} pieces"
    if q.empty_keyframes:
        yield f"{q.empty_keyframes} of {q.keyframes} keyframes added almost nothing"
    if len(sides := _unseen_sides(q)) >= GUESSED:
        yield f"the end of the object was not seen at its {joined(sides)}"
    if q.unseen_below > BARE:
        yield f"its lower {q.unseen_below:.0%}, for example the legs, is predicted"


def _odd_size(q: Quality, usual: tuple[float, float, float]) -> Iterator[str]:
    times = float(np.exp(np.mean(np.log(q.size) - np.log(usual))))
    if not ODD[0] <= times <= ODD[1]:
        yield (
            f"it is {times:.2g} times as large as objects of its class usually are: the depth "
            "scale may be wrong (--depth-scale)"
        )


def _contradictions(q: Quality, explained: float, free_violated: float) -> Iterator[str]:
    """What mesh and measurement disagree about, from these shares on."""
    if q.explained < explained:
        yield f"the mesh explains only {q.explained:.0%} of the measured points of the object"
    if q.free_violated > free_violated:
        yield (
            f"{q.free_violated:.0%} of the mesh lies in space that was measured as free: some "
            "poses or the focal length are wrong, or the object was moved"
        )


def _unseen_sides(q: Quality) -> tuple[str, ...]:
    return tuple(face for face in q.unseen_faces if face not in ("bottom", "top"))


# Parts -----------------------------------------------------------------------------------------


def _shares(
    mesh: trimesh.Trimesh, measured: Bool[np.ndarray, " n"] | None, is_mirrored: bool
) -> tuple[float, float, float]:
    """Shares of the area that were measured, come from the mirror image, and are predicted."""
    if measured is None:
        return np.nan, 0.0, np.nan
    mirrored = np.zeros_like(measured)
    if is_mirrored and measured.any():
        images = mesh.vertices[~measured] * (-1.0, 1.0, 1.0)
        distance, _ = KDTree(mesh.vertices[measured]).query(images, distance_upper_bound=2 * CLOSE)
        mirrored[~measured] = np.isfinite(distance)
    area = mesh.area_faces / mesh.area
    one, other = (float(flag[mesh.faces].mean(axis=1) @ area) for flag in (measured, mirrored))
    return one, other, 1 - one - other


def _object_points(view: SeenView) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Points of the object in a keyframe, in the object frame, and their depth."""
    row, column = np.nonzero(view.segmented & (view.depth > 0) & np.isfinite(view.depth))
    fx, fy, cx, cy = view.intrinsics
    z = view.depth[row, column].astype(np.float64)
    p = np.stack([(column + 0.5 - cx) / fx * z, (row + 0.5 - cy) / fy * z, z], axis=-1)
    return p @ view.T_object_camera[:3, :3].T + view.T_object_camera[:3, 3], z


def _distance(mesh: trimesh.Trimesh, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Distance of points from the nearest of some faces whose centres are near."""
    count = min(_NEAREST, len(mesh.faces))
    _, index = KDTree(mesh.triangles_center).query(points, k=count)
    faces = mesh.triangles[index.reshape(-1)]
    closest = trimesh.triangles.closest_point(faces, points.repeat(count, axis=0))
    away = np.linalg.norm(closest.reshape(-1, count, 3) - points[:, None], axis=-1)
    return away.min(axis=-1)


def _sees_through(
    view: SeenView, points: Float[np.ndarray, "n 3"], axial: float
) -> Bool[np.ndarray, " n"]:
    """Whether all pixels around a point measured something clearly behind it."""
    known = np.where(view.depth > 0, view.depth, 0)
    nearest = ndimage.minimum_filter(known, 3)  # 0 beside unknown pixels, which give no evidence
    T = np.linalg.inv(view.T_object_camera)
    x, y, z = (points @ T[:3, :3].T + T[:3, 3]).T
    fx, fy, cx, cy = view.intrinsics
    with np.errstate(divide="ignore", invalid="ignore"):
        column, row = np.floor(fx * x / z + cx), np.floor(fy * y / z + cy)
    h, w = known.shape
    inside = (z > 0) & (column >= 0) & (column < w) & (row >= 0) & (row < h)
    through = np.zeros(len(points), bool)
    behind = nearest[row[inside].astype(int), column[inside].astype(int)]
    through[inside] = behind > z[inside] + np.hypot(THROUGH, 3 * axial * z[inside] ** 2)
    return through
