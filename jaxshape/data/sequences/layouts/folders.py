"""Layouts with a folder for each kind of image: Redwood object scans, BundleSDF, Open3D."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxshape import reading
from jaxshape.data.sequences.cameras import PRIMESENSE, DefaultCamera
from jaxshape.data.sequences.frames import Finding, SequenceError, usual_depth_scale
from jaxshape.data.sequences.listing import (
    Contents,
    Listed,
    color_images,
    depth_images,
    files_in,
    frame_files,
    has_depth_folder,
    miscounted_poses,
    numbers_in,
    partners,
    with_colors_by_time,
)
from jaxshape.data.sequences.poses import StoredByColumns, known, read_pose
from jaxshape.data.sequences.text import words_of
from jaxshape.data.sequences.trajectories import read_unchecked

MILLIMETRES = 1000.0

_POSE_FOLDERS = {"poses": False, "pose": False, "ob_in_cam": True, "annotated_poses": True}
"""Folders of 4x4 matrices, and whether they map object to camera, like BundleSDF's own."""

_STAMPED = re.compile(r"\d+-\d+")

PoseReader = Callable[[int], Float[np.ndarray, "4 4"] | None]


# Redwood ---------------------------------------------------------------------------------------


def fits_redwood(contents: Contents) -> bool:
    depth = files_in(contents, ("depth",), (".png",))
    return bool(depth) and all(map(_STAMPED.fullmatch, depth))


def list_redwood(contents: Contents) -> Listed:
    """Object scans (Choi et al., 2016): `depth/N-TIME.png`, `rgb/N-TIME.jpg`, microseconds.

    The streams are not synchronised: each depth image gets the colour image nearest in time. There
    are no poses, unless there is a trajectory file beside the folders.
    """
    if "intrinsics.txt" in contents.files and "extrinsics" in contents.folders:
        raise SequenceError(
            f"{contents.folder} is a recording of SUN3D, whose depth images hold millimetres that "
            "are rotated by three bits; expected plain millimetres: save (d >> 3) | (d << 13) of "
            "each 16-bit image d to another folder, and intrinsics.txt as cam_K.txt beside it."
        )
    depth, offered = depth_images(contents), color_images(contents)
    offered = {name: path for name, path in offered.items() if _STAMPED.fullmatch(name)}
    times, color_times = _stamps(depth), _stamps(offered)
    order = np.argsort(color_times, kind="stable")
    paths = [list(offered.values())[i] for i in order]
    color, delays = with_colors_by_time(times, color_times[order], paths)
    return Listed(
        files=frame_files(contents, depth, color),
        depth_scale=MILLIMETRES,
        read_pose=_trajectory_poses(contents, len(depth)),
        times=times,
        color_delays=delays if offered else None,
        camera=DefaultCamera(PRIMESENSE, "the PrimeSense Carmine of all these scans", sure=True),
    )


def _stamps(names: dict[str, Path]) -> Float[np.ndarray, " n"]:
    return np.array([numbers_in(name)[1] for name in names], dtype=np.float64) / 1e6


# BundleSDF -------------------------------------------------------------------------------------


def fits_bundlesdf(contents: Contents) -> bool:
    return has_depth_folder(contents) and "cam_K.txt" in contents.files


def list_bundlesdf(contents: Contents) -> Listed:
    """BundleSDF (Wen et al., CVPR 2023): `rgb/ depth/ masks/ cam_K.txt`, perhaps `poses/`.

    `poses/N.txt` are camera to world; those of `ob_in_cam/` and `annotated_poses/`, BundleSDF's own
    names, are object to camera, so that the world is then the object's frame.
    """
    return _by_name(contents)._replace(camera=None)


# Open3D ----------------------------------------------------------------------------------------


def fits_open3d(contents: Contents) -> bool:
    return has_depth_folder(contents)


def list_open3d(contents: Contents) -> Listed:
    """Open3D's reconstruction system: `depth/`, `color/`, a trajectory, a camera.

    Pose i of a `.log` belongs to the depth image that its header names, from 0.
    """
    return _by_name(contents)


def _by_name(contents: Contents) -> Listed:
    depth = depth_images(contents)
    read, doubts = _pose_files(contents, list(depth))
    return Listed(
        files=frame_files(contents, depth),
        depth_scale=usual_depth_scale(depth.values()),
        read_pose=read or _trajectory_poses(contents, len(depth)),
        camera=DefaultCamera(PRIMESENSE, "Open3D's default, a PrimeSense", sure=False),
        findings=doubts,
    )


# Poses -----------------------------------------------------------------------------------------


def _pose_files(
    contents: Contents, names: list[str]
) -> tuple[PoseReader | None, tuple[Finding, ...]]:
    """Poses in one file each, with the names or the numbers of the depth images, and doubts."""
    for folder, is_object_to_camera in _POSE_FOLDERS.items():
        if offered := files_in(contents, (folder,), (".txt",)):
            found = partners(names, offered)
            doubts = miscounted_poses(map(bool, found), len(offered))
            return _reader(found, is_object_to_camera), doubts
    return None, ()


def _reader(files: list[Path | None], is_object_to_camera: bool) -> PoseReader:
    def read(index: int) -> Float[np.ndarray, "4 4"] | None:
        try:
            T = read_pose(files[index])
        except StoredByColumns as stored:
            stored.T = np.linalg.inv(stored.T) if is_object_to_camera else stored.T
            raise
        return np.linalg.inv(T) if is_object_to_camera and T is not None else T

    return read


def _trajectory_poses(contents: Contents, count: int) -> PoseReader | None:
    path = _find_trajectory(contents)
    if path is None:
        return None
    trajectory = read_unchecked(path)
    frames = trajectory.frames
    if len(frames) and frames.max() >= count:
        if len(frames) != count:
            raise SequenceError(
                f"{path} has poses of frames up to {frames.max()}, and there are {count} depth "
                "images; expected the number of a depth image, from 0, before each pose: write "
                "these numbers."
            )
        frames = np.arange(count)
    poses = dict(zip(frames.tolist(), trajectory.T_world_camera, strict=True))

    def read(index: int) -> Float[np.ndarray, "4 4"] | None:
        return known(poses[index], f"Pose {index} of {path}") if index in poses else None

    return read


def _find_trajectory(contents: Contents) -> Path | None:
    """The `.log` or `.json` that holds poses; files called trajectory come first."""

    def order(name: str) -> tuple[bool, str]:
        return "traj" not in name.lower(), name

    for name in sorted(contents.files, key=order):
        path = contents.folder / name
        if name.lower().endswith(".log") and _is_log(path):
            return path
        if name.lower().endswith(".json") and _is_json_trajectory(path):
            return path
    return None


def _is_log(path: Path) -> bool:
    try:
        first = next(iter(words_of(reading.read_text(path))), (0, []))[1]
    except (OSError, ValueError):
        return False
    return len(first) == 3 and all(re.fullmatch(r"-?\d+", word) for word in first)


def _is_json_trajectory(path: Path) -> bool:
    if "traj" in path.name.lower():  # if it is not a trajectory, its reader reports why
        return True
    try:
        return "parameters" in reading.read_json_object(path)
    except (OSError, ValueError):
        return False
