"""Images that Pillow does not read: arrays of `.npy` and `.npz` files, and EXR."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from jaxshape.data.sequences.errors import SequenceError

MAX_PIXELS = 64_000_000
"""Pixels up to which an image is decoded."""


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
"""Where an image is: a file of its own, or an array."""


def open_picture(picture: Picture) -> Image.Image:
    """Open an image of any kind; raises `OSError`, `ValueError` or `SyntaxError` if damaged."""
    if isinstance(picture, Stored):
        return _from_array(picture.pixels)
    if not picture.is_file():
        raise OSError("it is missing, or not a regular file")
    read = {".npy": _read_npy, ".exr": _read_exr}.get(picture.suffix.lower())
    image = Image.open(picture) if read is None else _from_array(read(picture))
    if image.width * image.height > MAX_PIXELS:
        raise ValueError(f"it has {image.width} x {image.height} pixels")
    return image


def _read_npy(path: Path) -> np.ndarray:
    # Mapped, so that a header that promises more than the file holds is refused before memory is.
    return np.load(path, mmap_mode="r", allow_pickle=False)


def _from_array(array: Any) -> Image.Image:
    """An image of a depth map, a mask or colours; other numbers than bytes and 16 bit as floats."""
    array = np.asarray(array)
    if array.ndim == 3 and array.shape[0] == 1:
        array = array[0]
    elif array.ndim == 3 and array.shape[2] == 1:
        array = array[..., 0]
    if array.ndim != 2 and not (array.ndim == 3 and array.shape[2] == 3) or array.size == 0:
        raise ValueError(f"it is an array of shape {array.shape}, not of an image")
    if array.shape[0] * array.shape[1] > MAX_PIXELS:
        raise ValueError(f"it has {array.shape[1]} x {array.shape[0]} pixels")
    if array.dtype == bool:
        return Image.fromarray(array.astype(np.uint8) * 255)
    if array.dtype not in (np.uint8, np.uint16):
        if array.dtype.kind not in "iuf":
            raise ValueError(f"it is an array of {array.dtype}, not of numbers")
        array = array.astype(np.float32)
    return Image.fromarray(np.ascontiguousarray(array))


def _read_exr(path: Path) -> np.ndarray:
    """The depth channel of an EXR file: Z, Y, R or the only one."""
    try:
        import OpenEXR  # type: ignore[import-not-found]
    except ImportError:
        raise SequenceError(
            f"{path} is an EXR image, which needs a package of its own to be read: pip install "
            "'jaxshape[exr]', or save the depth images as 16-bit PNG in millimetres."
        ) from None
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: np.array(one.pixels) for name, one in file.channels().items()}
    except (RuntimeError, TypeError) as error:
        raise ValueError(str(error)) from error
    for name in ("Z", "Y", "R", *channels):
        if name in channels:
            return channels[name]
    raise ValueError("it has no channel")
