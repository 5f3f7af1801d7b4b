"""Whether the poses of a recording fit its depth images."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxshape.data.sequences.frames import USUAL_DEPTH_SCALES, Sequence, SequenceError

Pose = Float[np.ndarray, "4 4"]


class PoseAgreement(NamedTuple):
    """Share of depth pixels which a neighbouring frame sees at the same place.

    Attributes:
        as_given: Share with the poses as given, from 0 to 1.
        inverted: Share with each pose inverted, from 0 to 1.
        pairs: Pairs of frames that were compared; the shares are 0 if there were none.
    """

    as_given: float
    inverted: float
    pairs: int


def poses_look_inverted(sequence: Sequence) -> bool:
    """Whether the depth images agree better if each pose is taken as world to camera.

    Evidence, not proof: it needs overlapping frames between which the camera moved, and a scene
    that is more than one plane the camera slides along. Where it cannot tell, the answer is False.
    """
    return looks_inverted(pose_agreement(sequence))


def looks_inverted(agreement: PoseAgreement) -> bool:
    """Whether an agreement is clearly better with inverted poses."""
    return agreement.inverted > agreement.as_given + 0.1


def pose_agreement(sequence: Sequence, *, pairs: int = 8) -> PoseAgreement:
    """Compare frames from all over a sequence with near ones, under both readings of the poses.

    Frames without a pose, or that cannot be read, are passed over.
    """
    K, shares = sequence.intrinsics, []
    for first, second, motions in _telling_pairs(sequence, pairs):
        with suppress(SequenceError):  # damaged; whoever uses the frame will hear of it
            a, b = sequence.read_depth(first), sequence.read_depth(second)
            shares.append([_same_surface(a, b, K, T_b_a) for T_b_a in motions])
    as_given, inverted = np.mean(shares, axis=0) if shares else (0.0, 0.0)
    return PoseAgreement(float(as_given), float(inverted), len(shares))


def scale_agreement(sequence: Sequence) -> dict[float, float]:
    """Share of depth pixels on which neighbours agree, at its own and the other usual depth scales.

    Poses have a scale of their own, so that of the depth images has to be the same. A scale at
    which no pair of frames is plausible is left out.
    """
    scales = {sequence.depth_scale, *USUAL_DEPTH_SCALES}
    rescaled = {s: pose_agreement(replace(sequence, depth_scale=s)) for s in sorted(scales)}
    return {scale: found.as_given for scale, found in rescaled.items() if found.pairs}


def _telling_pairs(sequence: Sequence, count: int) -> Iterator[tuple[int, int, tuple[Pose, Pose]]]:
    """Frames from all over, each with the next, of 30, that tells, and both readings of T_b_a."""
    for first in np.unique(np.linspace(0, len(sequence) - 1, count, dtype=int)):
        T_a = _pose(sequence, int(first))
        for second in range(first + 1, min(first + 31, len(sequence)) if T_a is not None else 0):
            if T_a is not None and (T_b := _pose(sequence, second)) is not None:
                if _tells(motions := _motions(T_a, T_b)):
                    yield int(first), second, motions
                    break


def _pose(sequence: Sequence, index: int) -> Pose | None:
    with suppress(SequenceError):
        return sequence.read_pose(index)
    return None


def _motions(T_a: Pose, T_b: Pose) -> tuple[Pose, Pose]:
    """Return T_b_a if the poses map camera to world, and T_b_a if they map world to camera."""
    return np.linalg.inv(T_b) @ T_a, T_b @ np.linalg.inv(T_a)


def _tells(motions: tuple[Pose, Pose]) -> bool:
    """Whether two readings of a motion differ by 10 cm at 2 m."""
    given, inverted = motions
    return float(np.linalg.norm((given - inverted) @ (0.0, 0.0, 2.0, 1.0))) > 0.1


def _same_surface(
    depth_a: Float[np.ndarray, "h w"],
    depth_b: Float[np.ndarray, "h w"],
    K: Float[np.ndarray, "3 3"],
    T_b_a: Pose,
) -> float:
    """Share of the valid pixels of `a` which, moved to `b`, lie within 3 % of its depth."""
    step = max(1, depth_a.shape[1] // 80)
    row, column = np.nonzero(depth_a[::step, ::step])
    row, column = row * step, column * step
    pixel = np.stack([column + 0.5, row + 0.5, np.ones(len(row))])
    p_a = np.linalg.inv(K) @ pixel * depth_a[row, column]
    p_b = T_b_a[:3, :3] @ p_a + T_b_a[:3, 3:]
    u, v, z = K @ p_b
    with np.errstate(divide="ignore", invalid="ignore"):
        column, row = np.floor(u / z), np.floor(v / z)
    h, w = depth_b.shape
    seen = (z > 0) & (column >= 0) & (column < w) & (row >= 0) & (row < h)
    measured = depth_b[row[seen].astype(int), column[seen].astype(int)]
    return float(np.sum(np.abs(measured - z[seen]) < 0.03 * z[seen]) / max(len(z), 1))
