"""RealSense recordings: a `.bag` unpacked by `rs-convert -r -p` to raw depth and colour images."""

import re
from pathlib import Path

import numpy as np

from jaxshape.data.sequences.errors import SequenceError
from jaxshape.data.sequences.frames import FrameFiles, usual_shape
from jaxshape.data.sequences.listing import Contents, Listed, with_colors_by_time
from jaxshape.data.sequences.rasters import Stored

_SIZES = (
    (1280, 720), (1024, 768), (848, 480), (640, 480), (640, 360), (480, 270), (424, 240),
    (320, 240), (256, 144),
)  # fmt: skip
"""Width and height of the depth images of these cameras; all have different numbers of pixels."""

_RAW, _COLOR = (
    re.compile(rf"(?:.*_)?{stem}_(\d+(?:\.\d*)?)\.{end}$", re.IGNORECASE)
    for stem, end in (("Depth", "raw"), ("Color", "png"))
)
_PAINTED = re.compile(r".+_Depth_(\d+(?:\.\d*)?)\.png$")  # not depth_12.png, which is depth
_Timed = list[tuple[float, Path]]


def fits(contents: Contents) -> bool:
    return bool(_timed(contents, _RAW) or _timed(contents, _PAINTED))


def list_frames(contents: Contents) -> Listed:
    """`NAME_Depth_MILLISECONDS.raw` of 16 bits in millimetres, `NAME_Color_MILLISECONDS.png`.

    A raw file does not contain its width. The width is that of the colour image, if depth was
    aligned to it; otherwise it is that of the only size of these cameras with the same number of
    pixels.
    """
    depth, color = _timed(contents, _RAW), _timed(contents, _COLOR)
    if not depth:
        has = (
            "shows depth in colours only"
            if _timed(contents, _PAINTED)
            else "holds no NAME_Depth_TIME.raw"
        )
        raise SequenceError(
            f"{contents.folder} {has}; unpack the .bag with rs-convert -r, which writes the depth "
            "itself."
        )
    shape = _shape([path for _, path in depth], [path for _, path in color])
    times = np.array([time for time, _ in depth]) / 1000
    offered = np.array([time for time, _ in color]) / 1000
    images, delays = with_colors_by_time(times, offered, [path for _, path in color])
    return Listed(
        files=tuple(
            FrameFiles(path.stem, _depth_image(path, shape), image, None)
            for (_, path), image in zip(depth, images, strict=True)
        ),
        depth_scale=1000.0,
        times=times,
        color_delays=delays if color else None,
    )


def _timed(contents: Contents, pattern: re.Pattern[str]) -> _Timed:
    """The files whose names match, with the milliseconds in their names, sorted by time."""
    found = ((pattern.match(name), name) for name in contents.files)
    return sorted((float(match[1]), contents.folder / name) for match, name in found if match)


def _shape(depth: list[Path], color: list[Path]) -> tuple[int, int]:
    """Height and width of raw depth images, from the first whose size fits."""
    shapes = [(height, width) for width, height in _SIZES]
    if (seen := usual_shape(color)) is not None:
        shapes.insert(0, seen)
    sizes = [path.stat().st_size for path in depth[:20]]
    for size in sizes:
        for height, width in shapes:
            if 2 * width * height == size:
                return height, width
    raise SequenceError(
        f"{depth[0]} holds {sizes[0]:,} bytes, which no depth image of a RealSense camera has; "
        "save depth as 16-bit PNG files in a folder depth/."
    )


def _depth_image(path: Path, shape: tuple[int, int]) -> Path | Stored:
    """The image in a file; for a file of another length, the file itself, so that reading fails."""
    try:
        pixels = np.memmap(path, "<u2", "r")
        return Stored(str(path), pixels.reshape(shape))
    except (OSError, ValueError):
        return path
