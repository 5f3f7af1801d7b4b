"""nerfstudio, Polycam through it, and instant-ngp: `transforms.json` with a camera and a pose for
each image."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxshape.data.sequences.cameras import Calibration, distorted, matrices_of
from jaxshape.data.sequences.documents import below, matrix_of, read_json_object, shape_of
from jaxshape.data.sequences.frames import (
    Finding,
    FrameFiles,
    SequenceError,
    read_shape,
    usual_depth_scale,
    usual_shape,
)
from jaxshape.data.sequences.listing import (
    COLOR_SUFFIXES,
    Contents,
    Listed,
    depth_images,
    has_depth_folder,
    numbers_in,
    partners,
)
from jaxshape.data.sequences.poses import from_opengl, known

_SOURCE = "transforms.json"
_LENS = ("k1", "k2", "k3", "k4", "p1", "p2")
_NO_PINHOLE = ("fisheye", "equirectangular", "ortho", "vr180", "omni")
_UNITS = ("depth_unit_scale_factor", "integer_depth_scale")
_CAMERA = ("h", "w", "fl_x", "fl_y", "cx", "cy", "camera_angle_x")


def fits(contents: Contents) -> bool:
    return _SOURCE in contents.files


def list_frames(contents: Contents) -> Listed:
    """`transforms.json`, and the images it names: `file_path`, `depth_file_path`, `mask_path`;
    instant-ngp's `depth_path`.

    Poses are camera to world with OpenGL's axes, y up and z backwards; pixel coordinates start at
    the corner of the image, like ours. Frames are sorted by the names of their images.
    """
    source = contents.folder / _SOURCE
    about = read_json_object(source)
    frames = sorted(_frames(about, source), key=_order)
    depth = _depth_of(contents, frames, source)
    first: dict[Path, int] = {}
    for i, path in enumerate(depth):
        if path is not None:
            first.setdefault(path, i)
    kept = list(first.values())
    if not kept:
        raise SequenceError(
            f"{source} names no depth image; expected depth_file_path in its frames: process the "
            "recording again with its depth (ns-process-data polycam --use-depth)."
        )
    files = [_files(contents.folder, frames[i], depth[i], source) for i in kept]
    frames = [frames[i] for i in kept]
    scale = float(matrix_of(about.get("applied_scale", 1.0), (), source, "applied_scale"))
    if not 1e-9 < scale < 1e9:
        raise SequenceError(f"{source} gives applied_scale {scale:g}; expected one above 0.")

    def read(index: int) -> Float[np.ndarray, "4 4"] | None:
        T, given = np.eye(4), frames[index].get("transform_matrix")
        count = 3 if isinstance(given, list) and len(given) == 3 else 4
        T[:count] = matrix_of(given, (count, 4), source, "transform_matrix")
        T[:3, 3] /= scale
        return known(from_opengl(T), f"The pose of {files[index].name} in {source}")

    return Listed(
        files=tuple(files),
        depth_scale=_depth_scale(about, files, source),
        read_pose=read,
        calibration=_calibration(about, frames, files, source),
        findings=(
            *_left_out(depth.count(None)),
            *_repeated(len(depth) - depth.count(None) - len(kept)),
            *_without_colors(frames, files, source),
            *_distorted(about, frames, source),
        ),
    )


def _frames(about: dict[str, Any], source: Path) -> list[dict[str, Any]]:
    frames = about.get("frames")
    if not isinstance(frames, list) or not all(isinstance(one, dict) for one in frames):
        raise SequenceError(f"{source} holds no list of frames; write it again.")
    for name in (one.get("file_path") for one in frames):
        if name is not None:
            below(source.parent, name, source)  # refuses a matrix that is no pose
    return frames


def _order(frame: dict[str, Any]) -> tuple[tuple[int, ...], str]:
    name = str(frame.get("file_path"))
    return numbers_in(name), name


# Images ----------------------------------------------------------------------------------------


def _depth_of(contents: Contents, frames: list[dict[str, Any]], source: Path) -> list[Path | None]:
    """The depth image of each frame: the named one, or the one with the same name or number."""
    named = [frame.get("depth_file_path") or frame.get("depth_path") for frame in frames]
    if any(named):
        return [below(contents.folder, name, source) if name else None for name in named]
    if not has_depth_folder(contents):
        return [None] * len(frames)
    return partners(
        [Path(str(one.get("file_path"))).stem for one in frames], depth_images(contents)
    )


def _files(folder: Path, frame: dict[str, Any], depth: Path | None, source: Path) -> FrameFiles:
    assert depth is not None
    name, mask = frame.get("file_path"), frame.get("mask_path")
    # Blender's synthetic scenes name files without suffix.
    names = [f"{name}{end}" for end in ("", *COLOR_SUFFIXES)] if name else []
    colors = (below(folder, one, source) for one in names)
    color = next((path for path in colors if path.is_file()), None)
    return FrameFiles(depth.stem, depth, color, below(folder, mask, source) if mask else None)


def _depth_scale(about: dict[str, Any], files: list[FrameFiles], source: Path) -> float:
    unit = next((name for name in _UNITS if about.get(name) is not None), None)
    if unit is None:
        return usual_depth_scale(one.depth for one in files)
    metres = float(matrix_of(about[unit], (), source, unit))
    if not (np.isfinite(metres) and metres > 0):
        raise SequenceError(
            f"{source} gives {unit} {metres:g}; expected the metres in a unit of "
            "depth, which are positive: 0.001 for millimetres."
        )
    return 1 / metres


# Cameras ---------------------------------------------------------------------------------------


def _calibration(
    about: dict[str, Any], frames: list[dict[str, Any]], files: list[FrameFiles], source: Path
) -> Calibration:
    """The camera of each frame; entries of a frame take precedence over those of the file."""
    entries = [{name: one.get(name, about.get(name)) for name in _CAMERA} for one in frames]
    shape = _shape(entries, files, source)
    numbers = np.array([_numbers(entry, shape, source) for entry in entries])
    if (numbers == numbers[0]).all():
        return Calibration(matrices_of(*numbers[0]), shape, source.name)
    return Calibration(matrices_of(*numbers.T), shape, f"{source.name}, of each frame its own")


def _shape(entries: list[dict[str, Any]], files: list[FrameFiles], source: Path) -> tuple[int, int]:
    sides = [(one["h"], one["w"]) for one in entries]
    shapes = {None if None in pair else shape_of(*pair, source) for pair in sides}
    if len(shapes) > 1:
        raise SequenceError(
            f"{source} has images of {len(shapes)} sizes; expected one size: scale the images and "
            "their cameras."
        )
    if (given := shapes.pop()) is not None:
        return given
    return usual_shape(one.color for one in files if one.color) or read_shape(files[0].depth)


def _numbers(entry: dict[str, Any], shape: tuple[int, int], source: Path) -> list[float]:
    """fx, fy, cx, cy; without focal lengths, from the angle of view, which Blender gives."""
    h, w = shape
    fx, fy = entry.get("fl_x"), entry.get("fl_y")
    if fx is None and entry.get("camera_angle_x") is not None:
        angle = float(matrix_of(entry["camera_angle_x"], (), source, "camera_angle_x"))
        fx = w / (2 * np.tan(angle / 2)) if 0 < angle < np.pi else None
    fy = fx if fy is None else fy
    cx, cy = entry.get("cx"), entry.get("cy")
    center = w / 2 if cx is None else cx, h / 2 if cy is None else cy
    return matrix_of([fx, fy, *center], (4,), source, "fl_x, fl_y, cx, cy").tolist()


# Findings --------------------------------------------------------------------------------------


def _left_out(count: int) -> tuple[Finding, ...]:
    if not count:
        return ()
    return (Finding(f"{count} frames have no depth image", "They are left out."),)


def _repeated(count: int) -> tuple[Finding, ...]:
    if not count:
        return ()
    advice = "They are left out; list each depth image once."
    return (Finding(f"{count} frames name the depth image of an earlier frame", advice),)


def _without_colors(
    frames: list[dict[str, Any]], files: list[FrameFiles], source: Path
) -> tuple[Finding, ...]:
    missing = [
        frame["file_path"]
        for frame, one in zip(frames, files, strict=True)
        if frame.get("file_path") and one.color is None
    ]
    if not missing:
        return ()
    return (
        Finding(
            f"{len(missing)} colour images that {source.name} names do not exist, {missing[0]} "
            "among them",
            "Copy them to the recording; until then these frames have no colour.",
        ),
    )


def _distorted(
    about: dict[str, Any], frames: list[dict[str, Any]], source: Path
) -> tuple[Finding, ...]:
    """The remark on the first lens, of the file or of a frame, that is not a pinhole's."""
    for entry in (about, *frames):
        model = "fisheye" if entry.get("is_fisheye") else str(entry.get("camera_model", ""))
        if any(word in model.lower() for word in _NO_PINHOLE):
            advice = "Undistort depth and colour images to a pinhole camera first."
            return (Finding(f"{source.name} is of a camera of model {model}", advice),)
        given = entry.get("distortion_params")
        numbers = [entry.get(name) for name in _LENS] + (given if isinstance(given, list) else [])
        lens = [float(one) for one in numbers if isinstance(one, int | float)]
        if remark := distorted(lens, source.name):
            return remark
    return ()
