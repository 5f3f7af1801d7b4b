"""Objects that a depth frame shows, for a user to choose from. [host]"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxshape.mapping.segmentation.clusters import (
    Scene,
    background,
    clusters,
    enlarged,
    groups,
    look,
    reduced,
)


class Proposal(NamedTuple):
    """A possible object: clusters of a frame that belong together.

    Attributes:
        segmented: True on the pixels that show it `[h w]`.
        size: Width, height and depth of its visible part `[3]`, in metres: upright where the floor
            is seen, else along the axes of the camera.
        distance: Median depth, in metres.
    """

    segmented: Bool[np.ndarray, "h w"]
    size: Float[np.ndarray, " 3"]
    distance: float


def propose(depth: Float[np.ndarray, "h w"], K: Float[np.ndarray, "3 3"]) -> tuple[Proposal, ...]:
    """Find the objects in front of floor and walls and on table tops, the largest first.

    `segment` takes the object of number i, from 1, with `Prompt(number=i)`.

    Args:
        depth: Depth image `[h w]`, in metres; 0 or infinite where nothing was measured.
        K: Camera matrix `[3 3]`, in pixels.

    Returns:
        At most nine proposals; none where nothing is measured.
    """
    measured = (depth > 0) & np.isfinite(depth)
    if not measured.any():
        return ()
    view = look(depth, K)
    labels = clusters(view, reduced(measured, view.stride) & ~background(view, None).pixels)
    return tuple(
        Proposal(
            segmented=enlarged(pixels, view, depth) & measured,
            size=_size(view.points[pixels], view),
            distance=float(np.median(view.z[pixels])),
        )
        for pixels in (np.isin(labels, group) for group in groups(labels, view))
    )


def _size(points: Float[np.ndarray, "n 3"], view: Scene) -> Float[np.ndarray, " 3"]:
    """Extents to the side, upwards and ahead, without the farthest hundredth at each end."""
    up = np.array([0.0, -1.0, 0.0])
    if view.floor is not None:
        up = np.asarray(view.floor.plane.normal, np.float64)
    ahead = np.array([0.0, 0.0, 1.0]) - up[2] * up
    ahead /= max(float(np.linalg.norm(ahead)), 1e-9)
    along = points @ np.stack([np.cross(up, ahead), up, ahead]).T
    low, high = np.percentile(along, (1, 99), axis=0)
    return high - low
