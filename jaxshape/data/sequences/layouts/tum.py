"""TUM RGB-D (Sturm et al., IROS 2012): lists of images and poses, each with its time."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxshape import reading
from jaxshape.data.sequences.cameras import PRIMESENSE, DefaultCamera
from jaxshape.data.sequences.documents import below
from jaxshape.data.sequences.frames import Finding, FrameFiles, SequenceError
from jaxshape.data.sequences.listing import (
    Contents,
    Listed,
    color_images,
    list_folder,
    mask_images,
    partners,
    with_colors_by_time,
)
from jaxshape.data.sequences.poses import READABLE_GAP, known, poses_at
from jaxshape.data.sequences.trajectories import read_trajectory

_CALIBRATED = {
    "1": ((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": ((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": ((535.4, 539.2, 320.1, 247.6), ()),
}
"""fx, fy, cx, cy of the benchmark's colour cameras, to which depth is registered, and the
distortion of their lenses."""

_ASSOCIATED = re.compile(r"^(\S+\.\w+)\s+[\d.]+\s+\S+\.\w+$")


def fits(contents: Contents) -> bool:
    return "depth.txt" in contents.files


def list_frames(contents: Contents) -> Listed:
    """`depth.txt`, and optionally `rgb.txt` and `groundtruth.txt`, with the same clock.

    Each depth image gets the colour image nearest in time, or without `rgb.txt` the one of the same
    name, and a pose interpolated between the poses before and after it.
    """
    folder = contents.folder
    times, depth = _read_list(folder / "depth.txt")
    if not depth:
        raise SequenceError(
            f"{folder / 'depth.txt'} lists no image; expected lines of `time file`: write them."
        )
    names = [path.stem for path in depth]
    color, delays = partners(names, color_images(contents)), None
    if "rgb.txt" in contents.files:
        color, delays = with_colors_by_time(times, *_read_list(folder / "rgb.txt"))
    read_pose, doubts = _poses(folder / "groundtruth.txt", times)
    masks = partners(names, mask_images(contents))
    return Listed(
        files=tuple(map(FrameFiles, names, depth, color, masks)),
        depth_scale=5000.0,
        read_pose=read_pose,
        times=times,
        color_delays=delays,
        camera=_camera_of(folder),
        findings=(*doubts, *_unlisted(depth)),
    )


def _read_list(path: Path) -> tuple[Float[np.ndarray, " n"], list[Path]]:
    """Sorted times, and images, of lines `time file`; a few lines may be in another order.

    Of lines `time file time file`, as `associate.py` of the benchmark writes them, the first half
    is read.
    """
    try:
        lines = enumerate(map(str.strip, reading.read_text(path).splitlines()), 1)
        pairs = [_listed(line, i) for i, line in lines if line and not line.startswith("#")]
        if not np.isfinite([time for time, _ in pairs]).all():
            raise ValueError("a time is not finite")
    except (OSError, ValueError, IndexError) as error:
        raise SequenceError(
            f"{path} is not a list of images ({error}); expected lines of `time file`: write it "
            "again."
        ) from error
    check_rising(np.array([time for time, _ in pairs]), path)
    pairs = sorted(pairs)
    return np.array([time for time, _ in pairs]), [
        below(path.parent, file, path) for _, file in pairs
    ]


def _listed(line: str, number: int) -> tuple[float, str]:
    """The time and the file of a line."""
    time, *file = line.split(maxsplit=1)
    if not file:
        raise ValueError(f"line {number} has no file: {line[:40]!r}")
    return float(time), _ASSOCIATED.sub(r"\1", file[0])


def _unlisted(depth: list[Path]) -> tuple[Finding, ...]:
    """A remark on depth images beside those of the list."""
    beside = depth[0].parent
    if not beside.is_dir():
        return ()
    files = [name for name in list_folder(beside).files if name.endswith(depth[0].suffix)]
    if (count := len(set(files) - {path.name for path in depth})) == 0:
        return ()
    return (
        Finding(
            f"{count} of {len(files)} images in {beside.name}/ are not listed in depth.txt",
            "They are left out; list them, if they belong to the recording.",
        ),
    )


def check_rising(times: Float[np.ndarray, " n"], path: Path) -> None:
    """Raise `SequenceError` if over a tenth of the times do not rise, as with intervals."""
    still = np.flatnonzero(np.diff(times) <= 0)
    if len(still) > 0.1 * len(times):
        first = times[still[0]], times[still[0] + 1]
        raise SequenceError(
            f"{path} has {len(still)} times that do not rise, {first[0]:.3f} and then "
            f"{first[1]:.3f} among them; expected increasing seconds since one start, not "
            "intervals between frames: write their sums, or sort the lines."
        )


def _poses(
    path: Path, times: Float[np.ndarray, " n"]
) -> tuple[Callable[[int], Float[np.ndarray, "4 4"] | None] | None, tuple[Finding, ...]]:
    """Poses at the times of the depth images; if the times never overlap, no poses but a remark."""
    if not path.is_file():
        return None, ()
    trajectory = read_trajectory(path)
    if trajectory.times is None or len(trajectory.times) == 0:
        return None, ()
    check_rising(trajectory.times, path)
    first, last = trajectory.times.min(), trajectory.times.max()
    if first > times[-1] + READABLE_GAP or last < times[0] - READABLE_GAP:
        apart = Finding(
            f"{path.name} holds poses from {first:.3f} to {last:.3f} s, and the depth images are "
            f"from {times[0]:.3f} to {times[-1]:.3f} s: they have no time in common, so no pose is "
            "read",
            "Write the times of both by the same clock, in seconds.",
        )
        return None, (apart,)
    order = np.argsort(trajectory.times, kind="stable")
    pose = poses_at(trajectory.times[order], trajectory.T_world_camera[order], times)

    def read(index: int) -> Float[np.ndarray, "4 4"] | None:
        T = pose(index)
        return None if T is None else known(T, path)

    return read, ()


def _camera_of(folder: Path) -> DefaultCamera:
    names = f"{folder.resolve().parent.name}/{folder.resolve().name}"
    which = re.search(r"(?:freiburg|(?<![a-z])fr)([123])(?!\d)", names, re.IGNORECASE)
    if which:
        source = f"TUM's calibration of freiburg{which[1]}"
        numbers, distortion = _CALIBRATED[which[1]]
        return DefaultCamera(numbers, source, sure=True, distortion=distortion)
    return DefaultCamera(PRIMESENSE, "the default of ROS for a Kinect", sure=False)
