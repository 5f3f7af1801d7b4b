"""The available content of a result folder, for the report and the viewer. [host]

A folder may be old, half written, or rewritten at this moment: missing files are left out, and
`problems` names the files that cannot be read.
"""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh
from jaxtyping import Bool, Float, UInt8

from jaxshape import limits, reading
from jaxshape.data.sequences.frames import SequenceError, opened
from jaxshape.results.surface import read_ply

GRIDS = ("occupied", "occluded", "encoder", "refined", "composed", "truth")
IMAGES = ("image", "depth", "mask")


class KeyframeRecord(NamedTuple):
    """A fused frame of a result folder.

    Attributes:
        name: Name of the frame.
        T_world_camera: Pose of the frame `[4 4]`; None where it is not known.
        files: Files of its image, depth and mask that are there.
        figures: All entries of keyframes.json for the frame.
    """

    name: str
    T_world_camera: Float[np.ndarray, "4 4"] | None
    files: dict[str, Path]
    figures: dict[str, Any]


class ResultFolder(NamedTuple):
    """The content of a result folder; missing parts are empty or None.

    Attributes:
        name: Name of the folder.
        result: Content of result.json, or of scene.json where there are several objects.
        mesh: Mesh in the world frame, in metres.
        measured: True for its vertices on the measured surface; None where that is not known.
        confidence: Probability that there is surface at its vertices; None where that is not known.
        color: Colours of its vertices; None where it has none.
        grids: Grids of `GRIDS` that are there.
        origin: Object-frame position of voxel coordinate (0, 0, 0), in metres.
        voxel_size: Edge lengths of one voxel, in metres.
        T_object_world: World to object frame `[4 4]`.
        intrinsics: fx, fy, cx, cy of the frames, in pixels.
        shape: Height and width of the frames, in pixels.
        keyframes: The keyframes, in their order.
        frames: Index, name, status and reason of every frame of the recording.
        trajectory: Segments of the camera's path in the object frame `[s 2 3]`, in metres.
        problems: A sentence for each file that cannot be read.
    """

    name: str
    result: dict[str, Any]
    mesh: trimesh.Trimesh | None
    measured: Bool[np.ndarray, " n"] | None
    confidence: Float[np.ndarray, " n"] | None
    color: UInt8[np.ndarray, "n 3"] | None
    grids: dict[str, Bool[np.ndarray, "x y z"]]
    origin: Float[np.ndarray, " 3"]
    voxel_size: Float[np.ndarray, " 3"]
    T_object_world: Float[np.ndarray, "4 4"]
    intrinsics: tuple[float, float, float, float] | None
    shape: tuple[int, int] | None
    keyframes: list[KeyframeRecord]
    frames: list[dict[str, Any]]
    trajectory: Float[np.ndarray, "s 2 3"]
    problems: list[str]


class ObjectBox(NamedTuple):
    """The box of an object of a scene.

    Attributes:
        name: Name of the object.
        T: From the frame of the box, whose origin is its centre, to that of the folder `[4 4]`.
        size: Extents of the box along its axes, in metres.
    """

    name: str
    T: Float[np.ndarray, "4 4"]
    size: Float[np.ndarray, " 3"]


def read_folder(folder: str | os.PathLike[str]) -> ResultFolder:
    """Read all available files of a folder made by `demo` or `reconstruct`, finished or not.

    Without a grid the object frame is not known; that of a scene's first object takes its place, or
    else the frame of the first keyframe, turned upright.

    Args:
        folder: The result folder.

    Raises:
        ValueError: There is no such folder.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ValueError(f"There is no folder {str(folder)!r}; give one made by jaxshape.")
    problems: list[str] = []

    def read(name: str, reader: Callable[[Path], Any], missing: Any) -> Any:
        if not (folder / name).is_file():
            return missing
        try:
            return reader(folder / name)
        except Exception as problem:  # of any library: one bad file must not hide the others
            problems.append(f"{name} cannot be read: {problem}.")
            return missing

    keyframes, frames, intrinsics, shape = read("keyframes.json", _keyframes, ([], [], None, None))
    grids, frame = read("grid.npz", _grids, ({}, None))
    result = read("result.json", reading.read_json_object, None)
    result = result or read("scene.json", reading.read_json_object, {})
    origin, voxel_size, T_world_object = frame or _stand_in(keyframes, result)
    T_object_world = np.linalg.inv(T_world_object)
    mesh, measured, color, confidence = read("mesh.ply", read_ply, (None,) * 4)
    return ResultFolder(
        name=folder.resolve().name,
        result=result,
        mesh=mesh,
        measured=measured,
        confidence=confidence,
        color=color,
        grids=grids,
        origin=origin,
        voxel_size=voxel_size,
        T_object_world=T_object_world,
        intrinsics=intrinsics,
        shape=shape,
        keyframes=keyframes,
        frames=frames,
        trajectory=_segments(frames or [k.figures for k in keyframes], T_object_world),
        problems=problems,
    )


def mesh_in_object(found: ResultFolder) -> trimesh.Trimesh | None:
    """The mesh in the object frame, upright; `None` where there is none."""
    return found.mesh and found.mesh.copy().apply_transform(found.T_object_world)


def camera_poses(found: ResultFolder) -> list[tuple[KeyframeRecord, Float[np.ndarray, "4 4"]]]:
    """The keyframes whose pose is known, each with its `T_object_camera`."""
    poses = ((k, k.T_world_camera) for k in found.keyframes)
    return [(k, found.T_object_world @ pose) for k, pose in poses if pose is not None]


def object_boxes(found: ResultFolder) -> list[ObjectBox]:
    """The boxes of the objects of a scene; those that cannot be read are left out."""
    boxes = []
    for entry in entries_of_objects(found.result):
        T_world_object = pose_of(entry.get("T_world_object"))
        try:
            size = _positive(entry.get("size"), 3)
        except ValueError:
            continue
        if T_world_object is not None:
            T = found.T_object_world @ T_world_object
            boxes.append(ObjectBox(str(entry.get("name")), T, np.array(size)))
    return boxes


def entries_of_objects(result: dict[str, Any]) -> list[dict[str, Any]]:
    """The entries of the objects of a scene; none in a result of one object."""
    entries = result.get("objects")
    return [one for one in entries if isinstance(one, dict)] if isinstance(entries, list) else []


def extent(found: ResultFolder) -> tuple[Float[np.ndarray, " 3"], float]:
    """Centre and radius of the object; of the camera's path where there is no object."""
    mesh, path = mesh_in_object(found), found.trajectory.reshape(-1, 3)
    if mesh is not None:
        low, high = mesh.bounds
    elif found.grids:
        shape = next(iter(found.grids.values())).shape
        low, high = found.origin, found.origin + shape * found.voxel_size
    else:
        low, high = (path.min(axis=0), path.max(axis=0)) if len(path) else (-np.ones(3), np.ones(3))
    return (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-3)


def half_field_of_view(found: ResultFolder) -> tuple[float, float]:
    """Tangents of half the horizontal and vertical field of view; of a Kinect where not known."""
    if found.intrinsics is None or found.shape is None:
        return 0.55, 0.41
    (fx, fy, *_), (h, w) = found.intrinsics, found.shape
    return w / (2 * fx), h / (2 * fy)


def picture(keyframe: KeyframeRecord, kind: str) -> UInt8[np.ndarray, "h w *c"] | Any | None:
    """The pixels of a keyframe's image, depth or mask, as stored; `None` where unreadable."""
    if kind not in keyframe.files:
        return None
    try:
        with opened(keyframe.files[kind]) as image:
            return np.asarray(image.convert("RGB") if kind == "image" else image)
    except SequenceError:
        return None


def thumbnail(image: Any, width: int) -> Any:
    """Every n-th pixel of an image, about `width` across: quick, and right for depth, too."""
    every = max(1, round(image.shape[1] / width))
    return image[::every, ::every]


# ------------------------------------------------------------------ one file each


def _grids(path: Path) -> tuple[dict[str, Any], tuple[Any, ...]]:
    kept = reading.read_arrays(path, (*GRIDS, "origin", "voxel_size", "T_world_object"))
    grids = {name: kept[name].astype(bool) for name in GRIDS if name in kept}
    origin, size = (np.asarray(kept[name], np.float64) for name in ("origin", "voxel_size"))
    T_world_object, shapes = pose_of(kept["T_world_object"]), {one.shape for one in grids.values()}
    if T_world_object is None or len(shapes) > 1 or not all(map(_is_grid, shapes)):
        raise ValueError("grids of one size with three axes and a 4x4 T_world_object are expected")
    if not (origin.shape == size.shape == (3,) and np.isfinite(origin).all() and (size > 0).all()):
        raise ValueError("three numbers of origin and of voxel_size are expected")
    return grids, (origin, size, T_world_object)


def _is_grid(shape: tuple[int, ...]) -> bool:
    return len(shape) == 3 and 1 <= min(shape) <= max(shape) <= limits.RESOLUTION


def _keyframes(path: Path) -> tuple[list[KeyframeRecord], list[dict[str, Any]], Any, Any]:
    content, folder = reading.read_json_object(path), path.parent.resolve()

    def files(entry: dict[str, Any]) -> dict[str, Path]:
        named = {kind: (folder / str(entry[kind])).resolve() for kind in IMAGES if entry.get(kind)}
        # A result may come from someone else: it shows pictures of its own folder only.
        return {k: p for k, p in named.items() if p.is_relative_to(folder) and p.is_file()}

    keyframes = [
        KeyframeRecord(
            str(entry.get("name", i)), pose_of(entry.get("T_world_camera")), files(entry), entry
        )
        for i, entry in enumerate(content.get("keyframes") or [])
    ]
    intrinsics, shape = content.get("intrinsics"), content.get("shape")
    return (
        keyframes,
        [dict(frame) for frame in content.get("frames") or []],
        _positive(intrinsics, 4) if intrinsics else None,
        tuple(map(int, _positive(shape, 2))) if shape else None,
    )


def _positive(value: Any, count: int) -> tuple[float, ...]:
    numbers = reading.numbers_of(value, (count,))
    if not ((numbers > 0) & (numbers < limits.FAR)).all():
        raise ValueError(f"{numbers.tolist()} should be above 0")
    return tuple(numbers.tolist())


def pose_of(value: Any) -> Float[np.ndarray, "4 4"] | None:
    """A 4x4 matrix of finite numbers that has an inverse, or `None`."""
    try:
        pose = np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    is_pose = pose.shape == (4, 4) and bool((np.abs(pose) <= limits.FAR).all())
    return pose if is_pose and abs(np.linalg.det(pose)) > 1e-12 else None


def _stand_in(keyframes: list[KeyframeRecord], result: dict[str, Any]) -> tuple[Any, ...]:
    """A substitute for the object frame where there is no grid: the frame of a scene's first
    object, which stands upright, or of the first camera, in which y points down."""
    objects = (pose_of(one.get("T_world_object")) for one in entries_of_objects(result))
    cameras = (k.T_world_camera for k in keyframes)
    upright = next((T for T in objects if T is not None), None)
    if upright is None:
        first = next((T for T in cameras if T is not None), None)
        upright = np.eye(4) if first is None else first @ np.diag([1.0, -1.0, -1.0, 1.0])
    return np.zeros(3), np.ones(3), upright


def _segments(
    frames: list[dict[str, Any]], T_object_world: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "s 2 3"]:
    """Segments from each posed frame to the next; the path is broken at lost frames."""
    poses = [pose_of(frame.get("T_world_camera")) for frame in frames]
    pairs = [
        (a[:3, 3], b[:3, 3])
        for a, b in zip(poses, poses[1:], strict=False)
        if a is not None and b is not None
    ]
    segments = np.asarray(pairs, np.float64).reshape(-1, 2, 3)
    return segments @ T_object_world[:3, :3].T + T_object_world[:3, 3]
