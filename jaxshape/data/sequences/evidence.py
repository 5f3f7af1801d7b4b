"""Agreement of poses and depth images: whether neighbouring frames show a surface in one place."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxshape.data.sequences.conventions import our_depth, our_pose
from jaxshape.data.sequences.frames import Sequence, SequenceError, is_measured, read_raw_depth
from jaxshape.data.sequences.poses import StoredByColumns

Pose = Float[np.ndarray, "4 4"]

TOLERANCE = 0.02
"""Relative difference of depth up to which two frames see the same surface."""

STRIDES = (1, 2, 4, 8, 16, 30, 60)
"""Distances between the frames of a pair; the first one with clear motion is used."""

MOVED, HARDLY_MOVED = 0.5, 0.85
"""Thresholds on the agreement that a pair would have without motion: below the first, its motion is
clear; below the second, it is used if the recording has no pair with clear motion."""


class Pair(NamedTuple):
    """Two frames of a recording between which the camera moved, as they are written.

    Attributes:
        depth_a: Depth of the first frame `[h w]`, in metres; 0 where nothing was measured.
        depth_b: Depth of the second frame, in the same form.
        T_a: Pose of the first frame `[4 4]`, as it is written.
        T_b: Pose of the second frame, in the same form.
        K_a: Camera matrix of the first frame `[3 3]`, in pixels.
        K_b: Camera matrix of the second frame, in the same form.
        by_columns: Whether the matrices are stored by columns, and were transposed as a whole.
    """

    depth_a: Float[np.ndarray, "h w"]
    depth_b: Float[np.ndarray, "h w"]
    T_a: Pose
    T_b: Pose
    K_a: Float[np.ndarray, "3 3"]
    K_b: Float[np.ndarray, "3 3"]
    by_columns: bool


class ConvertedPair(NamedTuple):
    """A pair whose depth images are in our convention.

    Attributes:
        points: Points of the first frame, in its camera `[3 n]`.
        depth: Depth of the second frame `[h w]`.
        pair: The pair.
    """

    points: Float[np.ndarray, "3 n"]
    depth: Float[np.ndarray, "h w"]
    pair: Pair


def telling_pairs(sequence: Sequence, *, count: int = 8) -> tuple[Pair, ...]:
    """Pairs of frames, spread over a recording, between which the camera clearly moved.

    Only the depth images decide whether it moved, independent of the convention of the poses.
    Frames that have no pose, or cannot be read, are skipped.

    Args:
        sequence: The recording; its poses and depth images are taken as they are written.
        count: Number of pairs to look for, 1 or more.
    """
    read = lru_cache(maxsize=2)(lambda index: _depth(sequence, index))
    firsts = np.unique(np.linspace(0, max(0, len(sequence) - 2), count, dtype=int))
    found = [_most_telling(sequence, int(first), read) for first in firsts]
    clear = [pair for still, pair in filter(None, found) if still < MOVED]
    return tuple(clear or [pair for _, pair in filter(None, found)])


def _most_telling(
    sequence: Sequence, first: int, read: Callable[[int], Float[np.ndarray, "h w"] | None]
) -> tuple[float, Pair] | None:
    """Pair with the nearest frame with clear motion, otherwise with the frame with most motion, and
    the share of pixels that did not move."""
    a, pose_a, best = read(first), _pose(sequence, first), None
    if a is None or pose_a is None:
        return None
    K_a = sequence.camera_of(first)
    points = _points(a, K_a)
    for second in (first + stride for stride in STRIDES if first + stride < len(sequence)):
        b, pose_b = read(second), _pose(sequence, second)
        if b is None or pose_b is None:
            continue
        K_b = sequence.camera_of(second)
        still = _same_surface(points, b, K_b, np.eye(4), TOLERANCE)
        if still < (HARDLY_MOVED if best is None else best[0]):
            is_turned = pose_a[1] or pose_b[1]
            best = still, Pair(a, b, pose_a[0], pose_b[0], K_a, K_b, is_turned)
        if still < MOVED:
            break
    return best


def _depth(sequence: Sequence, index: int) -> Float[np.ndarray, "h w"] | None:
    """A depth image at the depth scale of the recording, even if implausible; None if damaged."""
    with suppress(SequenceError):  # reading the frame reports it
        raw = read_raw_depth(sequence.files[index].depth, sequence.shape)
        valid = is_measured(raw)
        depth = np.where(valid, raw / sequence.depth_scale, 0)
        if sequence.correct_depth is not None:
            depth = sequence.correct_depth(depth, sequence.camera_of(index))
        return depth if valid.any() else None
    return None


def _pose(sequence: Sequence, index: int) -> tuple[Pose, bool] | None:
    """A pose, and whether it is stored by columns; None without one."""
    try:
        T = sequence.read_pose(index)
    except StoredByColumns as stored:
        return stored.T, True
    except SequenceError:
        return None
    return None if T is None else (np.asarray(T, np.float64), False)


def stored_by_columns(sequence: Sequence) -> bool:
    """Whether one of some sampled poses of the recording is a matrix stored by columns."""
    some = np.unique(np.linspace(0, len(sequence) - 1, 8, dtype=int))
    poses = (_pose(sequence, int(index)) for index in some)
    return any(pose is not None and pose[1] for pose in poses)


def seen_by(pairs: tuple[Pair, ...], names: tuple[str, ...] = ()) -> tuple[ConvertedPair, ...]:
    """The pairs with depth images converted from these conventions.

    Args:
        pairs: The pairs.
        names: Names of conventions; pose conventions are ignored.
    """

    def both() -> Iterator[ConvertedPair]:
        for pair in pairs:
            a = our_depth(pair.depth_a, pair.K_a, names)
            yield ConvertedPair(
                _points(a, pair.K_a), our_depth(pair.depth_b, pair.K_b, names), pair
            )

    return tuple(both())


def agreement(
    seen: tuple[ConvertedPair, ...],
    names: tuple[str, ...] = (),
    *,
    longer: float = 1.0,
    tolerance: float = TOLERANCE,
) -> float:
    """Mean share, over pairs, of the pixels that the second frame sees in the same place.

    The share is over pixels at which the second frame measured something, but over at least half of
    all pixels, so that poses which turn the camera away gain nothing.

    Args:
        seen: The pairs, with depth images in our convention.
        names: Names of conventions from which the poses are converted.
        longer: Factor on the depth scale, by which the depths are divided.
        tolerance: Relative difference of depth up to which two frames see the same surface.

    Returns:
        From 0 to 1; 0 without a pair.
    """
    shares = []
    for points, depth, pair in seen:
        undo = tuple(name for name in names if not (pair.by_columns and name == "transposed"))
        T_b_a = np.linalg.inv(our_pose(pair.T_b, undo)) @ our_pose(pair.T_a, undo)
        T_b_a[:3, 3] *= longer  # instead of dividing all depths by it
        shares.append(_same_surface(points, depth, pair.K_b, T_b_a, tolerance))
    return float(np.mean(shares)) if shares else 0.0


def _points(depth: Float[np.ndarray, "h w"], K: Float[np.ndarray, "3 3"]):
    """A sample of the points of a depth image, in its camera frame `[3 n]`."""
    step = max(1, depth.shape[1] // 40)
    row, column = np.nonzero(depth[step // 2 :: step, step // 2 :: step])
    row, column = row * step + step // 2, column * step + step // 2
    pixel = np.stack([column + 0.5, row + 0.5, np.ones(len(row))])
    return np.linalg.inv(K) @ pixel * depth[row, column]


def _same_surface(
    points: Float[np.ndarray, "3 n"],
    depth_b: Float[np.ndarray, "h w"],
    K: Float[np.ndarray, "3 3"],
    T_b_a: Pose,
    tolerance: float,
) -> float:
    """Share of the points of `a` that, moved to `b`, are within the tolerance of its depth."""
    u, v, z = K @ (T_b_a[:3, :3] @ points + T_b_a[:3, 3:])
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        column, row = np.floor(u / z), np.floor(v / z)
    h, w = depth_b.shape
    seen = (z > 0) & (column >= 0) & (column < w) & (row >= 0) & (row < h)
    measured, z = depth_b[row[seen].astype(int), column[seen].astype(int)], z[seen]
    same = (measured > 0) & (np.abs(measured - z) < tolerance * z)
    return float(np.sum(same) / max(np.sum(measured > 0), points.shape[1] / 2, 1))
