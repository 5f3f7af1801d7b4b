"""Intrinsics of a recording: from its files, or known values of its kind of camera.

Our intrinsics put the centre of pixel (row, column) at (column + 0.5, row + 0.5). So does
`camera-intrinsics.txt`, whose 640 x 480 images have their centre at 320, 240. OpenCV, and with it
TUM, Open3D, Redwood and `cam_K.txt`, put it at (column, row): half a pixel is added to their
principal points.
"""

import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxshape import reading
from jaxshape.data.sequences.documents import shape_of
from jaxshape.data.sequences.frames import Finding, SequenceError, same_aspect, size
from jaxshape.data.sequences.poses import read_matrix
from jaxshape.data.sequences.text import words_of

Matrix = Float[np.ndarray, "3 3"]


class Camera(NamedTuple):
    """Intrinsics and their source.

    Attributes:
        intrinsics: Camera matrix, in pixels.
        source: Source of the intrinsics.
        depth_scale: Depth units per metre that the source states; None if it does not.
        distortion: Numbers of the lens distortion that the source states.
    """

    intrinsics: Float[np.ndarray, "3 3"]
    source: str
    depth_scale: float | None = None
    distortion: tuple[float, ...] = ()


class Calibration(NamedTuple):
    """Cameras from the files of a recording, for images of a given size.

    Attributes:
        matrices: Camera matrix of each frame, or one for all `[n 3 3]`, in pixels, where column j
            covers u in [j, j + 1).
        shape: Height and width of the images of these cameras, in pixels; None for the size of the
            depth images.
        source: Source of the cameras.
    """

    matrices: Float[np.ndarray, "n 3 3"]
    shape: tuple[int, int] | None
    source: str


class DefaultCamera(NamedTuple):
    """The camera that is known to be used for a kind of recording.

    Attributes:
        numbers: fx, fy, cx, cy in OpenCV's pixel coordinates, for 640 x 480 images.
        source: Source of the numbers.
        sure: Whether the camera is known to be that of this very recording; otherwise it is a
            guess.
        distortion: Numbers of its lens distortion.
    """

    numbers: tuple[float, float, float, float]
    source: str
    sure: bool
    distortion: tuple[float, ...] = ()


_BENT = 0.01
"""Least number of a lens distortion that is remarked; it moves the corners of an image by 0.5 %."""

PRIMESENSE = (525.0, 525.0, 319.5, 239.5)
"""Default of the drivers of Kinect 1 and Asus Xtion, and of ROS and Open3D."""


def find_camera(folder: Path, names: Iterable[str], shape: tuple[int, int]) -> Camera | None:
    """The camera file in a folder with the files `names`, or in its parent; None without one.

    It may be `camera-intrinsics.txt` or `cam_K.txt` (3x3), `calibration.txt` (fx fy cx cy, or 3x3),
    or a camera or trajectory of Open3D with "camera", "intrinsic" or "traj" in its name, which is
    scaled to `shape` if its size differs. The first of them counts; of Open3D's, one of the depth
    images.
    """
    for name in _camera_files(names):
        if (camera := _read_camera(folder / name, shape)) is not None:
            return camera
    for name in _FILES:
        if (path := folder.resolve().parent / name).is_file():
            return _read_camera(path, shape)
    return None


def other_cameras(
    camera: Camera, folder: Path, names: Iterable[str], shape: tuple[int, int]
) -> Iterator[Finding]:
    """Remarks on camera files in a folder with the files `names` that differ from `camera`.

    Args:
        camera: The camera that is used.
        folder: Folder of the recording.
        names: Names of its files.
        shape: Height and width of the depth images, in pixels.
    """
    for name in _camera_files(name for name in names if name != camera.source):
        with suppress(SequenceError):  # it may be of other images
            other = _read_camera(folder / name, shape)
            # The same numbers may be meant from the corner or from the centre of a pixel.
            if other and not np.allclose(other.intrinsics, camera.intrinsics, rtol=0.01, atol=1):
                yield Finding(
                    f"{name} gives other intrinsics than {camera.source}, which are used",
                    "Remove the file that is not of the depth images.",
                )


def _camera_files(names: Iterable[str]) -> list[str]:
    """The names of camera files, by precedence."""
    names = frozenset(names)
    pattern = re.compile(r"(camera|intrinsic|traj).*\.json$", re.IGNORECASE)
    found = sorted(filter(pattern.search, names))
    found.sort(key=lambda name: ("traj" in name, "depth" not in name))
    return [*(name for name in _FILES if name in names), *found]


def _read_camera(path: Path, shape: tuple[int, int]) -> Camera | None:
    """A camera file, checked; None if it is a JSON file of something else."""
    if path.name in _FILES:
        K, distortion = _FILES[path.name](path)
        return _camera(K, path, shape)._replace(distortion=distortion)
    return _read_json(path, shape)


def _camera(K: Matrix, path: Path, shape: tuple[int, int]) -> Camera:
    return Camera(_checked(K, path, shape), path.name)


def scaled_cameras(calibration: Calibration, shape: tuple[int, int]) -> Float[np.ndarray, "n 3 3"]:
    """Cameras of a calibration, scaled to images of `shape`; `SequenceError` if they do not fit."""
    height, width = calibration.shape or shape
    if not (height > 0 and width > 0 and same_aspect((height, width), shape)):
        raise SequenceError(
            f"{calibration.source} is of images of {size((height, width))} pixels, but the depth "
            f"images are {size(shape)}; expected the camera of the depth images: write its matrix "
            "to cam_K.txt, and remove the other file."
        )
    scaled = _scaled(calibration.matrices, (height, width), shape)
    return np.stack([_checked(K, calibration.source, shape) for K in scaled])


def matrices_of(fx: Any, fy: Any, cx: Any, cy: Any) -> Float[np.ndarray, "n 3 3"]:
    """Camera matrices from their parameters, each one number or one per frame."""
    fx, fy, cx, cy = np.broadcast_arrays(*(np.atleast_1d(one) for one in (fx, fy, cx, cy)))
    matrices = np.tile(np.eye(3), (len(fx), 1, 1))
    matrices[:, 0, 0], matrices[:, 1, 1] = fx, fy
    matrices[:, 0, 2], matrices[:, 1, 2] = cx, cy
    return matrices


def default_camera(default: DefaultCamera, folder: Path, shape: tuple[int, int]) -> Camera:
    """A known camera, scaled to images of `shape`; `SequenceError` if the aspect differs."""
    if not same_aspect(shape, (480, 640)):
        raise SequenceError(
            f"{folder} holds no camera, and {default.source} makes images of 640 x 480, "
            f"not of {size(shape)}; expected the 3x3 camera matrix: write it to cam_K.txt there."
        )
    intrinsics = np.diag([shape[1] / 640, shape[0] / 480, 1]) @ _from_opencv(*default.numbers)
    return Camera(intrinsics, default.source, distortion=default.distortion)


def guessed(camera: Camera) -> Finding:
    """The remark on a camera that is a guess."""
    fx, fy, cx, cy = intrinsic_numbers(camera.intrinsics)
    return Finding(
        f"no camera file; focal lengths {fx:g}, {fy:g} and principal point {cx:g}, {cy:g} are "
        f"taken from {camera.source}",
        "Write fx 0 cx / 0 fy cy / 0 0 1 to cam_K.txt in the folder: an error of 5 % in the "
        "focal length bends the surface and the camera's path.",
    )


def distorted(numbers: Iterable[float], source: object) -> tuple[Finding, ...]:
    """The remark on the numbers of a lens distortion, if they bend the images visibly."""
    numbers = tuple(numbers)
    if all(abs(one) < _BENT for one in numbers):
        return ()
    return (
        Finding(
            f"{source} has the lens distortion {', '.join(f'{one:g}' for one in numbers)}, which "
            "is ignored",
            "Undistort depth and colour images first: otherwise surfaces are bent towards the rim "
            "of the images.",
        ),
    )


def intrinsic_numbers(K: Float[np.ndarray, "3 3"]) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy of a camera matrix."""
    return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])


def _from_opencv(fx: float, fy: float, cx: float, cy: float) -> Matrix:
    return np.array([[fx, 0, cx + 0.5], [0, fy, cy + 0.5], [0, 0, 1]])


def _read_ours(path: Path) -> tuple[Matrix, tuple[float, ...]]:
    return read_matrix(path, 3), ()


def _read_opencv(path: Path) -> tuple[Matrix, tuple[float, ...]]:
    K = read_matrix(path, 3)
    K[:2, 2] += 0.5
    return K, ()


def _read_numbers(path: Path) -> tuple[Matrix, tuple[float, ...]]:
    """Four numbers, as ETH3D's SLAM benchmark writes them, and perhaps the lens distortion after
    them; or a matrix."""
    try:
        words = [word for _, line in words_of(reading.read_text(path)) for word in line]
        if len(words) == 9 and [*map(float, words[6:])] == [0, 0, 1]:
            return _read_opencv(path)
        fx, fy, cx, cy, *distortion = map(float, words)
    except (OSError, ValueError) as error:
        raise SequenceError(
            f"{path} cannot be read as a camera ({error}); expected `fx fy cx cy`: write it again."
        ) from error
    return _from_opencv(fx, fy, cx, cy), tuple(distortion)


_FILES: dict[str, Callable[[Path], tuple[Matrix, tuple[float, ...]]]] = {
    "camera-intrinsics.txt": _read_ours,
    "cam_K.txt": _read_opencv,
    "calibration.txt": _read_numbers,
}


def _read_json(path: Path, shape: tuple[int, int]) -> Camera | None:
    """Open3D's PinholeCameraIntrinsic, of a film perhaps with a depth scale, or the first of a
    trajectory; None if it is neither."""
    try:
        content = reading.read_json(path)
        if "parameters" in content:
            content = next(iter(content["parameters"]), {}).get("intrinsic", {})
        if "intrinsic_matrix" not in content:
            return None
        K = reading.numbers_of(content["intrinsic_matrix"], (3, 3)).T
        height, width = content.get("height", shape[0]), content.get("width", shape[1])
        scale = content.get("depth_scale")
        scale = None if scale is None else float(reading.numbers_of(scale, ()))
        if scale is not None and not scale > 0:
            raise ValueError(f"its depth_scale is {scale:g}, not above 0")
    except (OSError, ValueError, AttributeError, TypeError) as error:
        raise SequenceError(
            f"{path} cannot be read as a camera ({type(error).__name__}: {error}); expected "
            "Open3D's JSON with width, height and intrinsic_matrix by columns: write it again."
        ) from error
    height, width = shape_of(height, width, path)
    if not same_aspect((height, width), shape):
        raise SequenceError(
            f"{path} is of images of {width} x {height}, but the depth images are {size(shape)}; "
            "expected the camera of the depth images: write that one."
        )
    K[:2, 2] += 0.5
    camera = _camera(_scaled(K, (height, width), shape), path, shape)
    return camera._replace(depth_scale=scale)


def _scaled(
    K: Float[np.ndarray, "*n 3 3"], of: tuple[int, int], shape: tuple[int, int]
) -> Float[np.ndarray, "*n 3 3"]:
    """Cameras of images of size `of`, scaled to images of size `shape`."""
    return np.array([[shape[1] / of[1]], [shape[0] / of[0]], [1.0]]) * K


def _checked(K: Matrix, path: Path | str, shape: tuple[int, int]) -> Matrix:
    """The matrix; `SequenceError` if it cannot belong to images of `shape`."""
    (h, w), (fx, fy, cx, cy) = shape, intrinsic_numbers(K)
    if not (np.isfinite(K).all() and min(fx, fy) > 0 and np.array_equal(K[2], (0, 0, 1))):
        raise SequenceError(
            f"{path} has focal lengths {fx:g}, {fy:g} and last row {K[2].tolist()}; "
            "expected positive focal lengths in pixels and 0 0 1: write fx 0 cx / 0 fy cy / 0 0 1."
        )
    if max(abs(K[0, 1]), abs(K[1, 0])) > 0.01 * min(fx, fy):
        raise SequenceError(
            f"{path} has {K[0, 1]:g} and {K[1, 0]:g} beside its focal lengths {fx:g}, {fy:g}; "
            "expected 0, as pixels have no skew: write fx 0 cx / 0 fy cy / 0 0 1."
        )
    if not 0.05 < min(fx, fy) / max(h, w) <= max(fx, fy) / max(h, w) < 100:
        raise SequenceError(
            f"{path} has focal lengths {fx:g}, {fy:g}, with which images of {size(shape)} pixels "
            "would be wider than 160 degrees or narrower than 1: expected them in pixels; write "
            "fx 0 cx / 0 fy cy / 0 0 1."
        )
    # Within the middle 90 %, since a matrix for images of twice the size would put it at a corner.
    if not all(0.05 < c / n < 0.95 for c, n in ((cx, w), (cy, h))):
        raise SequenceError(
            f"{path} has its principal point at {cx:g}, {cy:g}; expected it well "
            f"inside the images of {size(shape)} pixels: scale the matrix with the images."
        )
    return K
