"""Frames of an RGB-D recording, read and checked one at a time, on request."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import islice
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from PIL import ExifTags, Image

from jaxshape import limits
from jaxshape.data.sequences.errors import SequenceError as SequenceError
from jaxshape.data.sequences.rasters import Picture, open_picture

SATURATED = 65535
"""The largest number of 16 bits, which depth cameras write where they have no reliable depth; read
as 0, unknown."""

BACKGROUND = 1e9
"""Least number that renderers write where there is nothing, for images of more than 16 bits; depths
of 1 km in micrometres."""

USUAL_DEPTH_SCALES = (1.0, 256.0, 1000.0, 4000.0, 5000.0, 6553.5, 10000.0, 1e6)
"""Common depth units per metre."""

_PLAUSIBLE_MEDIAN_DEPTH = (0.1, 20.0)  # metres: the range of depth cameras, with a margin
_USUAL_MEDIAN_DEPTH = 2.0  # metres: an object in a room

_INSTANCE, _NUMBERED = 1e-3, 0.95
"""Least share of an image that an object in a numbered mask fills, and least share of the mask's
pixels that all numbered objects fill together."""

_TURNS = {
    2: "mirrored",
    3: "turned by 180 degrees",
    4: "mirrored and turned by 180 degrees",
    5: "mirrored and turned by 90 degrees",
    6: "turned clockwise by 90 degrees",
    7: "mirrored and turned by 90 degrees",
    8: "turned anticlockwise by 90 degrees",
}
"""What the EXIF orientation of an image asks for, other than 1."""

_CONFIDENT = 1  # of ARKit's ratings 0, 1 and 2 of depths: 0 is a guess


class Finding(NamedTuple):
    """A remark on a recording that can still be read.

    Attributes:
        evidence: The observation.
        advice: A remedy.
    """

    evidence: str
    advice: str

    @property
    def sentence(self) -> str:
        """Both, as sentences."""
        return f"{self.evidence.rstrip('.')}. {self.advice}"


class Frame(NamedTuple):
    """One RGB-D image.

    Attributes:
        name: Name of the frame, from its files.
        depth: Depth along the optical axis `[h w]`, in metres, float32; 0 where nothing was
            measured.
        color: Colour at the pixels of `depth` `[h w 3]`, scaled to its size; None without a colour
            image.
        T_world_camera: Pose of the camera `[4 4]`; None if no pose is given, or if the recorder's
            own tracking was lost.
        mask: True on the object `[h w]`; None if no mask is given.
        intrinsics: Camera matrix of this frame `[3 3]`, in pixels.
        time: Time of the depth image from any start, in seconds; None if the recording has no
            times.
        instances: Number of the object that each pixel shows `[h w]`, 0 for none; None if the mask
            does not number several objects.
    """

    name: str
    depth: Float[np.ndarray, "h w"]
    color: UInt8[np.ndarray, "h w 3"] | None
    T_world_camera: Float[np.ndarray, "4 4"] | None
    mask: Bool[np.ndarray, "h w"] | None
    intrinsics: Float[np.ndarray, "3 3"]
    time: float | None = None
    instances: Int[np.ndarray, "h w"] | None = None


class FrameFiles(NamedTuple):
    """Files of one frame.

    Attributes:
        name: Name of the frame.
        depth: Depth image.
        color: Colour image; None for none.
        mask: Mask of the object; None for none.
        confidence: Confidence of each depth, 0, 1 or 2; None for none. Depths of confidence 0 are
            left out.
    """

    name: str
    depth: Picture
    color: Picture | None
    mask: Picture | None
    confidence: Picture | None = None


CorrectDepth = Callable[
    [Float[np.ndarray, "h w"], Float[np.ndarray, "3 3"]], Float[np.ndarray, "h w"]
]


@dataclass(frozen=True, eq=False)
class Sequence:
    """A lazy sequence of frames: `len`, indexing and iteration read one frame at a time.

    Attributes:
        layout: Name of the layout on disk, a key of `LAYOUTS`.
        intrinsics: Camera matrix `[3 3]` of all depth images, or of the first if each has its own,
            in pixels, where column j covers u in [j, j + 1).
        camera: Source of the intrinsics.
        files: Files of each frame.
        read_pose: Function from the index of a frame, from 0, to its T_world_camera `[4 4]`,
            checked; it returns None for a frame without a pose.
        has_poses: Whether poses are given, perhaps not for every frame.
        shape: Height and width of all images when read, in pixels.
        depth_scale: Depth units per metre, above 0.
        times: Times of the depth images `[n]`, in seconds; None if the recording has no times.
        color_delays: Seconds from a depth image to its colour image `[n]`, NaN if it has none; None
            without times.
        findings: Remarks made on opening that a user should know.
        cameras: Camera matrix of each depth image `[n 3 3]`, in pixels; None if all images share
            `intrinsics`.
        camera_is_guess: Whether the recording holds no camera, so that the usual camera of such
            recordings is used.
        correct_depth: Function from a depth image as written, in metres, and its camera matrix to
            depth along the optical axis; None if no correction is needed.
    """

    layout: str
    intrinsics: Float[np.ndarray, "3 3"]
    camera: str
    files: tuple[FrameFiles, ...]
    read_pose: Callable[[int], Float[np.ndarray, "4 4"] | None]
    has_poses: bool
    shape: tuple[int, int]
    depth_scale: float
    times: Float[np.ndarray, " n"] | None = None
    color_delays: Float[np.ndarray, " n"] | None = None
    findings: tuple[Finding, ...] = ()
    cameras: Float[np.ndarray, "n 3 3"] | None = None
    camera_is_guess: bool = False
    correct_depth: CorrectDepth | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the frames."""
        return tuple(files.name for files in self.files)

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, index: int) -> Frame:
        index = range(len(self))[index]
        files = self.files[index]
        return Frame(
            name=files.name,
            depth=self.read_depth(index),
            color=None if files.color is None else read_color(files.color, self.shape),
            T_world_camera=self.read_pose(index),
            mask=None if files.mask is None else read_mask(files.mask, self.shape),
            intrinsics=self.camera_of(index),
            time=None if self.times is None else float(self.times[index]),
            instances=None if files.mask is None else read_instances(files.mask, self.shape),
        )

    def __iter__(self) -> Iterator[Frame]:
        return (self[index] for index in range(len(self)))

    def camera_of(self, index: int) -> Float[np.ndarray, "3 3"]:
        """The camera matrix of one depth image, in pixels.

        Args:
            index: Number of the frame, from 0.
        """
        return self.intrinsics if self.cameras is None else self.cameras[index]

    def read_depth(self, index: int) -> Float[np.ndarray, "h w"]:
        """Read only the depth image of one frame.

        Args:
            index: Number of the frame, from 0.
        """
        files = self.files[index]
        depth = read_depth(files.depth, self.shape, depth_scale=self.depth_scale)
        if files.confidence is not None:
            depth = np.where(_read_confident(files.confidence, self.shape), depth, np.float32(0))
        return (
            depth
            if self.correct_depth is None
            else self.correct_depth(depth, self.camera_of(index))
        )


# Depth -----------------------------------------------------------------------------------------


def read_depth(
    path: Picture, shape: tuple[int, int], *, depth_scale: float
) -> Float[np.ndarray, "h w"]:
    """Read a depth image as metres in float32; 0 where nothing was measured (`is_measured`).

    Args:
        path: The image.
        shape: Height and width that it must have, in pixels.
        depth_scale: Depth units per metre.

    Raises:
        SequenceError: The image is damaged, of 8 bits, in colour or of another size, or its median
            depth shows that `depth_scale` is wrong.
    """
    raw = read_raw_depth(path, shape)
    valid = is_measured(raw)
    depth = np.where(valid, raw / np.float32(depth_scale), np.float32(0))
    if valid.any() and (fault := depth_scale_fault(float(np.median(depth[valid])), depth_scale)):
        raise SequenceError(f"{path}: {fault.evidence}: {fault.advice}")
    return depth


def is_measured(raw: Float[np.ndarray, "*batch h w"]) -> Bool[np.ndarray, "*batch h w"]:
    """Whether the numbers of depth images, in any unit, are depths."""
    return (raw > 0) & (raw != SATURATED) & (raw < BACKGROUND)


def read_raw_depth(path: Picture, shape: tuple[int, int]) -> Float[np.ndarray, "h w"]:
    """Read the numbers of a depth image of 16 bits or of floats, in its own units."""
    with opened(path, limits.DEPTH_PIXELS) as image:
        if (image.height, image.width) != shape:
            raise SequenceError(
                f"{path} is {_size_of(image)} pixels; expected {size(shape)} as most of the "
                "first depth images: scale it to that size, or remove it."
            )
        if getattr(image, "is_animated", False):
            raise SequenceError(
                f"{path} holds several images; expected one: save each to a file of its own."
            )
        if image.mode not in ("I;16", "I;16B", "I", "F"):
            raise SequenceError(
                f"{path} has Pillow mode {image.mode}; expected a depth image with one channel of "
                "16 bit or of floats: save it again without conversion."
            )
        return np.array(image, dtype=np.float32)


def usual_depth_scale(pictures: Iterable[Picture]) -> float:
    """Default depth units per metre: floats are metres, integers millimetres."""
    for picture in islice(pictures, 20):
        # A damaged image tells nothing.
        with suppress(SequenceError), opened(picture, limits.DEPTH_PIXELS) as image:
            return 1.0 if image.mode == "F" else 1000.0
    return 1000.0


def _read_confident(path: Picture, shape: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """True where a confidence map rates a depth as more than a guess."""
    with opened(path) as image:
        _check_aspect(image, shape, path)
        pixels = np.array(image.resize((shape[1], shape[0]), Image.Resampling.NEAREST))
    if pixels.ndim != 2:
        raise SequenceError(f"{path} has colours; expected confidences of 0, 1 and 2: remove it.")
    return pixels >= _CONFIDENT


def depth_scale_fault(median: float, depth_scale: float) -> Finding | None:
    """A remark on the depth scale if a median depth, in metres, is implausible."""
    low, high = _PLAUSIBLE_MEDIAN_DEPTH
    if low <= median <= high:
        return None
    return Finding(
        f"the median depth is {_readable_length(median)} at depth scale {depth_scale:g}; expected "
        f"{low:g} to {high:g} m",
        f"is --depth-scale {likely_depth_scales(median, depth_scale)} meant?",
    )


def likely_depth_scales(median: float, depth_scale: float) -> str:
    """The common scales at which a median depth is plausible for an object in a room, in words."""
    usual = median * depth_scale / _USUAL_MEDIAN_DEPTH
    distance = {scale: abs(np.log(scale / usual)) for scale in USUAL_DEPTH_SCALES}
    nearest = min(distance, key=distance.__getitem__)
    near = [scale for scale in distance if distance[scale] < np.log(2)] or [nearest]
    *others, last = (f"{scale:g}" for scale in near)
    return f"{', '.join(others)} or {last}" if others else last


def _readable_length(metres: float) -> str:
    if metres >= 1000:
        return f"{metres / 1000:.3g} km"
    return f"{metres:.3g} m" if metres >= 0.1 else f"{metres * 1000:.3g} mm"


# Colour and masks ------------------------------------------------------------------------------


def read_color(path: Picture, shape: tuple[int, int]) -> UInt8[np.ndarray, "h w 3"]:
    """Read a colour image, scaled to `shape`; `SequenceError` if damaged or of another aspect."""
    with opened(path) as image:
        _check_aspect(image, shape, path)
        if image.mode in ("I;16", "I;16B", "I"):  # Pillow would cut at 255
            image = Image.fromarray(np.clip(np.array(image) >> 8, 0, 255).astype(np.uint8))
        color = image if image.mode == "RGB" else image.convert("RGB")
        scaled = color.resize((shape[1], shape[0]), Image.Resampling.BILINEAR)
    return np.array(scaled)


def read_turn(path: Picture) -> str | None:
    """Read how an image is to be shown by its EXIF orientation, which is not applied; None for as
    it is stored."""
    with opened(path) as image:
        if image.format == "TIFF":  # there Pillow applies it
            return None
        return _TURNS.get(image.getexif().get(ExifTags.Base.Orientation, 1))


def read_mask(path: Picture, shape: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """Read a mask, True where neither black nor transparent, scaled to `shape`; raises as
    `read_color` does."""
    pixels = _mask_pixels(path, shape)
    return pixels != 0 if pixels.ndim == 2 else (pixels != 0).any(axis=-1)


def read_instances(path: Picture, shape: tuple[int, int]) -> Int[np.ndarray, "h w"] | None:
    """Read the numbers of objects in a mask; None if it holds at most one object.

    The edges of a mask that was scaled have many different values, each on few pixels.
    """
    pixels = _mask_pixels(path, shape)
    if pixels.ndim != 2 or pixels.dtype.kind not in "ui":
        return None
    values, counts = np.unique(pixels[pixels > 0], return_counts=True)
    large = values[counts >= _INSTANCE * pixels.size]
    if len(large) < 2 or counts[np.isin(values, large)].sum() < _NUMBERED * counts.sum():
        return None
    return np.where(np.isin(pixels, large), pixels, 0).astype(int)


def _mask_pixels(path: Picture, shape: tuple[int, int]) -> np.ndarray:
    with opened(path) as image:
        _check_aspect(image, shape, path)
        return np.array(_black_around(image).resize((shape[1], shape[0]), Image.Resampling.NEAREST))


def _black_around(image: Image.Image) -> Image.Image:
    """The image of a mask, black but for the objects.

    If some pixels are transparent, the others are the object. In a JPEG, the object is what has a
    quarter of the largest brightness: compression leaves traces around it.
    """
    if image.format in ("JPEG", "MPO"):
        gray = np.array(image.convert("L"))
        return Image.fromarray(gray > gray.max() // 4)
    if image.mode in ("LA", "PA", "RGBA"):
        opacity = np.array(image.getchannel("A"))
        return image.convert("RGB") if opacity.all() else Image.fromarray(opacity > 0)
    return image.convert("RGB") if _is_painted(image) else image


def _is_painted(image: Image.Image) -> bool:
    """Whether only the colours of an image tell what is black, and not its numbers: it has a
    palette in which black is not the first colour."""
    if image.mode != "P":
        return False
    palette = image.getpalette() or []
    used = [palette[3 * i : 3 * i + 3] for i in np.unique(np.array(image)).tolist()]
    return palette[:3] != [0, 0, 0] and [0, 0, 0] in used


def _check_aspect(image: Image.Image, shape: tuple[int, int], path: Picture) -> None:
    if not same_aspect((image.height, image.width), shape):
        raise SequenceError(
            f"{path} is {_size_of(image)} pixels; expected {size(shape)} like the depth images, "
            "or another size of the same aspect ratio, so that both show the same: register it to "
            "the depth image, or remove it."
        )


def same_aspect(a: tuple[int, int], b: tuple[int, int]) -> bool:
    """Whether one image can be a scaled version of another: their aspects differ by at most 2 %."""
    return abs(a[0] * b[1] - a[1] * b[0]) <= 0.02 * a[1] * b[0]


# Image files -----------------------------------------------------------------------------------


@contextmanager
def opened(path: Picture, most: int = limits.COLOR_PIXELS) -> Iterator[Image.Image]:
    """Open an image of up to `most` pixels for the block that decodes it; `SequenceError` if it is
    damaged or larger."""
    try:
        with open_picture(path, most) as image:
            yield image
    except (SequenceError, MemoryError):
        raise
    except Exception as error:  # decoders of damaged files may raise anything
        raise SequenceError(
            f"{path} cannot be read as an image ({error}); expected a whole image file: copy it "
            "again from its source, or remove the frame."
        ) from error


def read_shape(path: Picture, most: int = limits.COLOR_PIXELS) -> tuple[int, int]:
    """Height and width of an image of up to `most` pixels, from its header alone."""
    with opened(path, most) as image:
        return image.height, image.width


def usual_shape(
    pictures: Iterable[Picture], most: int = limits.COLOR_PIXELS
) -> tuple[int, int] | None:
    """The height and width that most of the first images have, whose headers can be read, if any.

    The first five that can be read count, of up to 20 images.
    """
    shapes = Counter(islice(_shapes(islice(pictures, 20), most), 5))
    return shapes.most_common(1)[0][0] if shapes else None


def _shapes(pictures: Iterable[Picture], most: int) -> Iterator[tuple[int, int]]:
    for picture in pictures:
        with suppress(SequenceError):
            yield read_shape(picture, most)


def size(shape: tuple[int, int]) -> str:
    return f"{shape[1]} x {shape[0]}"


def _size_of(image: Image.Image) -> str:
    return size((image.height, image.width))
