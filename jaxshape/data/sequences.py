"""Read posed RGB-D sequences.

A layout is one function: it lists the files, and returns a lazy `Sequence`. Frames are read, and
checked, one at a time when asked for, so a long sequence never fills the memory.
"""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image

MILLIMETRES = 1000.0
"""Depth units per metre of a depth image in millimetres."""

_USUAL_DEPTH_SCALES = (1.0, 256.0, 1000.0, 5000.0, 10000.0)
_PLAUSIBLE_MEDIAN_DEPTH = (0.1, 20.0)  # metres: what depth cameras reach, with room to spare
_USUAL_MEDIAN_DEPTH = 2.0  # metres: an object in a room


class SequenceError(ValueError):
    """A sequence on disk is not what its layout promises; says which file, and what to do."""


class Frame(NamedTuple):
    """One posed RGB-D image."""

    name: str
    depth: Float[np.ndarray, "h w"]
    """z along the optical axis in metres, float32; 0 where nothing was measured."""
    color: UInt8[np.ndarray, "h w 3"] | None
    T_world_camera: Float[np.ndarray, "4 4"]
    mask: Bool[np.ndarray, "h w"] | None
    """True on the object; None where no mask was given."""


class FrameFiles(NamedTuple):
    """Where the images of one frame lie."""

    name: str
    depth: Path
    color: Path | None
    mask: Path | None


@dataclass(frozen=True, eq=False)
class Sequence:
    """A lazy sequence of frames: `len`, indexing and iteration read one frame at a time."""

    intrinsics: Float[np.ndarray, "3 3"]
    files: tuple[FrameFiles, ...]
    read_pose: Callable[[int], Float[np.ndarray, "4 4"]]
    """Index of a frame to its T_world_camera, checked."""
    shape: tuple[int, int]
    """Height and width which all images share, in pixels."""
    depth_scale: float
    """Depth units per metre."""

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(files.name for files in self.files)

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, index: int) -> Frame:
        name, depth, color, mask = self.files[index]
        return Frame(
            name=name,
            depth=read_depth(depth, self.shape, depth_scale=self.depth_scale),
            color=None if color is None else _read_color(color, self.shape),
            T_world_camera=self.read_pose(index),
            mask=None if mask is None else _read_mask(mask, self.shape),
        )

    def __iter__(self) -> Iterator[Frame]:
        return (self[index] for index in range(len(self)))


# Layouts ---------------------------------------------------------------------------------------


def open_sequence(path: str | Path, *, depth_scale: float = MILLIMETRES) -> Sequence:
    """Open a folder in the 7-Scenes layout (Shotton et al., CVPR 2013) without reading its images.

    The folder holds `frame-N.depth.png` (16 bit; 0 and 65535 invalid) and `frame-N.pose.txt` (4x4,
    camera to world) for every frame, and may hold `frame-N.color.png` or `.jpg` and
    `frame-N.mask.png` (non-zero on the object). `camera-intrinsics.txt` (3x3) lies in the folder
    or in its parent. N has any number of digits; frames come in the order of their numbers.
    `depth_scale` is the number of depth units in a metre.

    Raises `SequenceError` for missing files and for intrinsics that do not fit the images; the
    images and poses are checked when their frame is read.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise SequenceError(f"{folder} is not a folder; give the one that holds frame-*.depth.png.")
    if not depth_scale > 0:
        raise SequenceError(
            f"The depth scale is {depth_scale}; expected the number of depth units in a metre, "
            "which is positive: 1000 for millimetres."
        )
    frames = _seven_scenes_frames(folder)
    with _opened(frames[0].depth) as image:
        shape = (image.height, image.width)
    poses = [files.depth.with_name(f"{files.name}.pose.txt") for files in frames]
    return Sequence(
        intrinsics=_read_intrinsics(_find_intrinsics(folder), shape),
        files=frames,
        read_pose=lambda index: _read_pose(poses[index]),
        shape=shape,
        depth_scale=float(depth_scale),
    )


def _seven_scenes_frames(folder: Path) -> tuple[FrameFiles, ...]:
    present = {path.name for path in folder.iterdir()}
    matches = (re.fullmatch(r"frame-(\d+)\.(depth|pose)\..+", name) for name in present)
    numbers = {match[1] for match in matches if match}
    if not numbers:
        raise SequenceError(
            f"{folder} holds no frame-*.depth.png; expected the 7-Scenes layout: give the folder "
            "that holds the frames themselves."
        )

    def first_of(*names: str) -> Path | None:
        return next((folder / name for name in names if name in present), None)

    def files(name: str) -> FrameFiles:
        for required in (f"{name}.depth.png", f"{name}.pose.txt"):
            if required not in present:
                raise SequenceError(
                    f"{folder / required} is missing; every frame needs a depth image and a pose: "
                    f"add it, or remove the other files of {name}."
                )
        return FrameFiles(
            name=name,
            depth=folder / f"{name}.depth.png",
            color=first_of(f"{name}.color.png", f"{name}.color.jpg"),
            mask=first_of(f"{name}.mask.png"),
        )

    return tuple(files(f"frame-{number}") for number in sorted(numbers, key=int))


def _find_intrinsics(folder: Path) -> Path:
    for place in (folder, folder.resolve().parent):
        if (place / "camera-intrinsics.txt").is_file():
            return place / "camera-intrinsics.txt"
    raise SequenceError(
        f"camera-intrinsics.txt is missing; expected the 3x3 camera matrix in {folder} or in its "
        "parent folder: write it there."
    )


# Images ----------------------------------------------------------------------------------------


def read_depth(
    path: Path, shape: tuple[int, int], *, depth_scale: float
) -> Float[np.ndarray, "h w"]:
    """Read a 16-bit depth image as metres in float32; 0 where it holds 0 or 65535.

    Raises `SequenceError` if the image is damaged, not 16 bit, not of height and width `shape`, or
    if its median depth shows that `depth_scale` is wrong.
    """
    with _opened(path, shape) as image:
        if image.mode not in ("I;16", "I"):
            raise SequenceError(
                f"{path} has Pillow mode {image.mode}; expected a depth image with one channel of "
                "16 bit: save it again without conversion."
            )
        raw = np.array(image, dtype=np.float32)
    valid = (raw > 0) & (raw < 65535)
    depth = np.where(valid, raw / np.float32(depth_scale), np.float32(0))
    if valid.any():
        _check_depth_scale(path, float(np.median(depth[valid])), depth_scale)
    return depth


def _check_depth_scale(path: Path, median: float, depth_scale: float) -> None:
    low, high = _PLAUSIBLE_MEDIAN_DEPTH
    if low <= median <= high:
        return
    usual = median * depth_scale / _USUAL_MEDIAN_DEPTH
    likely = min(_USUAL_DEPTH_SCALES, key=lambda scale: abs(np.log(scale / usual)))
    raise SequenceError(
        f"{path}: the median depth is {_readable_length(median)} at depth scale {depth_scale:g}; "
        f"expected {low:g} to {high:g} m: is --depth-scale {likely:g} meant?"
    )


def _readable_length(metres: float) -> str:
    if metres >= 1000:
        return f"{metres / 1000:.3g} km"
    return f"{metres:.3g} m" if metres >= 0.1 else f"{metres * 1000:.3g} mm"


def _read_color(path: Path, shape: tuple[int, int]) -> UInt8[np.ndarray, "h w 3"]:
    with _opened(path, shape) as image:
        return np.array(image.convert("RGB"))


def _read_mask(path: Path, shape: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    with _opened(path, shape) as image:
        pixels = np.array(image)
    return pixels != 0 if pixels.ndim == 2 else (pixels[..., :3] != 0).any(axis=-1)  # not alpha


@contextmanager
def _opened(path: Path, shape: tuple[int, int] | None = None) -> Iterator[Image.Image]:
    """Open an image for the block that decodes it, and check its height and width, if given."""
    try:
        with Image.open(path) as image:
            if shape is not None and (image.height, image.width) != shape:
                raise SequenceError(
                    f"{path} is {image.width} x {image.height} pixels; expected {_size(shape)} as "
                    "the first depth image: scale it to that size, or remove it."
                )
            yield image
    except (OSError, SyntaxError) as error:  # Pillow raises either for a damaged file
        raise SequenceError(
            f"{path} cannot be read as an image ({error}); expected a whole image file: copy it "
            "again from its source, or remove the frame."
        ) from error


def _size(shape: tuple[int, int]) -> str:
    return f"{shape[1]} x {shape[0]}"


# Poses and intrinsics --------------------------------------------------------------------------


def _read_matrix(path: Path, size: int) -> Float[np.ndarray, "n n"]:
    try:
        rows = [[_number(word) for word in line.split()] for line in path.read_text().splitlines()]
        matrix = np.array([row for row in rows if row], dtype=np.float64)
        if matrix.shape != (size, size):
            raise ValueError(f"its lines hold {[len(row) for row in rows]} numbers")
    except (OSError, ValueError) as error:
        raise SequenceError(
            f"{path} is not a matrix ({error}); expected {size} lines of {size} numbers: write it "
            "again."
        ) from error
    return matrix


def _number(word: str) -> float:
    return np.nan if "#" in word else float(word)  # Windows wrote 1.#INF and -1.#IND


def _read_pose(path: Path) -> Float[np.ndarray, "4 4"]:
    pose = _read_matrix(path, 4)
    check_rigid(pose, path)
    return pose


def check_rigid(T: Float[np.ndarray, "4 4"], source: object) -> None:
    """Raise `SequenceError`, naming `source`, unless a matrix is a rigid motion."""
    R = T[:3, :3]
    if not np.isfinite(T).all():
        raise SequenceError(
            f"{source} holds NaN or infinity; expected a rigid motion: 7-Scenes writes such poses "
            "where its tracking was lost, so remove the files of that frame."
        )
    if np.abs(T[3] - (0, 0, 0, 1)).max() > 1e-6:
        fault = f"has the last row {T[3].tolist()}"
        remedy = "transpose it if it is stored by columns"
    elif (stretch := np.abs(R.T @ R - np.eye(3)).max()) > 1e-2:
        fault = f"has axes that are not orthonormal (R^T R differs from I by {stretch:.2g})"
        remedy = "divide out its scale, or remove the frame"
    elif np.linalg.det(R) < 0:
        fault = "mirrors (its determinant is negative)"
        remedy = "change the sign of one axis of the frame it maps to or from"
    else:
        return
    raise SequenceError(
        f"{source} {fault}; expected a rigid motion with the last row 0 0 0 1: {remedy}."
    )


def _read_intrinsics(path: Path, shape: tuple[int, int]) -> Float[np.ndarray, "3 3"]:
    K = _read_matrix(path, 3)
    (h, w), focal, center = shape, (K[0, 0], K[1, 1]), (K[0, 2], K[1, 2])
    if not (np.isfinite(K).all() and min(focal) > 0 and np.array_equal(K[2], (0, 0, 1))):
        raise SequenceError(
            f"{path} has focal lengths {focal[0]:g}, {focal[1]:g} and last row {K[2].tolist()}; "
            "expected positive focal lengths in pixels and 0 0 1: write fx 0 cx / 0 fy cy / 0 0 1."
        )
    # Within the middle 90 %, since a matrix for images of twice the size puts it at the corner.
    if not all(0.05 < c / size < 0.95 for c, size in zip(center, (w, h), strict=True)):
        raise SequenceError(
            f"{path} has its principal point at {center[0]:g}, {center[1]:g}; expected it well "
            f"inside the images of {_size(shape)} pixels: scale the matrix with the images."
        )
    return K


# Are the poses inverted? -----------------------------------------------------------------------


class PoseAgreement(NamedTuple):
    """Share of depth pixels which a neighbouring frame sees at the same place, from 0 to 1."""

    as_given: float
    inverted: float
    pairs: int
    """How many pairs of frames were compared; the shares are 0 if there were none."""


def poses_look_inverted(sequence: Sequence) -> bool:
    """Whether the depth images agree better if each pose is taken as world to camera.

    Evidence, not proof: it needs overlapping frames between which the camera moved, and a scene
    that is more than one plane the camera slides along. Where it cannot tell, the answer is False.
    """
    agreement = pose_agreement(sequence)
    return agreement.inverted > agreement.as_given + 0.1


def pose_agreement(sequence: Sequence, *, pairs: int = 8) -> PoseAgreement:
    """Compare frames from all over a sequence with near ones, under both readings of the poses."""
    K, shares = sequence.intrinsics, []
    for first in np.unique(np.linspace(0, len(sequence) - 1, pairs, dtype=int)):
        if (second := _telling_neighbour(sequence, int(first))) is not None:
            a, b = sequence[int(first)], sequence[second]
            motions = _relative_motions(a.T_world_camera, b.T_world_camera)
            shares.append([_same_surface(a.depth, b.depth, K, T_b_a) for T_b_a in motions])
    as_given, inverted = np.mean(shares, axis=0) if shares else (0.0, 0.0)
    return PoseAgreement(float(as_given), float(inverted), len(shares))


def _relative_motions(
    T_a: Float[np.ndarray, "4 4"], T_b: Float[np.ndarray, "4 4"]
) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "4 4"]]:
    """Return T_b_a if the poses map camera to world, and T_b_a if they map world to camera."""
    return np.linalg.inv(T_b) @ T_a, T_b @ np.linalg.inv(T_a)


def _telling_neighbour(sequence: Sequence, first: int) -> int | None:
    """Return the next frame, of 30, for which the two readings differ by 10 cm at 2 m."""
    T_a, ahead = sequence.read_pose(first), np.array([0.0, 0.0, 2.0, 1.0])
    for second in range(first + 1, min(first + 31, len(sequence))):
        given, inverted = _relative_motions(T_a, sequence.read_pose(second))
        if np.linalg.norm((given - inverted) @ ahead) > 0.1:
            return second
    return None


def _same_surface(
    depth_a: Float[np.ndarray, "h w"],
    depth_b: Float[np.ndarray, "h w"],
    K: Float[np.ndarray, "3 3"],
    T_b_a: Float[np.ndarray, "4 4"],
) -> float:
    """Share of the valid pixels of `a` which, moved to `b`, lie within 3 % of its depth."""
    step = max(1, depth_a.shape[1] // 80)
    row, column = np.nonzero(depth_a[::step, ::step])
    row, column = row * step, column * step
    pixel = np.stack([column + 0.5, row + 0.5, np.ones(len(row))])
    p_a = np.linalg.inv(K) @ pixel * depth_a[row, column]
    p_b = T_b_a[:3, :3] @ p_a + T_b_a[:3, 3:]
    u, v, z = K @ p_b
    with np.errstate(divide="ignore", invalid="ignore"):
        column, row = np.floor(u / z), np.floor(v / z)
    h, w = depth_b.shape
    seen = (z > 0) & (column >= 0) & (column < w) & (row >= 0) & (row < h)
    measured = depth_b[row[seen].astype(int), column[seen].astype(int)]
    return float(np.sum(np.abs(measured - z[seen]) < 0.03 * z[seen]) / max(len(z), 1))
