"""Replica (Straub et al., 2019) as NICE-SLAM, Semantic-NeRF and vMAP render it: `traj.txt` or
`traj_w_c.txt`, and images."""

from contextlib import suppress
from pathlib import Path

import numpy as np

from jaxshape.data.sequences.cameras import Calibration, matrices_of
from jaxshape.data.sequences.documents import (
    matrix_of,
    read_document,
    read_json_object,
    rows_of,
    shape_of,
)
from jaxshape.data.sequences.frames import SequenceError
from jaxshape.data.sequences.listing import (
    COLOR_SUFFIXES,
    DEPTH_SUFFIXES,
    Contents,
    Listed,
    color_images,
    depth_images,
    files_in,
    frame_files,
    has_depth_folder,
    last_number,
    partners,
)
from jaxshape.data.sequences.poses import known
from jaxshape.data.sequences.text import words_of

_SCALES = {"traj.txt": 6553.5, "traj_w_c.txt": 1000.0}
"""Depth units per metre by the name of the poses: of NICE-SLAM, and of Semantic-NeRF and vMAP."""

_CAMERA = (600.0, 600.0, 599.5 + 0.5, 339.5 + 0.5)
_SHAPE = (680, 1200)


def fits(contents: Contents) -> bool:
    if not (has_depth_folder(contents) or "results" in contents.folders):
        return False
    with suppress(SequenceError):
        return (path := _poses(contents)) is not None and _is_matrices(path)
    return False


def _poses(contents: Contents) -> Path | None:
    return next((contents.folder / name for name in _SCALES if name in contents.files), None)


def _is_matrices(path: Path) -> bool:
    """Whether a file has 16 numbers on its first line, unlike a trajectory of TUM."""
    _, first = next(iter(words_of(read_document(path))), (0, []))
    return len(first) == 16


def list_frames(contents: Contents) -> Listed:
    """`results/depthN.png` and `results/frameN.jpg`, or `depth/` and `rgb/`, and `traj.txt`.

    Line i of `traj.txt` is the camera-to-world matrix of the i-th image, by rows; if there are more
    lines or fewer than images, of the image of number i, from 0. The camera and the depth scale
    come from `cam_params.json`, here or in the parent folder.
    """
    if "results" in contents.folders:
        every = files_in(contents, ("results",), COLOR_SUFFIXES + DEPTH_SUFFIXES)
        depth = {name: path for name, path in every.items() if name.startswith("depth")}
        offered = {name: path for name, path in every.items() if not name.startswith("depth")}
    else:
        depth, offered = depth_images(contents), color_images(contents)
    source = _poses(contents)
    if source is None:
        raise SequenceError(f"{contents.folder} holds no traj.txt; copy it there.")
    poses = np.array(rows_of(source, (16,))).reshape(-1, 4, 4)
    calibration, scale = _calibration(contents, _SCALES[source.name])
    lines = range(len(depth)) if len(poses) == len(depth) else list(map(last_number, depth))

    def read(index: int):
        line = lines[index]
        return known(poses[line], f"Line {line} of {source}") if 0 <= line < len(poses) else None

    return Listed(
        files=frame_files(contents, depth, partners(depth, offered)),
        depth_scale=scale,
        read_pose=read,
        calibration=calibration,
    )


def _calibration(contents: Contents, usual: float) -> tuple[Calibration | None, float]:
    for folder in (contents.folder, contents.folder.resolve().parent):
        source = folder / "cam_params.json"
        if source.is_file():
            about = read_json_object(source)
            inner = about.get("camera")
            about = inner if isinstance(inner, dict) else about
            names = ("fx", "fy", "cx", "cy", "h", "w", "scale")
            values = [about.get(name, usual if name == "scale" else None) for name in names]
            fx, fy, cx, cy, h, w, scale = matrix_of(values, (7,), source, ", ".join(names)).tolist()
            if not (np.isfinite(scale) and scale > 0):
                raise SequenceError(f"{source} gives the scale {scale:g}; expected one above 0.")
            K = matrices_of(fx, fy, cx + 0.5, cy + 0.5)
            return Calibration(K, shape_of(h, w, source), source.name), scale
    if "cam_K.txt" in contents.files:
        return None, usual
    return Calibration(matrices_of(*_CAMERA), _SHAPE, "NICE-SLAM's camera for Replica"), usual
