"""Statistics of a recording: of its poses, names and times, and of a sample of its images."""

import math
import re
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxshape.data.sequences.frames import (
    SATURATED,
    Sequence,
    SequenceError,
    depth_scale_fault,
    is_measured,
    read_color,
    read_mask,
    read_raw_depth,
    read_turn,
)
from jaxshape.data.sequences.hypotheses import Reading
from jaxshape.data.sequences.listing import number_pattern

SAMPLES = 12
"""Number of frames, spread over a recording, whose images are read."""

_COMMON = 0.01
"""Share of the valid pixels from which on they hold the same number hardly by chance."""


class Gap(NamedTuple):
    """Missing frames, between two frames with neighbouring numbers or times.

    Attributes:
        after: Name of the frame before the gap.
        before: Name of the frame after the gap.
        missing: Number of missing frames.
    """

    after: str
    before: str
    missing: int


class Depths(NamedTuple):
    """Figures of all pixels of the sampled depth images.

    Attributes:
        median: Median depth of the valid pixels, in metres; 0 if there are none.
        invalid: Share of pixels without depth, including saturated ones, from 0 to 1.
        saturated: Share of pixels that are saturated, from 0 to 1.
        sampled: Number of sampled images that could be read.
        black: Number of these images without any valid pixel.
        damaged: A sentence for each image that could not be read.
        beyond: A number that far more pixels hold than depths near it, as where nothing was
            measured, and the share of the valid pixels that hold it; None without one.
        negative: Share of pixels with a negative number, from 0 to 1.
    """

    median: float
    invalid: float
    saturated: float
    sampled: int
    black: int
    damaged: tuple[str, ...]
    beyond: tuple[float, float] | None = None
    negative: float = 0.0


class Poses(NamedTuple):
    """Figures of the poses of all frames.

    Attributes:
        known: Frames with a pose.
        length: Length of the camera's path between frames with poses, in metres.
        reading: Agreement of the poses with the depth images, as written and in other conventions.
        damaged: A sentence for each pose that cannot be used.
        is_used: Whether the recording is read in the best convention of `reading`.
    """

    known: int
    length: float
    reading: Reading
    damaged: tuple[str, ...]
    is_used: bool = False

    @property
    def agreement(self) -> float:
        """Share of pixels on which neighbouring frames agree, as the recording is read."""
        best = self.reading.best
        return best.share if self.is_used and best is not None else self.reading.given


def depths_of(sequence: Sequence) -> Depths:
    """Statistics of sampled depth images; raises the first `SequenceError` if none can be read."""
    raw, read, damaged = [], [], []
    for index in _sampled(sequence):
        picture = sequence.files[index].depth
        try:
            raw.append(_thinned(read_raw_depth(picture, sequence.shape)))
            read.append(picture)
        except SequenceError as error:
            damaged.append(error)
    if not raw:
        raise damaged[0]
    values = np.stack(raw)
    valid = is_measured(values)
    scale = sequence.depth_scale
    median = float(np.median(values[valid])) / scale if valid.any() else 0.0
    for picture, image, known in zip(read, values, valid, strict=True):
        if not known.any():
            continue
        own = float(np.median(image[known])) / scale
        fault = depth_scale_fault(own, scale)
        if fault is not None and not median / 10 < own < median * 10:  # this image alone
            damaged.append(f"{picture}: {fault.sentence}")
    return Depths(
        median=median,
        invalid=float(np.mean(~valid)),
        saturated=float(np.mean(values == SATURATED)),
        sampled=len(raw),
        black=int(np.sum(~valid.any(axis=(1, 2)))),
        damaged=tuple(map(str, damaged)),
        beyond=_beyond(values[valid]),
        negative=float(np.mean(values < 0)),
    )


def _beyond(values: Float[np.ndarray, " n"]) -> tuple[float, float] | None:
    """The largest number of a hundredth of the values or more, and its share, if hardly any other
    value is above its half."""
    values = values[:: max(1, len(values) // 200_000)]
    numbers, counts = np.unique(values, return_counts=True)
    common = numbers[counts >= _COMMON * len(values)]
    if not len(common):
        return None
    number = float(common[-1])
    share = float(np.mean(values == number))
    others = float(np.mean((values > number / 2) & (values != number)))
    return (number, share) if share < 1 and others < _COMMON * share else None


def _thinned(pixels: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Every n-th pixel of an image, at most a million, which is enough for statistics."""
    every = math.ceil(math.sqrt(pixels.size / 1e6))
    return pixels[::every, ::every].copy()


def poses_of(sequence: Sequence, reading: Reading) -> Poses:
    """Read all poses of a recording, and combine their statistics with `reading`."""
    places, damaged = [], []
    for index in range(len(sequence)):
        try:
            if (T := sequence.read_pose(index)) is not None:
                places.append(T[:3, 3])
        except SequenceError as error:
            damaged.append(str(error))
    steps = np.linalg.norm(np.diff(np.reshape(places, (-1, 3)), axis=0), axis=1)
    return Poses(
        known=len(places),
        length=float(steps.sum()),
        reading=reading,
        damaged=tuple(damaged),
    )


def damaged_pictures(sequence: Sequence) -> tuple[str, ...]:
    """A sentence for each sampled colour image or mask that cannot be used."""
    damaged = []
    for index in _sampled(sequence):
        files = sequence.files[index]
        try:
            if files.color is not None:
                read_color(files.color, sequence.shape)
            if files.mask is not None:
                read_mask(files.mask, sequence.shape)
        except SequenceError as error:
            damaged.append(str(error))
    return tuple(damaged)


def turned_pictures(sequence: Sequence) -> tuple[str, ...]:
    """How each sampled colour image or mask is to be shown, if not as it is stored."""
    turned = []
    for index in _sampled(sequence):
        files = sequence.files[index]
        for picture in (files.color, files.mask):
            with suppress(SequenceError):  # `damaged_pictures` names it
                if picture is not None and (turn := read_turn(picture)):
                    turned.append(turn)
    return tuple(turned)


def gaps_of(sequence: Sequence) -> tuple[Gap, ...]:
    """Gaps between frames, by the times of the frames, or without times by the numbers in their
    names.

    A step between frames is a gap if it is more than 1.5 times the usual step.
    """
    names = sequence.names
    steps = np.diff(_numbers(names) if sequence.times is None else sequence.times)
    usual = float(np.median(steps)) if len(steps) else 0.0
    if usual < 1e-9:  # the numbers in the names do not increase
        return ()
    return tuple(
        Gap(names[i], names[i + 1], max(1, round(steps[i] / usual) - 1))
        for i in np.flatnonzero(steps > 1.5 * usual)
    )


def _numbers(names: tuple[str, ...]) -> Float[np.ndarray, " n"]:
    """The last number in each name; 0 without one."""
    numbers = re.compile(number_pattern(names))
    return np.array([float(("0", *numbers.findall(name))[-1]) for name in names])


def rate_of(sequence: Sequence) -> float | None:
    """Depth images per second; None without times."""
    steps = np.diff(sequence.times) if sequence.times is not None else np.zeros(0)
    usual = float(np.median(steps)) if len(steps) else 0.0
    return 1 / usual if usual >= 1e-9 else None


def _sampled(sequence: Sequence) -> list[int]:
    return np.unique(np.linspace(0, len(sequence) - 1, SAMPLES, dtype=int)).tolist()
