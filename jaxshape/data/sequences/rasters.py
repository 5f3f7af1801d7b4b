"""Image files of a few formats, and arrays that are images; sizes are checked before decoding."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image
from PIL.PpmImagePlugin import PpmImageFile

from jaxshape import limits, reading
from jaxshape.data.sequences.errors import SequenceError

FORMATS = ("PNG", "JPEG", "TIFF", "PPM")
"""Formats that Pillow may decode (PPM includes PGM); formats that start other programs are
excluded."""


_MOST = np.iinfo(np.int32).max


class Stored(NamedTuple):
    """An image that is an array in a larger file.

    Attributes:
        name: Name of the image for messages, such as `scan.npz: depth 3`.
        pixels: The image `[h w]` or `[h w 3]`.
    """

    name: str
    pixels: np.ndarray

    def __str__(self) -> str:
        return self.name


Picture = Path | Stored
"""Source of an image: a file, or an array."""


@contextmanager
def open_picture(picture: Picture, most: int) -> Iterator[Image.Image]:
    """Open an image of any kind for the block that decodes it.

    Args:
        picture: The image.
        most: Largest number of pixels.

    Raises:
        OSError: It cannot be opened.
        ValueError: It is damaged, not a regular file, or larger than `most`.
        SequenceError: It is an EXR image, and the package that reads EXR is not installed.
    """
    if isinstance(picture, Stored):
        yield _from_array(picture.pixels, most)
        return
    suffix = picture.suffix.lower()
    with reading.opened(picture, limits.IMAGE_BYTES) as file:
        if suffix == ".exr":
            yield _from_array(_read_exr(picture, most), most)
        elif suffix == ".npy":  # memory-mapped, so that a false header takes no memory
            yield _from_array(np.load(picture, mmap_mode="r", allow_pickle=False), most)
        else:
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", module="PIL")  # only errors matter
                with Image.open(file, formats=FORMATS) as image:
                    image.filename = str(picture)
                    _check_size(image.width, image.height, most)
                    _keep_numbers(image)
                    yield image


def _check_size(width: int, height: int, most: int) -> None:
    if not 0 < width * height <= most:
        raise ValueError(f"it has {width} x {height} pixels; {most:,} at most are read")


def _keep_numbers(image: Image.Image) -> None:
    """Undo that Pillow stretches the numbers of a PGM file of 16 bits, from the largest one that
    its header allows, to 65535."""
    if isinstance(image, PpmImageFile) and image.mode == "I":
        tile = image.tile[0]
        if isinstance(tile.args, tuple):  # it ends with the largest number
            image.tile = [tile._replace(args=(*tile.args[:-1], 65535))]


def _from_array(array: Any, most: int) -> Image.Image:
    """An image from an array; whole numbers other than 8 and 16 bit unsigned get 32 bits, and
    others become floats."""
    array = np.asarray(array)
    if array.ndim == 3 and array.shape[0] == 1:
        array = array[0]
    elif array.ndim == 3 and array.shape[2] == 1:
        array = array[..., 0]
    if array.ndim != 2 and not (array.ndim == 3 and array.shape[2] == 3) or array.size == 0:
        raise ValueError(f"it is an array of shape {array.shape}, not of an image")
    _check_size(array.shape[1], array.shape[0], most)
    if array.dtype == bool:
        return Image.fromarray(array.astype(np.uint8) * 255)
    if array.dtype not in (np.uint8, np.uint16):
        if array.dtype.kind not in "iuf":
            raise ValueError(f"it is an array of {array.dtype}, not of numbers")
        if array.dtype.kind in "iu":
            array = array.astype(np.int64).clip(0, _MOST).astype(np.int32)  # no depth is below 0
        else:
            with np.errstate(over="ignore"):
                array = array.astype(np.float32)
    return Image.fromarray(np.ascontiguousarray(array))


def _read_exr(path: Path, most: int) -> np.ndarray:
    """The depth channel of an EXR file."""
    try:
        import OpenEXR  # type: ignore[import-not-found]
    except ImportError:
        raise SequenceError(
            f"{path} is an EXR image, which needs a package of its own to be read: pip install "
            "'jaxshape[exr]', or save the depth images as 16-bit PNG in millimetres."
        ) from None
    with OpenEXR.File(str(path), header_only=True) as file:
        header = file.header()
        (left, top), (right, bottom) = (map(int, corner) for corner in header["dataWindow"])
        if len(header["channels"]) > limits.IMAGE_CHANNELS:
            raise ValueError(f"it has {len(header['channels'])} channels")
    _check_size(right - left + 1, bottom - top + 1, most)
    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = {name: np.array(one.pixels) for name, one in file.channels().items()}
    return channels[depth_channel(list(channels))]


def depth_channel(names: list[str]) -> str:
    """The channel of an EXR file that is called depth, or else Z, V, Y or R, or the only one.

    Args:
        names: Names of the channels, perhaps with a layer, such as `ViewLayer.Depth.Z`.

    Raises:
        ValueError: No name, or more than one, is that of a depth channel.
    """
    called = [name for name in names if "depth" in name.lower()]
    by_end = ([name for name in names if name.rsplit(".")[-1] == end] for end in "ZVYR")
    for found in (called, *by_end, names):
        if len(found) == 1:
            return found[0]
    raise ValueError(f"none of its channels ({', '.join(names)}) is the one that is called depth")
