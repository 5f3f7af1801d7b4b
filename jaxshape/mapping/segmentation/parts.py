"""Parts and floor of a depth frame: all the data that later decisions need. [host]

Finding them costs most of the time of a segmentation, and depends on the frame alone. Which parts
are the object is decided again and again, as other frames are seen (`belonging`).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxshape.mapping.segmentation.clusters import background, clusters, corners, look, pairs

SPECK = -1
"""Label of pixels that are part of no cluster and of no plane."""

NO_FLOOR = np.full(4, np.nan)
"""The floor of a frame that shows none."""


class Parts(NamedTuple):
    """Parts of a depth frame.

    Attributes:
        labels: Cluster of each pixel, from 1; 0 on floor, walls and table tops, and where nothing
            was measured; `SPECK` on other pieces that are too small for a cluster `[h w]`.
        sure: True on pixels that are known to show the object `[h w]`.
        corners: Labels of the clusters that may be corners of something nearer, the rest of which
            lies outside of the image `[n]`.
        tops: Number of the table top of each pixel, from 1; 0 elsewhere `[h w]`.
        pairs: Pairs of labels of clusters that belong together in this frame `[m 2]`.
        floor: Normal of the floor, towards the camera, and the height of the camera above it in
            metres, in the frame of the camera `[4]`; NaN where no floor is seen.
        evidence: Evidence from this frame, from 0 to 1, that this is the floor.
        are_numbered: Whether labels are numbers of objects, the same in all frames, from a mask.
    """

    labels: Int[np.ndarray, "h w"]
    sure: Bool[np.ndarray, "h w"]
    corners: Int[np.ndarray, " n"]
    tops: Int[np.ndarray, "h w"]
    pairs: Int[np.ndarray, "m 2"]
    floor: Float[np.ndarray, " 4"]
    evidence: float
    are_numbered: bool = False


def parts_of(
    depth: Float[np.ndarray, "h w"],
    K: Float[np.ndarray, "3 3"],
    sure: Bool[np.ndarray, "h w"] | None = None,
    *,
    with_tables: bool = True,
) -> Parts:
    """The parts of a frame.

    Args:
        depth: Depth image `[h w]`, in metres; 0 or infinite where nothing was measured.
        K: Camera matrix `[3 3]`, in pixels.
        sure: Pixels that are known to show the object `[h w]`; None for none.
        with_tables: Whether table tops are background; False where tables are objects.

    Returns:
        The clusters, and the floor with its evidence.
    """
    view = look(depth, K, stride=1)
    behind = background(view, None, with_tables=with_tables)
    free = np.isfinite(view.z) & ~behind.pixels
    labels = clusters(view, free)
    at_border = np.array(corners(labels, view), int)
    together = np.array(pairs(labels, view), int).reshape(-1, 2)
    labels[free & (labels == 0)] = SPECK
    known = np.zeros(depth.shape, bool) if sure is None else sure
    if view.floor is None:
        return Parts(labels, known, at_border, behind.tops, together, NO_FLOOR, 0.0)
    plane = view.floor.plane
    floor = np.array([*plane.normal, plane.offset], np.float64)
    return Parts(labels, known, at_border, behind.tops, together, floor, view.floor.confidence)
