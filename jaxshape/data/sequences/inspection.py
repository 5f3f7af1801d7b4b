"""Inspection of a recording: its statistics, and warnings with their evidence."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from jaxshape.data.sequences.cameras import intrinsic_numbers
from jaxshape.data.sequences.conventions import AS_GIVEN, Convention, read_as
from jaxshape.data.sequences.figures import (
    Depths,
    Gap,
    Poses,
    damaged_pictures,
    depths_of,
    gaps_of,
    poses_of,
    rate_of,
    turned_pictures,
)
from jaxshape.data.sequences.frames import (
    USUAL_DEPTH_SCALES,
    Finding,
    Sequence,
    depth_scale_fault,
    likely_depth_scales,
)
from jaxshape.data.sequences.hypotheses import FITS, Reading, reading_of
from jaxshape.data.sequences.poses import NEAR, READABLE_GAP

_USUAL_DEPTHS = (0.3, 7.0)  # metres, of the median; outside, a scale is doubted, not refused
_SLOW = 0.2  # depth images per second; below, times are hardly in seconds

NEGATIVE = 0.1
"""Share of negative pixels from which depth has the other sign."""

BADLY = 0.5
"""Agreement of poses and depth images below which a reconstruction must fail."""


class Inspection(NamedTuple):
    """Findings of `inspect_sequence`.

    Attributes:
        sequence: The recording, read in the convention that was stated or found.
        depths: Figures of the sampled depth images.
        poses: Figures of the poses; None where the recording has none.
        colors: Frames with a colour image.
        masks: Frames with a mask.
        gaps: Missing frames.
        rate: Depth images per second; None without times.
        warnings: Suspicious observations, each with a remedy.
    """

    sequence: Sequence
    depths: Depths
    poses: Poses | None
    colors: int
    masks: int
    gaps: tuple[Gap, ...]
    rate: float | None
    warnings: tuple[Finding, ...]


def inspect_sequence(
    sequence: Sequence, stated: tuple[str, ...] | None = None, *, keep_scale: bool = False
) -> Inspection:
    """Inspect a recording: names and poses of all frames, and images of some.

    If poses and depth images agree far better in another convention, it is used, with a warning.

    Args:
        sequence: The recording, read as written.
        stated: Names of the conventions in which it is known to be written, or `as-given`; None to
            detect them.
        keep_scale: Whether the depth scale is known, so that no other one is used.

    Raises:
        SequenceError: None of the sampled depth images can be read.
        ValueError: There is no convention of a name.
    """
    depths, reading, used, written = depths_of(sequence), None, None, sequence.depth_scale
    own = Convention(tuple(name for name in stated or () if name != AS_GIVEN))
    sequence = read_as(sequence, own)
    if sequence.has_poses:
        reading = reading_of(sequence, depths.median)
        used = _used(reading, keep_scale) if stated is None else None
    if used is not None:
        depths = _rescaled(depths, sequence, used)
        sequence = read_as(sequence, used)
    is_used = used is not None
    poses = None if reading is None else poses_of(sequence, reading)._replace(is_used=is_used)
    gaps, rate = gaps_of(sequence), rate_of(sequence)
    warnings = [
        *sequence.findings,
        *_of_images(depths, damaged_pictures(sequence)),
        *_of_turns(turned_pictures(sequence)),
        *_of_scale(depths.median, sequence.depth_scale, reading),
        *_of_camera(sequence),
        *_of_convention(reading, is_used),
        *_of_free_scale(used, written),
        *_of_mirrored(used, sequence),
        *_of_missing(poses, len(sequence)),
        *_of_gaps(gaps),
        *_of_rate(rate),
        *_of_delays(sequence),
    ]
    return Inspection(
        sequence=sequence,
        depths=depths,
        poses=poses,
        colors=sum(files.color is not None for files in sequence.files),
        masks=sum(files.mask is not None for files in sequence.files),
        gaps=gaps,
        rate=rate,
        warnings=tuple(warnings),
    )


def _used(reading: Reading, keep_scale: bool) -> Convention | None:
    """The convention that is used automatically; None to read the recording as written."""
    if reading.best is None or not reading.is_sure:
        return None
    convention = reading.best.convention
    return None if keep_scale and convention.depth_scale is not None else convention


def _rescaled(depths: Depths, sequence: Sequence, convention: Convention) -> Depths:
    scale = convention.depth_scale or sequence.depth_scale
    return depths._replace(median=depths.median * sequence.depth_scale / scale)


# Images ----------------------------------------------------------------------------------------


def _of_images(depths: Depths, pictures: tuple[str, ...]) -> Iterator[Finding]:
    skipped = "Until then such frames are skipped."
    for kind, damaged in (("depth images", depths.damaged), ("colour images or masks", pictures)):
        if damaged:
            yield Finding(
                f"sampled {kind} that cannot be used: {len(damaged)}; {damaged[0]}", skipped
            )
    if depths.negative > NEGATIVE:
        yield Finding(
            f"{depths.negative:.0%} of the depth pixels are negative, as along the z axis of "
            "OpenGL's cameras",
            "They count as not measured; write their absolute values.",
        )
    elif depths.black:
        yield Finding(
            f"{depths.black} of {depths.sampled} sampled depth images hold no valid depth at all",
            "Nothing can be tracked there; leave them out if they are at the start.",
        )
    if depths.invalid - depths.negative > 0.5:
        yield Finding(
            f"{depths.invalid:.0%} of the depth pixels hold nothing, "
            f"{depths.saturated:.0%} are saturated",
            "Keep 0.5 to 4 m from the object, out of the sun; black and shining surfaces stay "
            "unseen.",
        )

    if depths.beyond is not None:
        number, share = depths.beyond
        yield Finding(
            f"{share:.0%} of the valid depth pixels hold the number {number:g}, and hardly any "
            "other is above its half",
            "If it stands for nothing measured, write 0 there: otherwise all before it counts as "
            "free.",
        )


def _of_turns(turns: tuple[str, ...]) -> Iterator[Finding]:
    if turns:
        yield Finding(
            f"{len(turns)} sampled colour images or masks are to be shown {turns[0]} by their EXIF "
            "orientation, and are read as they are stored",
            "If they then do not lie as the depth images, save them with the turn applied; "
            "otherwise save them without the tag.",
        )


# Depth scale and camera ------------------------------------------------------------------------


def _of_scale(median: float, own: float, reading: Reading | None) -> Iterator[Finding]:
    """Doubts about the depth scale from the median depth, in metres, unless poses determine it."""
    low, high = _USUAL_DEPTHS
    if not median or (reading and reading.best and reading.best.convention.depth_scale):
        return
    if fault := depth_scale_fault(median, own):
        yield fault._replace(advice=fault.advice[0].upper() + fault.advice[1:])
    elif not low <= median <= high:
        yield Finding(
            f"the median depth is {median:.3g} m at depth scale {own:g}; an object in a room is "
            f"{low:g} to {high:g} m away",
            f"Check the unit: is --depth-scale {likely_depth_scales(median, own)} meant?",
        )


def _of_camera(sequence: Sequence) -> Iterator[Finding]:
    (h, w), (fx, fy, cx, cy) = sequence.shape, intrinsic_numbers(sequence.intrinsics)
    advice = "Check that the camera belongs to the depth images, at their size."
    if max(abs(cx / w - 0.5), abs(cy / h - 0.5)) > 0.1:
        yield Finding(
            f"the principal point {cx:.1f}, {cy:.1f} is far from the centre of {w} x {h} pixels",
            advice,
        )
    angle = 2 * np.degrees(np.arctan(w / (2 * fx)))
    if not 35 <= angle <= 110:
        yield Finding(
            f"a focal length of {fx:.1f} pixels makes the images {angle:.0f} degrees wide; depth "
            "cameras have 45 to 90",
            advice,
        )
    if abs(fx / fy - 1) > 0.05:
        yield Finding(
            f"the focal lengths {fx:.1f} and {fy:.1f} differ; pixels of depth cameras are square",
            "Check that the images were not stretched.",
        )


# Poses, gaps and times -------------------------------------------------------------------------


def _of_free_scale(used: Convention | None, written: float) -> Iterator[Finding]:
    """A warning that the poses may have no metric scale, where only an odd depth scale fits."""
    scale = None if used is None else used.depth_scale
    if scale is None or scale in USUAL_DEPTH_SCALES:
        return
    factor = scale / written
    yield Finding(
        f"no usual camera has {scale:g} depth units a metre; poses without a metric scale, as "
        "COLMAP gives them, look the same",
        f"If the depth images are right with {written:g} units a metre, all lengths of the result "
        f"are {1 / factor:.3g} times the true ones: multiply the translations by {factor:.3g}.",
    )


def _of_mirrored(used: Convention | None, sequence: Sequence) -> Iterator[Finding]:
    """A warning that only depth images are turned back, where there are colours or masks too."""
    if used is None or "mirrored" not in used.names:
        return
    kinds = {"colour images": "color", "masks": "mask"}
    found = [
        kind
        for kind, name in kinds.items()
        if any(getattr(files, name) is not None for files in sequence.files)
    ]
    if found:
        yield Finding(
            f"the depth images are mirrored, and {' and '.join(found)} are read as they are",
            "If they are mirrored as well, as in streams of OpenNI, mirror these files.",
        )


def _of_convention(reading: Reading | None, is_used: bool) -> Iterator[Finding]:
    """Warnings if the poses do not fit the depth images, with a convention in which they would."""
    if reading is None:
        return
    pairs, tolerance = reading.pairs, reading.tolerance
    compared = f"of the pixels of {pairs} pairs of frames agree to {tolerance:.0%}"
    best, rival = reading.best, reading.rival
    if best is not None:
        meaning, options = best.convention.meaning, best.convention.options
        if reading.by_columns and not reading.pairs:
            evidence = "the last column of the matrices is 0 0 0 1"
        else:
            evidence = f"then {best.share:.0%} {compared}, as written {reading.given:.0%}"
        if is_used:
            advice = (
                f"It is read in this convention. {options} confirms it; --convention {AS_GIVEN} "
                "turns it off."
            )
        elif rival is None:
            advice = f"Is {options} meant?"
        else:
            advice = f"Is {options} meant, or {rival.convention.options} ({rival.share:.0%})?"
        yield Finding(f"{meaning}: {evidence}", advice)
    if reading.pairs and (best is None or best.share < BADLY):
        if reading.given < BADLY:
            yield Finding(
                f"the poses fit the depth images badly: {reading.given:.0%} {compared}, and "
                "no known convention fits much better",
                "Check the depth scale, the camera, and that the poses belong to the depth images.",
            )
        elif reading.given < FITS and best is None:
            yield Finding(
                f"the poses fit the depth images less well than usual: {reading.given:.0%} "
                f"{compared}; in correct recordings it is 80 to 99%",
                "Check the focal length, the depth scale and the poses.",
            )


def _of_missing(poses: Poses | None, count: int) -> Iterator[Finding]:
    if poses is None:
        return
    if poses.damaged:
        yield Finding(
            f"poses that cannot be used: {len(poses.damaged)}; {poses.damaged[0]}",
            "Until then such frames are skipped.",
        )
    if without := count - poses.known - len(poses.damaged):
        yield Finding(
            f"{without} of {count} frames have no pose",
            f"They are tracked. In lists with times, a pose counts up to {NEAR:g} s from the "
            f"frame, and is interpolated between two poses up to {READABLE_GAP:g} s apart.",
        )


def _of_gaps(gaps: tuple[Gap, ...]) -> Iterator[Finding]:
    if gaps:
        worst = max(gaps, key=lambda gap: gap.missing)
        yield Finding(
            f"missing frames: {sum(gap.missing for gap in gaps)}, the most ({worst.missing}) "
            f"between {worst.after} and {worst.before}",
            "Tracking may lose the camera there; given poses bridge it.",
        )


def _of_rate(rate: float | None) -> Iterator[Finding]:
    if rate is not None and rate < _SLOW:
        yield Finding(
            f"the usual time between two depth images is {1 / rate:.3g} s",
            "Times are expected in seconds, of images and poses alike: divide milliseconds by "
            "1000, and nanoseconds by 1e9.",
        )


def _of_delays(sequence: Sequence) -> Iterator[Finding]:
    if sequence.color_delays is not None and np.isnan(sequence.color_delays).any():
        without = int(np.isnan(sequence.color_delays).sum())
        yield Finding(
            f"{without} of {len(sequence)} depth images have no colour image of the same time",
            "They are used without colour.",
        )
