"""Segmentation of the object in a depth frame (paper, sections 3.1 and 4.2). [host]

The paper thresholds depth by hand. Here the floor, the walls and table tops are taken out as
planes; the rest is split into clusters where depth jumps; the cluster in the middle, or under a
click, is the object; pieces that other parts of the object separate from it are joined where they
stand on the same footprint; and its feet, which depth cannot tell from the floor, are found by
their colour.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from jaxshape import checks
from jaxshape.mapping.segmentation.clusters import (
    Pixel,
    Scene,
    background,
    clusters,
    cut,
    distance,
    enlarged,
    groups,
    joined,
    look,
    reduced,
)  # fmt: skip
from jaxshape.mapping.segmentation.confidence import Doubt, doubts_of, falling, judged
from jaxshape.mapping.segmentation.feet import feet_on

CLICK_RADIUS = 4.0
"""Radius around a click in which the object may lie, in pixels of the reduced image."""

CANDIDATES = 5
"""Number of clusters that are joined with clusters that belong to them before one is chosen."""


class Segmentation(NamedTuple):
    """The pixels that show the object, and the confidence in them.

    Attributes:
        segmented: True on pixels that show the object `[h w]`.
        core: True on those among them that were chosen, without the clusters that were joined to
            them `[h w]`: other frames may show that these are something else.
        confidence: Confidence in the segmentation, from 0 to 1.
        reason: One sentence that names the clusters found and the strongest doubt.
    """

    segmented: Bool[np.ndarray, "h w"]
    core: Bool[np.ndarray, "h w"]
    confidence: float
    reason: str


@dataclass(frozen=True)
class Prompt:
    """A hint where the object is; without one it is sought in the middle of the image.

    Attributes:
        click: A point `(u, v)` of the image on the object, in pixels, 0 or more; None for no click.
        region: `(left, top, right, bottom)` around the object, in pixels; None for the whole image.
        depth_range: Nearest and farthest depth of the object, in metres, 0 or more; None for any
            depth.
        number: Number of the object, from 1, among those that `propose` finds in the same image;
            None for no number.

    Raises:
        ValueError: A coordinate is outside its range, or an interval is empty.
    """

    click: tuple[float, float] | None = None
    region: tuple[float, float, float, float] | None = None
    depth_range: tuple[float, float] | None = None
    number: int | None = None

    def __post_init__(self) -> None:
        for coordinate in self.click or ():
            checks.at_least("click", coordinate, 0)
        left, top, right, bottom = self.region or (0, 0, 1, 1)
        if not (left < right and top < bottom):
            wanted = "left, top, right, bottom in pixels, with left < right and top < bottom"
            checks.refuse("region", self.region, wanted)
        near, far = self.depth_range or (0, 1)
        if not 0 <= near < far:
            wanted = "the nearest, then the farthest depth, in metres"
            checks.refuse("depth_range", self.depth_range, wanted)
        if self.number is not None:
            checks.whole("number", self.number, 1)


def segment(
    depth: Float[np.ndarray, "h w"],
    color: UInt8[np.ndarray, "h w 3"] | None,
    K: Float[np.ndarray, "3 3"],
    prompt: Prompt = Prompt(),
    mask: Bool[np.ndarray, "h w"] | None = None,
) -> Segmentation:
    """Find the pixels of one frame that measure the object (paper, sections 3.1 and 4.2). [host]

    A given mask is taken as it is. Without one, floor, walls and table tops are removed from the
    pixels that the prompt allows, and the cluster under the click, or the one largest and nearest
    to the middle, is the object. A frame without depth, or without a cluster, gives an empty
    segmentation of confidence 0 that says why.

    Args:
        depth: Depth image `[h w]`, in metres; 0 or infinite where nothing was measured. Such pixels
            are never segmented.
        color: Colour image `[h w 3]`, registered to the depth image, which tells feet from floor;
            None where there is none.
        K: Camera matrix `[3 3]`, in pixels.
        prompt: Where the object is in the image.
        mask: True on the object `[h w]`; None to find it.

    Raises:
        ValueError: No pixel of the image can meet the prompt, or no object has its number.
    """
    check_prompt(prompt, depth.shape)
    measured = (depth > 0) & np.isfinite(depth)
    if not measured.any():
        return _nothing(measured, "No pixel has a depth")
    if mask is not None:
        return _given(measured & mask)
    allowed = measured & _prompted(prompt, depth)
    clicked = prompt.click is not None
    view = look(depth, K)
    target = _target(prompt, view)
    behind = background(view, target if clicked else None).pixels
    labels = clusters(view, reduced(allowed, view.stride) & ~behind)
    if labels.max() == 0:
        return _nothing(measured, "Nothing but floor, walls and table tops is seen there")
    if prompt.number is not None:
        chosen, doubt = _numbered(labels, view, prompt.number)
    else:
        chosen, doubt = (_nearest if clicked else _most_central)(labels, view, target)
    segmented = np.isin(labels, chosen)
    if color is not None and view.floor is not None:
        segmented |= feet_on(segmented, reduced(color, view.stride), view, view.floor.plane)
    is_told = clicked or prompt.number is not None
    doubts = [doubt, *doubts_of(segmented, behind, view, clicked=is_told)]
    core = segmented & ~np.isin(labels, chosen[1:])
    whole, certain = (enlarged(pixels, view, depth) & allowed for pixels in (segmented, core))
    return Segmentation(whole, certain, *judged(doubts, len(chosen)))


def check_prompt(prompt: Prompt, shape: tuple[int, ...]) -> None:
    """Raise `ValueError` for a prompt that no pixel of an image of height and width can meet."""
    h, w = shape
    if prompt.click is not None:
        u, v = prompt.click
        if not (0 <= u < w and 0 <= v < h):
            raise ValueError(
                f"The click is at {u:g}, {v:g}; expected a point of the image of {w} x {h} pixels: "
                "give column, then row."
            )
    if prompt.region is not None:
        left, top, right, bottom = prompt.region
        if not (max(left, 0) < min(right, w) and max(top, 0) < min(bottom, h)):
            raise ValueError(
                f"The region {prompt.region} holds no pixel of the image of {w} x {h}; expected "
                "left, top, right, bottom in pixels."
            )


def _nothing(measured: Bool[np.ndarray, "h w"], reason: str) -> Segmentation:
    nothing = np.zeros_like(measured)
    return Segmentation(nothing, nothing, 0.0, f"{reason}, so nothing is segmented.")


def _given(segmented: Bool[np.ndarray, "h w"]) -> Segmentation:
    if not segmented.any():
        return _nothing(segmented, "The given mask holds no pixel with a depth")
    reason = f"The given mask: {segmented.sum()} pixels with a depth."
    return Segmentation(segmented, segmented, 1.0, reason)


# Which cluster ---------------------------------------------------------------------------------


def _prompted(prompt: Prompt, depth: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """The pixels within the prompt's region and depth range."""
    h, w = depth.shape
    near, far = prompt.depth_range or (0.0, np.inf)
    left, top, right, bottom = prompt.region or (0.0, 0.0, w, h)
    u, v = np.arange(w) + 0.5, np.arange(h)[:, None] + 0.5
    within = (left <= u) & (u < right) & (top <= v) & (v < bottom)
    return within & (near <= depth) & (depth <= far)


def _target(prompt: Prompt, view: Scene) -> Pixel:
    """Row and column of the reduced image at which the object is expected."""
    h, w = view.z.shape
    if prompt.click is not None:
        u, v = prompt.click
    elif prompt.region is not None:
        left, top, right, bottom = prompt.region
        u, v = (left + right) / 2, (top + bottom) / 2
    else:
        return (h - 1) / 2, (w - 1) / 2
    return v / view.stride - 0.5, u / view.stride - 0.5


def _nearest(labels: Int[np.ndarray, "h w"], view: Scene, target: Pixel) -> tuple[list[int], Doubt]:
    """The cluster at a click, with what belongs to it.

    A click may slip, or fall between the slats of a back: of the clusters that fill a quarter of
    the disc around it, the nearest to the camera is meant.
    """
    away = np.array([distance(labels == i, target) for i in range(1, labels.max() + 1)])
    doubt = falling(away.min(), 3.0, 15.0), "nothing stands where the click is"
    row, column = np.indices(labels.shape)
    disc = np.hypot(row - target[0], column - target[1]) <= CLICK_RADIUS
    shares = np.array([np.mean(labels[disc] == i) for i in range(1, labels.max() + 1)])
    depths = [
        np.median(view.z[disc & (labels == i + 1)]) if share >= 0.25 else np.inf
        for i, share in enumerate(shares)
    ]
    hit = np.argmin(depths) if np.isfinite(depths).any() else np.argmin(away)
    return joined(labels, int(hit) + 1, view), doubt


def _numbered(labels: Int[np.ndarray, "h w"], view: Scene, number: int) -> tuple[list[int], Doubt]:
    """The group of clusters of this number, which a user chose from a picture of them."""
    found = groups(labels, view)
    if number > len(found):
        raise ValueError(
            f"The object has the number {number}, and {len(found)} are seen there; see them with "
            "--list."
        )
    return found[number - 1], (1.0, "it was chosen")


def _most_central(
    labels: Int[np.ndarray, "h w"], view: Scene, target: Pixel
) -> tuple[list[int], Doubt]:
    """The cluster, with what belongs to it, that has the highest worth.

    Pixels are weighted by a Gaussian window about the target. The sum of the weights is divided by
    the square root of the number of pixels, so that a cluster that fills the image is worth little,
    and reduced where the border of the image cuts the cluster.
    """
    row, column = np.indices(labels.shape)
    away = np.hypot(row - target[0], column - target[1]) / (0.2 * labels.shape[1])
    window = np.exp(-(away**2) / 2) * np.sqrt(np.nan_to_num(view.z))  # far things look small

    def worth(group: list[int]) -> float:
        pixels = np.isin(labels, group)
        return float(window[pixels].sum() / np.sqrt(pixels.sum()) * (1 - cut(pixels)) ** 2)

    seeds = sorted(range(1, labels.max() + 1), key=lambda i: -worth([i]))[:CANDIDATES]
    groups = sorted((joined(labels, i, view) for i in seeds), key=lambda group: -worth(group))
    rivals = [worth(group) for group in groups if not set(group) & set(groups[0])]
    rival = max(rivals, default=0.0) / max(worth(groups[0]), 1e-9)
    return groups[0], (falling(rival, 0.3, 1.2), "something else is as large and central")
