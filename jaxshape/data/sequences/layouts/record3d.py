"""Record3D: recordings with an iPhone, exported as EXR or PNG and JPG."""

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxshape.data.sequences.cameras import Calibration, matrices_of
from jaxshape.data.sequences.documents import matrix_of, read_json_object, shape_of
from jaxshape.data.sequences.frames import SequenceError, usual_depth_scale
from jaxshape.data.sequences.listing import (
    Contents,
    Listed,
    depth_images,
    files_in,
    frame_files,
    has_depth_folder,
    last_number,
    miscounted_poses,
    partners,
)
from jaxshape.data.sequences.poses import from_opengl, from_quaternions, known

_PACKED = (
    "holds depth images that are packed with Apple's LZFSE, which is not read; expected Record3D's "
    "other export: choose EXR + RGB there."
)


def fits(contents: Contents) -> bool:
    if not has_depth_folder(contents):
        return _packed(contents)
    with suppress(SequenceError):
        return any("poses" in read_json_object(path) for path in _metadata(contents))
    return False


def _packed(contents: Contents) -> bool:
    """Whether this is Record3D's own file, or the folder that it unzips to."""
    is_unzipped = "rgbd" in contents.folders and "metadata" in contents.files
    return is_unzipped or any(name.endswith(".r3d") for name in contents.files)


def _metadata(contents: Contents) -> list[Path]:
    names = ("metadata.json", "metadata")
    return [contents.folder / name for name in names if name in contents.files]


def list_frames(contents: Contents) -> Listed:
    """`depth/N.exr` in metres, `rgb/N.jpg`, and `metadata.json` with poses and cameras by frame.

    Poses are quaternion and position, camera to world, with ARKit's axes: y up, z backwards.
    Cameras belong to the colour images, whose size is in the metadata.
    """
    if _packed(contents) and not has_depth_folder(contents):
        raise SequenceError(f"{contents.folder} {_PACKED}")
    source = next(iter(_metadata(contents)), contents.folder / "metadata.json")
    about, depth = read_json_object(source), depth_images(contents)
    confidence = partners(depth, files_in(contents, ("confidence", "conf"), (".png",)))
    numbers = list(map(last_number, depth))
    poses = matrix_of(about.get("poses"), (-1, 7), source, "poses")
    T = from_opengl(from_quaternions(poses[:, 4:], poses[:, :4], source))

    def read(index: int) -> Float[np.ndarray, "4 4"] | None:
        number = numbers[index]
        return known(T[number], f"Pose {number} of {source}") if 0 <= number < len(T) else None

    return Listed(
        files=frame_files(contents, depth, confidence=confidence),
        depth_scale=usual_depth_scale(depth.values()),
        read_pose=read,
        calibration=_calibration(about, numbers, source),
        findings=miscounted_poses([0 <= one < len(T) for one in numbers], len(T)),
    )


def _calibration(about: dict[str, Any], numbers: list[int], source: Path) -> Calibration:
    shape = shape_of(about.get("h"), about.get("w"), source)
    if own := about.get("perFrameIntrinsicCoeffs"):
        numbers_of = matrix_of(own, (-1, 4), source, "perFrameIntrinsicCoeffs")
        if 0 <= min(numbers) and max(numbers) < len(numbers_of):
            matrices = matrices_of(*numbers_of[numbers].T)
            return Calibration(matrices, shape, f"{source.name}, of each frame its own")
    K = matrix_of(about.get("K"), (3, 3), source, "K").T  # it is stored by columns
    return Calibration(K[None], shape, source.name)
