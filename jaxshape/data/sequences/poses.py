"""Poses of a recording: matrices in files, checks that they are rigid, and interpolation in
time."""

from collections.abc import Callable
from itertools import chain
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation, Slerp

from jaxshape import limits, reading
from jaxshape.data.sequences.frames import SequenceError
from jaxshape.data.sequences.text import number, words_of

READABLE_GAP = 0.1
"""Largest time between two poses, in seconds, for linear interpolation of the camera's path."""

NEAR = 0.02
"""Largest difference, in seconds, of two readings of the same moment, as in TUM's own tools."""


class StoredByColumns(SequenceError):
    """A pose becomes a rigid motion when it is transposed, which cannot happen by chance.

    Attributes:
        T: The pose, transposed `[4 4]`.
    """

    def __init__(self, sentence: str, T: Float[np.ndarray, "4 4"]) -> None:
        super().__init__(sentence)
        self.T = T


def read_matrix(path: Path, size: int) -> Float[np.ndarray, "n n"]:
    """Read a square matrix of `size` rows; `SequenceError` if the file has another form.

    Comments and commas are ignored. All numbers may stand in one line, and a pose may lack its last
    row, 0 0 0 1.
    """
    try:
        rows = [[number(word) for word in words] for _, words in words_of(reading.read_text(path))]
        counts = [len(row) for row in rows]
        is_short = size == 4 and counts in ([4] * 3, [12])
        if not is_short and counts not in ([size] * size, [size**2]):
            raise ValueError(f"its lines hold {counts} numbers")
        numbers = [*chain(*rows), *[0, 0, 0, 1] * is_short]
        matrix = np.array(numbers, dtype=np.float64).reshape(size, size)
    except (OSError, ValueError) as error:
        raise SequenceError(
            f"{path} is not a matrix ({error}); expected {size} lines of {size} numbers: write it "
            "again."
        ) from error
    return matrix


def read_pose(path: Path | None) -> Float[np.ndarray, "4 4"] | None:
    """Read a 4x4 rigid motion; None without a file, or if it contains NaN or infinity.

    7-Scenes writes NaN where its tracking was lost.
    """
    if path is None:
        return None
    return known(read_matrix(path, 4), path)


def known(T: Float[np.ndarray, "4 4"], source: object) -> Float[np.ndarray, "4 4"] | None:
    """A checked pose; None if it is not finite, which recorders write when tracking is lost."""
    if not np.isfinite(T).all():
        return None
    check_rigid(T, source)
    return T


def is_rigid(T: Float[np.ndarray, "*batch 4 4"]) -> Bool[np.ndarray, "*batch"]:
    """Whether matrices are rigid motions, up to eight digits and rounding."""
    R = T[..., :3, :3]
    with np.errstate(invalid="ignore", over="ignore"):
        last = np.abs(T[..., 3, :] - (0, 0, 0, 1)).max(axis=-1) <= 1e-6
        orthonormal = _stretch(R) <= 1e-2
        return np.asarray(last & orthonormal & (np.linalg.det(R) > 0))


def check_rigid(T: Float[np.ndarray, "4 4"], source: object) -> None:
    """Raise `SequenceError`, naming `source`, unless a matrix is a rigid motion."""
    if is_rigid(T):
        if (far := float(np.abs(T[:3, 3]).max())) > limits.FAR:
            raise SequenceError(
                f"{source} lies {far:.3g} from the origin; expected metres, {limits.FAR:g} at "
                "most: write it again."
            )
        return
    if is_rigid(T.T):
        raise StoredByColumns(
            f"{source} has the last row {T[3].tolist()} and the last column 0 0 0 1, so it is "
            "stored by columns; expected a rigid motion with the last row 0 0 0 1: transpose it, "
            "or add --convention transposed.",
            T.T,
        )
    if not np.isfinite(T).all():
        fault, remedy = "holds NaN or infinity", "remove it, if the camera was lost there"
    elif np.abs(T[3] - (0, 0, 0, 1)).max() > 1e-6:
        fault = f"has the last row {T[3].tolist()}"
        remedy = "transpose it if it is stored by columns"
    elif (stretch := _stretch(T[:3, :3])) > 1e-2:
        fault = f"has axes that are not orthonormal (R^T R differs from I by {stretch:.2g})"
        remedy = "divide out its scale, or remove the frame"
    else:
        fault = "mirrors (its determinant is negative)"
        remedy = "change the sign of one axis of the frame it maps to or from"
    raise SequenceError(
        f"{source} {fault}; expected a rigid motion with the last row 0 0 0 1: {remedy}."
    )


def _stretch(R: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch"]:
    with np.errstate(invalid="ignore", over="ignore"):
        return np.asarray(np.abs(np.swapaxes(R, -1, -2) @ R - np.eye(3)).max(axis=(-2, -1)))


def poses_at(
    times: Float[np.ndarray, " n"], T: Float[np.ndarray, "n 4 4"], wanted: Float[np.ndarray, " m"]
) -> Callable[[int], Float[np.ndarray, "4 4"] | None]:
    """Poses of a trajectory at other times: a function of the index into `wanted`.

    `times` increase. Between two poses at most `READABLE_GAP` apart, the position is interpolated
    linearly and the rotation along its geodesic. Otherwise the nearest pose is used if it is within
    `NEAR`; if not, there is none.
    """
    later = np.clip(np.searchsorted(times, wanted), 1, max(len(times) - 1, 1))

    def pose(index: int) -> Float[np.ndarray, "4 4"] | None:
        time, last = wanted[index], min(later[index], len(times) - 1)
        a, b = max(last - 1, 0), last
        if a < b and times[a] < time < times[b] <= times[a] + READABLE_GAP:
            return _between(T[a], T[b], float((time - times[a]) / (times[b] - times[a])))
        nearest = a if abs(times[a] - time) <= abs(times[b] - time) else b
        return T[nearest] if abs(times[nearest] - time) <= NEAR else None

    return pose


def _between(
    T_a: Float[np.ndarray, "4 4"], T_b: Float[np.ndarray, "4 4"], share: float
) -> Float[np.ndarray, "4 4"]:
    T = np.eye(4)
    turn = Slerp([0.0, 1.0], Rotation.from_matrix(np.stack([T_a[:3, :3], T_b[:3, :3]])))
    T[:3, :3] = turn(share).as_matrix()
    T[:3, 3] = (1 - share) * T_a[:3, 3] + share * T_b[:3, 3]
    return T


def from_opengl(T: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 4 4"]:
    """Convert poses of cameras with y up and z backwards (OpenGL, Blender, ARKit) into ours."""
    return T * np.array([1.0, -1.0, -1.0, 1.0])


def from_quaternions(
    places: Float[np.ndarray, "n 3"], quaternions: Float[np.ndarray, "n 4"], source: object
) -> Float[np.ndarray, "n 4 4"]:
    """Poses from positions and quaternions x y z w; NaN where they are not finite."""
    T = np.full((len(places), 4, 4), np.nan)
    finite = np.isfinite(places).all(axis=1) & np.isfinite(quaternions).all(axis=1)
    with np.errstate(over="ignore"):
        lengths = np.linalg.norm(quaternions, axis=1)
    if (bad := np.flatnonzero(finite & (np.abs(lengths - 1) > 1e-2))).size:
        raise SequenceError(
            f"{source}: pose {bad[0]} has a quaternion of length {lengths[bad[0]]:.3g}; expected "
            "x y z w of length 1: write it again."
        )
    T[finite] = np.eye(4)
    if finite.any():
        T[finite, :3, :3] = Rotation.from_quat(quaternions[finite]).as_matrix()
        T[finite, :3, 3] = places[finite]
    return T
