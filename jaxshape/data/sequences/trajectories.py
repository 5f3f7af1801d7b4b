"""Trajectories in files: TUM's, Open3D's `.log` and `.json`, read and written."""

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from jaxshape import limits, reading
from jaxshape.data.sequences.frames import SequenceError
from jaxshape.data.sequences.poses import check_rigid, is_rigid
from jaxshape.data.sequences.text import number, words_of
from jaxshape.files import write_text


class Trajectory(NamedTuple):
    """Poses of a camera over time.

    Attributes:
        T_world_camera: Camera to world `[n 4 4]`, rigid, in metres.
        frames: Index of the frame, from 0, to which each pose belongs `[n]`.
        times: Time of each pose `[n]`, in seconds; None if only the frames are known.
    """

    T_world_camera: Float[np.ndarray, "n 4 4"]
    frames: Int[np.ndarray, " n"]
    times: Float[np.ndarray, " n"] | None = None


class Pinhole(NamedTuple):
    """The camera of a trajectory in a `.json` file.

    Attributes:
        intrinsics: Camera matrix `[3 3]`, in pixels, where column j covers u in [j, j + 1).
        shape: Height and width of the images, in pixels.
    """

    intrinsics: Float[np.ndarray, "3 3"]
    shape: tuple[int, int]


def read_trajectory(path: str | Path) -> Trajectory:
    """Read a trajectory in the format of the file's suffix. [host]

    - `.log` (Redwood, Open3D): a line `frame frame frames`, then the 4x4 camera to world.
    - `.json` (Open3D's PinholeCameraTrajectory): 4x4 world to camera, by columns.
    - Other files are in TUM's format: `time tx ty tz qx qy qz qw`, camera to world, a pose on each
      line. Its poses are numbered in their order.

    Poses with NaN, which some programs write where tracking was lost, are left out.

    Args:
        path: The file to read.

    Returns:
        The poses, checked, with the numbers of their frames and, in the TUM format, their times.

    Raises:
        SequenceError: The file cannot be read, or a pose is not a rigid motion.
    """
    trajectory = read_unchecked(Path(path))
    T = trajectory.T_world_camera
    finite = np.isfinite(T).all(axis=(1, 2))
    is_near = (np.abs(T[:, :3, 3]) <= limits.FAR).all(axis=-1)
    for bad in np.flatnonzero(finite & ~(is_rigid(T) & is_near)):
        check_rigid(T[bad], f"Pose {bad} of {path}")
    times = None if trajectory.times is None else trajectory.times[finite]
    return Trajectory(T[finite], trajectory.frames[finite], times)


def read_unchecked(path: Path) -> Trajectory:
    """Read a trajectory like `read_trajectory`, but keep poses that are lost or not rigid."""
    read = {".log": _read_log, ".json": _read_json}.get(path.suffix.lower(), _read_tum)
    try:
        return read(reading.read_text(path))
    except (OSError, ValueError, KeyError, TypeError, IndexError, OverflowError) as error:
        raise SequenceError(
            f"{path} cannot be read as a trajectory ({type(error).__name__}: {error}); expected "
            "TUM's `time tx ty tz qx qy qz qw`, or Open3D's .log or .json: write it again."
        ) from error


def write_trajectory(
    path: str | Path, trajectory: Trajectory, camera: Pinhole | None = None
) -> None:
    """Write a trajectory in the format of the suffix; `read_trajectory` reads it. [host]

    Args:
        path: The file to write: `.log` or `.json` (Open3D), any other for TUM's format.
        trajectory: The poses; without times, TUM's format gets the indices of the frames instead.
        camera: The camera, which `.json` needs; None for the other formats.

    Raises:
        ValueError: A `.json` file is requested without a camera.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".json" and camera is None:
        raise ValueError(
            f"{path} has no camera; Open3D's .json holds the camera of each pose: give the "
            "camera, or write a .log file."
        )
    if suffix == ".json" and camera is not None:
        text = _json_text(trajectory, camera)
    else:
        text = _log_text(trajectory) if suffix == ".log" else _tum_text(trajectory)
    write_text(path, text)


# TUM -------------------------------------------------------------------------------------------


def _read_tum(text: str) -> Trajectory:
    lines = words_of(text)
    for line, words in lines:
        if len(words) != 8:
            euroc = "; of a EuRoC file, keep the first eight columns and put w last"
            hint = euroc if len(words) == 17 else ""
            raise ValueError(f"line {line} holds {len(words)} numbers, not 8{hint}")
    numbers = np.array([[number(w) for w in words] for _, words in lines], dtype=np.float64)
    numbers = numbers.reshape(-1, 8)
    quaternions = numbers[:, 4:]
    with np.errstate(over="ignore"):
        norms = np.linalg.norm(quaternions, axis=1)
    known = np.isfinite(numbers).all(axis=1)
    if (known & (np.abs(norms - 1) > 1e-2)).any():
        bad = int(np.flatnonzero(known & (np.abs(norms - 1) > 1e-2))[0])
        raise ValueError(f"pose {bad} has a quaternion of length {norms[bad]:.3g}, not 1")
    T = np.full((len(numbers), 4, 4), np.nan)
    T[known] = np.eye(4)
    if known.any():
        T[known, :3, :3] = Rotation.from_quat(quaternions[known]).as_matrix()
        T[known, :3, 3] = numbers[known, 1:4]
    return Trajectory(T, np.arange(len(T)), numbers[:, 0])


def _tum_text(trajectory: Trajectory) -> str:
    T = trajectory.T_world_camera
    times = trajectory.frames if trajectory.times is None else trajectory.times
    quaternions = Rotation.from_matrix(T[:, :3, :3]).as_quat() if len(T) else np.zeros((0, 4))
    lines = [
        f"{time:.6f} " + " ".join(f"{value:.9g}" for value in (*pose[:3, 3], *quaternion))
        for time, pose, quaternion in zip(times, T, quaternions, strict=True)
    ]
    return "\n".join(["# time tx ty tz qx qy qz qw", *lines]) + "\n"


# Open3D ----------------------------------------------------------------------------------------


def _read_log(text: str) -> Trajectory:
    words = [words for _, words in words_of(text)]
    if len(words) % 5:
        raise ValueError(f"it holds {len(words)} lines, not five for each pose")
    T = np.array(
        [[[number(w) for w in row] for row in words[i + 1 : i + 5]] for i in _fifth(words)]
    )
    if len(T) and T.shape[1:] != (4, 4):
        raise ValueError(f"its matrices are {T.shape[1]} x {T.shape[2]}, not 4 x 4")
    frames = np.array([int(words[i][0]) for i in _fifth(words)], dtype=int)
    if (np.diff(frames) <= 0).any():  # not indices of frames, but e.g. of fragments
        frames = np.arange(len(frames))
    return Trajectory(T.reshape(-1, 4, 4), frames)


def _fifth(lines: list[Any]) -> range:
    return range(0, len(lines), 5)


def _log_text(trajectory: Trajectory) -> str:
    lines = []
    for frame, T in zip(trajectory.frames, trajectory.T_world_camera, strict=True):
        lines.append(f"{frame} {frame} {frame + 1}")
        lines.extend(" ".join(f"{value:.9g}" for value in row) for row in T)
    return "".join(line + "\n" for line in lines)


def _read_json(text: str) -> Trajectory:
    parameters = reading.parse_json(text)["parameters"]
    by_columns = [_extrinsic(i, one["extrinsic"]) for i, one in enumerate(parameters)]
    T_camera_world = np.swapaxes(np.reshape(by_columns, (-1, 4, 4)), 1, 2)
    finite = np.isfinite(T_camera_world).all(axis=(1, 2))
    T = np.full_like(T_camera_world, np.nan)
    T[finite] = np.linalg.inv(T_camera_world[finite])  # a singular one raises a ValueError
    return Trajectory(T, np.arange(len(T)))


def _extrinsic(index: int, value: Any) -> Float[np.ndarray, "4 4"]:
    try:
        return reading.numbers_of(value, (4, 4))
    except ValueError as error:
        raise ValueError(f"the extrinsic of pose {index}: {error}") from None


def _json_text(trajectory: Trajectory, camera: Pinhole) -> str:
    K = camera.intrinsics.copy()
    K[:2, 2] -= 0.5  # Open3D's coordinates start at the centre of the first pixel
    intrinsic = {
        "height": camera.shape[0],
        "intrinsic_matrix": K.T.ravel().tolist(),
        "width": camera.shape[1],
    }
    version = {"version_major": 1, "version_minor": 0}
    parameters = [
        {
            "class_name": "PinholeCameraParameters",
            "extrinsic": np.linalg.inv(T).T.ravel().tolist(),
            "intrinsic": intrinsic,
            **version,
        }
        for T in trajectory.T_world_camera
    ]
    content = {"class_name": "PinholeCameraTrajectory", "parameters": parameters, **version}
    return json.dumps(content, indent=1) + "\n"
