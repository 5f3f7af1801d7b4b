"""Inspection of a recording: its figures, and warnings with their evidence."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from jaxshape.data.sequences.cameras import intrinsic_numbers
from jaxshape.data.sequences.evidence import looks_inverted
from jaxshape.data.sequences.figures import (
    Depths,
    Gap,
    Poses,
    damaged_pictures,
    depths_of,
    gaps_of,
    poses_of,
    rate_of,
)
from jaxshape.data.sequences.frames import (
    Finding,
    Sequence,
    depth_scale_fault,
    likely_depth_scale,
)

_USUAL_DEPTHS = (0.3, 7.0)  # metres, of the median; beyond them a scale is doubted, not refused


class Inspection(NamedTuple):
    """Findings of `inspect_sequence`.

    Attributes:
        depths: Figures of the sampled depth images.
        poses: Figures of the poses; None where the recording has none.
        colors: Frames with a colour image.
        masks: Frames with a mask.
        gaps: Missing frames.
        rate: Depth images a second; None without times.
        warnings: What looks wrong, and what to do about it.
    """

    depths: Depths
    poses: Poses | None
    colors: int
    masks: int
    gaps: tuple[Gap, ...]
    rate: float | None
    warnings: tuple[Finding, ...]


def inspect_sequence(sequence: Sequence) -> Inspection:
    """Look at a recording: names and poses of all frames, and images of some.

    Args:
        sequence: The recording.

    Raises:
        SequenceError: None of the sampled depth images can be read.
    """
    depths, poses, gaps = depths_of(sequence), poses_of(sequence), gaps_of(sequence)
    better = _better_scale(poses, sequence.depth_scale, depths.median)
    warnings = [
        *sequence.findings,
        *_of_images(depths, damaged_pictures(sequence)),
        *_of_scale(depths.median, sequence.depth_scale, better),
        *_of_camera(sequence),
        *_of_directions(poses if better is None else None),
        *_of_missing(poses, len(sequence)),
        *_of_gaps(gaps),
        *_of_delays(sequence),
    ]
    return Inspection(
        depths=depths,
        poses=poses,
        colors=sum(files.color is not None for files in sequence.files),
        masks=sum(files.mask is not None for files in sequence.files),
        gaps=gaps,
        rate=rate_of(sequence),
        warnings=tuple(warnings),
    )


# Images ----------------------------------------------------------------------------------------


def _of_images(depths: Depths, pictures: tuple[str, ...]) -> Iterator[Finding]:
    skipped = "Until then such frames are skipped."
    for kind, damaged in (("depth images", depths.damaged), ("colour images or masks", pictures)):
        if damaged:
            yield Finding(
                f"sampled {kind} that cannot be used: {len(damaged)}; {damaged[0]}", skipped
            )
    if depths.black:
        yield Finding(
            f"{depths.black} of {depths.sampled} sampled depth images hold no valid depth at all",
            "Nothing can be tracked there; leave them out if they are at the start.",
        )
    if depths.invalid > 0.5:
        yield Finding(
            f"{depths.invalid:.0%} of the depth pixels hold nothing, "
            f"{depths.saturated:.0%} are saturated",
            "Keep 0.5 to 4 m from the object, out of the sun; black and shining surfaces stay "
            "unseen.",
        )


# Depth scale and camera ------------------------------------------------------------------------


class _Scale(NamedTuple):
    """A depth scale, and how well neighbouring frames agree at it.

    Attributes:
        scale: Depth units in a metre.
        share: Share of pixels that agree at this scale.
        own_share: Share of pixels that agree at the recording's own scale.
    """

    scale: float
    share: float
    own_share: float


def _better_scale(poses: Poses | None, own: float, median: float) -> _Scale | None:
    """The depth scale at which the poses fit clearly better, if there is one.

    Where the median depth is unusual already, a little better is enough: what is read as too far
    away moves too little between frames to disagree much.
    """
    if poses is None or not poses.scales:
        return None
    best = max(poses.scales, key=lambda scale: poses.scales[scale])
    found = _Scale(best, poses.scales[best], poses.scales.get(own, 0.0))
    margin = 0.1 if _USUAL_DEPTHS[0] <= median <= _USUAL_DEPTHS[1] else 0.0
    rival = max(found.own_share, poses.agreement.inverted)
    return found if found.share > rival + margin else None


def _of_scale(median: float, own: float, better: _Scale | None) -> Iterator[Finding]:
    """A warning of a wrong depth scale, from the poses or else from the median depth, in metres."""
    low, high = _USUAL_DEPTHS
    if better is not None:
        yield Finding(
            f"the poses fit the depth images at depth scale {better.scale:g}, where "
            f"{better.share:.0%} of the pixels agree with neighbouring frames, and not at "
            f"{own:g}, where {better.own_share:.0%} do",
            f"Is --depth-scale {better.scale:g} meant?",
        )
    elif median and (fault := depth_scale_fault(median, own)):
        yield fault._replace(advice=fault.advice[0].upper() + fault.advice[1:])
    elif median and not low <= median <= high:
        likely = likely_depth_scale(median, own)
        yield Finding(
            f"the median depth is {median:.3g} m at depth scale {own:g}; that of an object in a "
            f"room is {low:g} to {high:g} m",
            f"Check the unit: at --depth-scale {likely:g} it would be {median * own / likely:.3g} "
            "m.",
        )


def _of_camera(sequence: Sequence) -> Iterator[Finding]:
    (h, w), (fx, fy, cx, cy) = sequence.shape, intrinsic_numbers(sequence.intrinsics)
    advice = "Check that the camera is that of the depth images, at their size."
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


def _of_directions(poses: Poses | None) -> Iterator[Finding]:
    """Whether the poses fit the depth images, at a depth scale that is not in doubt."""
    if poses is None:
        return
    as_given, inverted, pairs = poses.agreement
    compared = f"of the pixels of {pairs} pairs of frames agree"
    if looks_inverted(poses.agreement):
        yield Finding(
            f"the poses look like world to camera: {inverted:.0%} {compared} if each is inverted, "
            f"{as_given:.0%} as given",
            "Write camera to world.",
        )
    elif pairs and as_given < 0.3:
        yield Finding(
            f"the poses fit the depth images badly: {as_given:.0%} {compared}, {inverted:.0%} if "
            "each is inverted",
            "Check the depth scale, the camera, and that the poses are those of the depth images.",
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
            "They can be tracked, but cannot be fused as they are.",
        )


def _of_gaps(gaps: tuple[Gap, ...]) -> Iterator[Finding]:
    if gaps:
        worst = max(gaps, key=lambda gap: gap.missing)
        yield Finding(
            f"missing frames: {sum(gap.missing for gap in gaps)}, the most ({worst.missing}) "
            f"between {worst.after} and {worst.before}",
            "Tracking may lose the camera there; given poses bridge it.",
        )


def _of_delays(sequence: Sequence) -> Iterator[Finding]:
    if sequence.color_delays is not None and np.isnan(sequence.color_delays).any():
        without = int(np.isnan(sequence.color_delays).sum())
        yield Finding(
            f"{without} of {len(sequence)} depth images have no colour image of the same time",
            "They are used without colour.",
        )
