"""List the content of a folder, and match images that belong together, by number or by time."""

import os
import re
from collections.abc import Callable, Iterable, Mapping
from decimal import Decimal
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxshape.data.sequences.cameras import Calibration, DefaultCamera
from jaxshape.data.sequences.frames import Finding, FrameFiles, SequenceError
from jaxshape.data.sequences.poses import NEAR

DEPTH_SUFFIXES = (".png", ".tif", ".tiff", ".pgm", ".npy", ".exr")
COLOR_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".ppm")

DEPTH_FOLDERS = ("aligned_depth_to_color", "depth", "depths")
"""The first one counts: beside aligned images, those in `depth` are not registered to colour."""

COLOR_FOLDERS = ("color", "image", "rgb", "colors", "images")
MASK_FOLDERS = ("masks", "mask")


class Contents(NamedTuple):
    """A folder, listed once.

    Attributes:
        folder: The folder.
        files: Names of its files.
        folders: Names of its sub-folders.
        others: Names of other entries, such as pipes, devices and links to nothing; none is opened.
    """

    folder: Path
    files: frozenset[str]
    folders: frozenset[str]
    others: frozenset[str] = frozenset()


class Listed(NamedTuple):
    """Files that a layout finds in a folder, before any image is read.

    Attributes:
        files: Files of each frame.
        depth_scale: Depth units per metre.
        read_pose: Function from the index of a frame to its pose; None if the recording has no
            poses.
        times: Times of the depth images, in seconds; None if they are not known.
        color_delays: Seconds from a depth image to its colour image; None if they are not known.
        camera: The usual camera of such recordings, for folders without a camera.
        calibration: Cameras from the recording's own files; None to search the folder for a camera
            file.
        findings: Remarks that a user should know.
    """

    files: tuple[FrameFiles, ...]
    depth_scale: float
    read_pose: Callable[[int], Float[np.ndarray, "4 4"] | None] | None = None
    times: Float[np.ndarray, " n"] | None = None
    color_delays: Float[np.ndarray, " n"] | None = None
    camera: DefaultCamera | None = None
    calibration: Calibration | None = None
    findings: tuple[Finding, ...] = ()


def list_folder(folder: Path) -> Contents:
    """List a folder; hidden entries are left out."""
    files, folders, others = [], [], []
    with os.scandir(folder) as entries:
        for entry in entries:
            if not entry.name.startswith("."):
                (folders if _is(entry.is_dir) else files if _is(entry.is_file) else others).append(
                    entry.name
                )
    return Contents(folder, frozenset(files), frozenset(folders), frozenset(others))


def _is(asked: Callable[[], bool]) -> bool:
    try:
        return asked()
    except OSError:  # circular links
        return False


def files_in(
    contents: Contents, names: Iterable[str], suffixes: tuple[str, ...]
) -> dict[str, Path]:
    """The files of the first existing sub-folder of `names`, by name without suffix, sorted by the
    numbers in the names; empty if no sub-folder exists.

    Of files that differ in their suffix alone, that of the last of `suffixes` counts.
    """
    folder = folder_of(contents, names)
    if folder is None:
        return {}
    inside = list_folder(folder)  # reading them reports faults of other entries
    found = (os.path.splitext(file) for file in inside.files | inside.others)
    chosen = [(stem, end) for stem, end in found if end.lower() in suffixes]
    natural = natural_order([stem for stem, _ in chosen])
    chosen.sort(key=lambda one: (natural(one[0]), suffixes.index(one[1].lower())))
    return {stem: folder / (stem + end) for stem, end in chosen}


def folder_of(contents: Contents, names: Iterable[str]) -> Path | None:
    """The first of `names` that is a sub-folder, in capital or small letters; None without one."""
    there = {name.lower(): name for name in sorted(contents.folders)}  # small letters come last
    return next((contents.folder / there[name] for name in names if name in there), None)


def depth_images(contents: Contents) -> dict[str, Path]:
    """The images of the folder of depth images; `SequenceError` if there are none."""
    images = files_in(contents, DEPTH_FOLDERS, DEPTH_SUFFIXES)
    if not images:
        folder = folder_of(contents, DEPTH_FOLDERS) or contents.folder / "depth"
        raise SequenceError(
            f"{folder} holds no depth image; expected 16-bit PNG files: copy them there."
        )
    return images


def has_depth_folder(contents: Contents) -> bool:
    return folder_of(contents, DEPTH_FOLDERS) is not None


def color_images(contents: Contents) -> dict[str, Path]:
    return files_in(contents, COLOR_FOLDERS, COLOR_SUFFIXES)


def mask_images(contents: Contents) -> dict[str, Path]:
    return files_in(contents, MASK_FOLDERS, COLOR_SUFFIXES)


# Files that belong together
# -------------------------------------------------------------------------


def numbers_in(name: str) -> tuple[int, ...]:
    return tuple(int(digits[-18:]) for digits in re.findall(r"\d+", name))


def partners(wanted: Iterable[str], offered: Mapping[str, Path]) -> list[Path | None]:
    """For each name, the file of the same name, otherwise the only one with the same numbers."""
    by_number: dict[tuple[int, ...], Path | None] = {}
    for name, path in offered.items():
        by_number[numbers_in(name)] = None if numbers_in(name) in by_number else path
    by_number[()] = None  # names without a number have to be the same
    return [offered.get(name) or by_number.get(numbers_in(name)) for name in wanted]


def miscounted_poses(found: Iterable[bool], offered: int) -> tuple[Finding, ...]:
    """A remark if depth images have no pose although there are enough of them.

    Args:
        found: Whether there is a pose of the number of each depth image.
        offered: Number of poses.
    """
    found = list(found)
    if all(found) or offered < len(found):
        return ()
    return (
        Finding(
            f"{found.count(False)} of {len(found)} depth images have no pose of their number, "
            f"although there are {offered} poses",
            "Give poses the numbers of their images: if one kind is counted from 0 and the other "
            "from 1, all poses are a frame late.",
        ),
    )


def last_number(name: str) -> int:
    """The last number in a name; -1 if it has none."""
    return (-1, *numbers_in(name))[-1]


def frame_files(
    contents: Contents,
    depth: Mapping[str, Path],
    color: Iterable[Path | None] | None = None,
    confidence: Iterable[Path | None] | None = None,
) -> tuple[FrameFiles, ...]:
    """Files of one frame for each depth image.

    Args:
        contents: The folder.
        depth: Depth images by name.
        color: Colour image of each; None for images with the same names or numbers.
        confidence: Confidence map of each; None if there are none.
    """
    color = partners(depth, color_images(contents)) if color is None else color
    confidence = [None] * len(depth) if confidence is None else confidence
    masks = partners(depth, mask_images(contents))
    return tuple(map(FrameFiles, depth, depth.values(), color, masks, confidence))


def nearest_in_time(
    wanted: Float[np.ndarray, " n"], offered: Float[np.ndarray, " m"]
) -> Int[np.ndarray, " n"]:
    """Index of the reading nearest to each wanted time; -1 if it is too far away.

    The limit is half the usual time between readings, or `NEAR` if that is more. `offered`
    increases.
    """
    if len(offered) == 0:
        return np.full(len(wanted), -1)
    later = np.clip(np.searchsorted(offered, wanted), 1, max(len(offered) - 1, 1))
    pair = np.stack([later - 1, np.minimum(later, len(offered) - 1)])
    nearer = np.abs(offered[pair] - wanted).argmin(axis=0)
    index = np.take_along_axis(pair, nearer[None], axis=0)[0]
    usual = float(np.median(np.diff(offered))) if len(offered) > 1 else 0.0
    return np.where(np.abs(offered[index] - wanted) <= max(NEAR, usual / 2), index, -1)


def with_colors_by_time(
    times: Float[np.ndarray, " n"], offered: Float[np.ndarray, " m"], paths: list[Path]
) -> tuple[list[Path | None], Float[np.ndarray, " n"]]:
    """The colour image nearest to each time, and its delay, NaN if there is none."""
    index = nearest_in_time(times, offered)
    found = index >= 0
    delays = np.full(len(times), np.nan)
    delays[found] = offered[index[found]] - times[found]
    return [paths[i] if i >= 0 else None for i in index], delays


def number_pattern(names: Iterable[str]) -> str:
    """A regular expression for the numbers in names, which are decimal in `9.96`, `9.98`, `10.0`,
    `10.02`, and whole in `run1.9`, `run1.10`.

    In decimal numbers without zeros at their ends, digits after the point may begin with 0, which
    they never do in whole numbers without zeros in front.
    """
    parts = [digits for name in names for digits in re.findall(r"\d\.(\d\d+)", name)]
    is_decimal = any(digits.startswith("0") for digits in parts)
    is_decimal &= not any(digits.endswith("0") for digits in parts)
    return r"\d+(?:\.\d+)?" if is_decimal else r"\d+"


def natural_order(names: Iterable[str]) -> Callable[[str], list[str | int | Decimal]]:
    """Sorting key for names: their numbers are compared as numbers, other text as text."""
    pattern = number_pattern(names)
    split = re.compile(f"({pattern})").split
    number = int if "." not in pattern else Decimal

    def key(name):
        words = split(name)
        words[1::2] = map(number, words[1::2])
        return words

    return key
