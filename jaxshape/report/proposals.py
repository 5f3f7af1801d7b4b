"""A picture of the objects that a frame shows, with their numbers. [host]"""

import os
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image, ImageDraw, ImageFont

from jaxshape.files import atomic_path
from jaxshape.report.palette import CYCLE, INK
from jaxshape.report.pictures import rgb

_WIDTH = 960
"""Width, in pixels, to which smaller images are enlarged."""

_TINT = 0.55
"""Weight with which the colour of an object is mixed into its pixels."""


def write_proposals(
    path: str | os.PathLike[str],
    depth: Float[np.ndarray, "h w"],
    color: UInt8[np.ndarray, "h w 3"] | None,
    proposals: Sequence[Bool[np.ndarray, "h w"]],
    numbers: Sequence[int] | None = None,
) -> None:
    """Write a picture of a frame in which each object has a colour and its number.

    Args:
        path: The picture; its suffix names the format.
        depth: Depth image `[h w]`, in metres, which is shown in grey where there is no colour.
        color: Colour image `[h w 3]`; None for none.
        proposals: Pixels of each object `[h w]`.
        numbers: Their numbers; None for 1, 2, ...
    """
    numbers = range(1, len(proposals) + 1) if numbers is None else numbers
    colors = [CYCLE[(number - 1) % len(CYCLE)] for number in numbers]
    canvas = np.array(_grey(depth) if color is None else color, np.float64)
    for color_of, segmented in zip(colors, proposals, strict=True):
        tint = 255 * rgb(color_of)
        canvas[segmented] = (1 - _TINT) * canvas[segmented] + _TINT * tint
    k = max(1, round(_WIDTH / depth.shape[1]))
    image = Image.fromarray(np.rint(canvas).astype(np.uint8))
    image = image.resize((k * image.width, k * image.height), Image.Resampling.NEAREST)
    for number, color_of, segmented in zip(numbers, colors, proposals, strict=True):
        row, column = _middle(segmented)
        _write_number(image, str(number), (k * column, k * row), color_of)
    with atomic_path(path) as temporary:
        image.save(temporary)


def _grey(depth: Float[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Near pixels light, far ones dark, and black where nothing was measured."""
    known = (depth > 0) & np.isfinite(depth)
    low, high = np.percentile(depth[known], (1, 99)) if known.any() else (0.0, 1.0)
    shade = 230 - 180 * np.clip((depth - low) / max(high - low, 1e-6), 0, 1)
    return np.repeat(np.where(known, shade, 0).astype(np.uint8)[..., None], 3, axis=-1)


def _middle(segmented: Bool[np.ndarray, "h w"]) -> tuple[float, float]:
    """The pixel of an object that is nearest to the mean of its pixels, so that a number lies on
    it."""
    pixels = np.argwhere(segmented)
    if not len(pixels):
        return 0.0, 0.0
    nearest = pixels[np.argmin(np.sum((pixels - pixels.mean(axis=0)) ** 2, axis=1))]
    return float(nearest[0]) + 0.5, float(nearest[1]) + 0.5


def _write_number(image: Image.Image, text: str, at: tuple[float, float], color: str) -> None:
    draw, radius = ImageDraw.Draw(image), image.width / 42
    x, y = (min(max(c, radius), size - radius) for c, size in zip(at, image.size, strict=True))
    draw.ellipse(
        (x - radius, y - radius, x + radius, y + radius), fill="white", outline=color, width=3
    )
    font = ImageFont.load_default(size=round(1.4 * radius))
    draw.text((x, y), text, fill=INK, font=font, anchor="mm")
