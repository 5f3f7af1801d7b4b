"""A single `.npz` file of arrays: depth, and optionally colour, cameras, poses, masks and times."""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from jaxshape import reading
from jaxshape.data.sequences.cameras import Calibration
from jaxshape.data.sequences.frames import Finding, FrameFiles, SequenceError
from jaxshape.data.sequences.listing import Contents, Listed
from jaxshape.data.sequences.poses import known
from jaxshape.data.sequences.rasters import Stored

_NAMES = {
    "depth": ("depth", "depths"),
    "color": ("color", "colors", "rgb", "image", "images"),
    "K": ("K", "intrinsics"),
    "poses": ("poses", "T_world_camera", "c2w"),
    "masks": ("masks", "mask"),
    "times": ("times", "timestamps"),
}

_POSES = re.compile("pose|extrinsic|traj|w2c|c2w|cam", re.IGNORECASE)
_OTHERS = re.compile(r"distort|dist_?coef|^dist$|depth_?scale", re.IGNORECASE)

_UNUSED = Finding(
    "the times do not rise, so they are not used",
    "Save the frames in the order of their times, in seconds since one start.",
)


def fits(contents: Contents) -> bool:
    return len(contents.files) == len(_files(contents)) == 1 and not contents.folders


def _files(contents: Contents) -> list[Path]:
    return [contents.folder / name for name in contents.files if name.lower().endswith(".npz")]


def list_frames(contents: Contents) -> Listed:
    """`depth [n h w]`, `color [n h w 3]`, `K [3 3]` or `[n 3 3]`, `poses [n 4 4]`, `masks [n h w]`.

    Depth is in metres if its type is float, in millimetres if it is integer. Poses are camera to
    world; K follows OpenCV, with the centre of the first pixel at 0, 0.
    """
    path = next(iter(sorted(_files(contents))), None)
    if path is None:
        raise SequenceError(f"{contents.folder} holds no .npz file; give the one that you mean.")
    arrays = _read(path)
    if "depth" not in arrays:
        raise SequenceError(f"{path} holds no array called depth; expected depth [n h w]: add it.")
    depth = arrays["depth"]
    depth = depth[None] if depth.ndim == 2 else depth
    if depth.ndim not in (3, 4) or depth.size == 0:
        raise SequenceError(f"{path} holds depth of shape {depth.shape}; expected [n h w].")
    count = len(depth)
    per_frame = {
        name: _of_frames(arrays.get(name), depth.shape, wanted, path, name)
        for name, wanted in (("color", (3,)), ("masks", ()))
    }
    poses = _checked(arrays.get("poses"), [(count, 4, 4)], path, "poses")
    times = _checked(arrays.get("times"), [(count,)], path, "times")
    rises = times is None or _rises(times)
    K = _checked(arrays.get("K"), [(3, 3), (1, 3, 3), (count, 3, 3)], path, "K")

    def stored(name: str, array: np.ndarray | None, index: int) -> Stored | None:
        return None if array is None else Stored(f"{path}: {name} {index}", array[index])

    return Listed(
        files=tuple(
            FrameFiles(
                f"{index:06d}",
                Stored(f"{path}: depth {index}", depth[index]),
                stored("color", per_frame["color"], index),
                stored("masks", per_frame["masks"], index),
            )
            for index in range(count)
        ),
        depth_scale=1.0 if depth.dtype.kind == "f" else 1000.0,
        read_pose=None if poses is None else lambda i: known(poses[i], f"{path}: pose {i}"),
        times=times if rises else None,
        calibration=None if K is None else _calibration(K, path),
        findings=(*_unread(path, has_poses=poses is not None), *(() if rises else (_UNUSED,))),
    )


def _unread(path: Path, *, has_poses: bool) -> Iterator[Finding]:
    """Remarks on arrays that may be poses, in a file without poses, and on a lens distortion or a
    depth scale."""
    names = sorted(reading.array_names(path))
    others = list(filter(_POSES.search, names))
    if others and not has_poses:
        yield Finding(
            f"{path.name} holds {', '.join(others[:4])}, which are not read",
            "If they are poses, save them camera to world as poses [n 4 4]; otherwise the camera "
            "is tracked.",
        )
    if others := list(filter(_OTHERS.search, names)):
        yield Finding(
            f"{path.name} holds {', '.join(others[:4])}, which are not read",
            "Undistort depth and colour images first, and give the depth units per metre as "
            "--depth-scale.",
        )


def _rises(times: np.ndarray) -> bool:
    return bool(np.isfinite(times).all() and (np.diff(times) > 0).all())


def _calibration(K: np.ndarray, path: Path) -> Calibration:
    K = K.reshape(-1, 3, 3).copy()
    K[:, :2, 2] += 0.5
    return Calibration(K, None, path.name)


def _of_frames(
    array: np.ndarray | None, depth: tuple[int, ...], last: tuple[int, ...], path: Path, name: str
) -> np.ndarray | None:
    """Images of all frames, checked, with a leading axis over frames."""
    if array is None:
        return None
    array = array[None] if array.ndim == 2 + len(last) else array
    if array.ndim != 3 + len(last) or len(array) != depth[0] or array.shape[3:] != last:
        raise SequenceError(
            f"{path} holds {name} of shape {array.shape} and depth of {depth}; expected an image "
            "for each depth image."
        )
    if name == "color" and array.dtype != np.uint8:
        raise SequenceError(f"{path} holds color of {array.dtype}; expected uint8, 0 to 255.")
    return array


def _checked(
    array: np.ndarray | None, shapes: list[tuple[int, ...]], path: Path, name: str
) -> np.ndarray | None:
    if array is None:
        return None
    if array.shape not in shapes or array.dtype.kind not in "iuf":
        raise SequenceError(
            f"{path} holds {name} of shape {array.shape} and type {array.dtype}; expected numbers "
            f"of shape {' or '.join(map(str, shapes))}."
        )
    return array.astype(np.float64)


# Reading ---------------------------------------------------------------------------------------


def _read(path: Path) -> dict[str, np.ndarray]:
    """The arrays that are used, by kind; the first of their possible names counts."""
    try:
        there = reading.array_names(path)
        chosen = {
            kind: next(name for name in names if name in there)
            for kind, names in _NAMES.items()
            if not there.isdisjoint(names)
        }
        found = reading.read_arrays(path, chosen.values())
    except (OSError, ValueError) as error:
        raise SequenceError(
            f"{path} cannot be read ({error}); expected a file of numpy.savez with depth [n h w] "
            "and K: write it again."
        ) from error
    return {kind: found[name] for kind, name in chosen.items()}
