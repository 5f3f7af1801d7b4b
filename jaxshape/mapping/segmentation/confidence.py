"""Confidence of a segmentation: the product of the evidence for it, and a sentence. [host]"""

import numpy as np
from jaxtyping import Bool

from jaxshape.mapping.segmentation.clusters import Scene, cut, jumps
from jaxshape.mapping.segmentation.planes import floor_plane

Doubt = tuple[float, str]
"""Evidence from 0, against the segmentation, to 1, for it; and the doubt it raises, in words."""

_ALL_AROUND = np.array([x for x in np.ndindex(3, 3, 3) if x > (1, 1, 1)]) - 1.0
_ALL_AROUND /= np.linalg.norm(_ALL_AROUND, axis=1, keepdims=True)  # 13 directions, signs aside


def doubts_of(
    segmented: Bool[np.ndarray, "h w"],
    behind: Bool[np.ndarray, "h w"],
    view: Scene,
    *,
    clicked: bool,
) -> list[Doubt]:
    """Evidence for and against a segmentation.

    An object that was clicked on need not visibly stand on a floor: its feet may be out of sight.

    Args:
        segmented: Pixels that were segmented.
        behind: Pixels of the background.
        view: The frame.
        clicked: Whether the user clicked on the object.
    """
    hidden, touching = _outline(segmented, behind, view)
    size = float(np.ptp(view.points[segmented] @ _ALL_AROUND.T, axis=0).max())
    return [
        (1 - falling(segmented.mean(), 0.0, 0.01), "it covers hardly any of the image"),
        (falling(cut(segmented), 0.1, 0.6), "the border of the image cuts it"),
        (falling(hidden, 0.05, 0.35), "something nearer hides part of it"),
        (falling(touching, 0.1, 0.4), "it touches something that may or may not be part of it"),
        (falling(size, 2.0, 3.0), "it is larger than a piece of furniture"),
        (max(_standing(segmented, view), 0.5 * clicked), "it is not seen to stand on a floor"),
    ]


def falling(value: float, sure: float, unsure: float) -> float:
    """1 up to `sure`, 0 from `unsure` on, linear between."""
    return float(np.clip((unsure - value) / (unsure - sure), 0, 1))


def _outline(
    segmented: Bool[np.ndarray, "h w"], behind: Bool[np.ndarray, "h w"], view: Scene
) -> tuple[float, float]:
    """Shares of the outline at which a nearer surface begins, and where the surface continues."""
    nearer = touching = total = 0
    for turn in range(4):
        z, inside, back = (np.rot90(image, turn) for image in (view.z, segmented, behind))
        here, there = z[:, 1:], z[:, :-1]
        edge = inside[:, 1:] & ~inside[:, :-1]
        jump = jumps(here, there, view.spacing)
        nearer += int((edge & jump & (there < here)).sum())
        touching += int((edge & ~jump & np.isfinite(there) & ~back[:, :-1]).sum())
        total += int(edge.sum())
    return nearer / max(total, 1), touching / max(total, 1)


def _standing(segmented: Bool[np.ndarray, "h w"], view: Scene) -> float:
    """Confidence that the object stands on the floor; half where no floor is seen."""
    if view.floor is None:
        return 0.5
    floor = floor_plane(view.points.reshape(-1, 3), [view.floor.plane], view.points[segmented])
    return floor.confidence if floor else 0.0


def judged(doubts: list[Doubt], pieces: int) -> tuple[float, str]:
    """Confidence, the product of all evidence, and a sentence that names the weakest."""
    weakest, doubt = min(doubts)
    found = "One cluster" if pieces == 1 else f"{pieces} clusters that belong together"
    verdict = doubt if weakest < 0.8 else "nothing speaks against it"
    return float(np.prod([evidence for evidence, _ in doubts])), f"{found}: {verdict}."
