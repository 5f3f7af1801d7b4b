"""Feet, which depth cannot tell from the floor they stand on, by their colour. [host]"""

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.ndimage import mean
from scipy.spatial import KDTree
from skimage.color import rgb2lab
from skimage.measure import label

from jaxshape.geometry.sensor import tolerance
from jaxshape.mapping.segmentation.clusters import Scene, over_footprint
from jaxshape.mapping.segmentation.planes import Plane, height_above, subsample

SEPARABLE = 0.95
"""Least share of known pixels that colours must classify correctly to tell object from floor."""


def feet_on(
    segmented: Bool[np.ndarray, "h w"], color: UInt8[np.ndarray, "h w 3"], view: Scene, floor: Plane
) -> Bool[np.ndarray, "h w"]:
    """Pixels that were taken for floor, but have the colour of the object above or beside them.

    Shadows may have its colour too, but lie on the floor: a patch must on average be a little above
    it. Empty where colours do not tell the object from the floor.
    """
    height = np.nan_to_num(height_above(floor, view.points) / tolerance(view.z), nan=9.0)
    flat = (np.abs(height) < 1.5) & ~segmented
    beside = flat.copy()
    beside[flat] = over_footprint(view.points[flat], view.points[segmented], floor)
    feet = np.zeros_like(segmented)
    feet[beside] = _looks_like(rgb2lab(color), beside, segmented, flat & ~beside)
    patches = _patches(feet)
    raised = np.array(mean(height, patches, range(patches.max() + 1))) > 0.3
    feet &= raised[patches]
    attached = _patches(feet | segmented)
    return feet & np.isin(attached, attached[segmented])


def _patches(pixels: Bool[np.ndarray, "h w"]) -> Int[np.ndarray, "h w"]:
    """Connected pixels, diagonals included: 1, 2, ...; 0 elsewhere."""
    return np.asarray(label(pixels, connectivity=2))


def _looks_like(
    lab: Float[np.ndarray, "h w 3"],
    doubtful: Bool[np.ndarray, "h w"],
    ours: Bool[np.ndarray, "h w"],
    others: Bool[np.ndarray, "h w"],
) -> Bool[np.ndarray, " n"]:
    """Whether most of the known pixels nearest in colour to each doubtful one are ours.

    False for all if the same rule classifies too many of the known pixels wrongly.
    """
    rng = np.random.default_rng(0)
    known = [subsample(lab[pixels], 1000, rng) for pixels in (ours, others)]
    unknown = lab[doubtful]
    if min(len(unknown), *map(len, known)) < 10:
        return np.zeros(len(unknown), bool)
    tree = KDTree(np.concatenate(known))

    def share_of_ours(colors, ranks):
        return (tree.query(colors, k=ranks)[1] < len(known[0])).mean(axis=1)

    shares = [share_of_ours(colors, range(2, 11)) for colors in known]  # the first is itself
    right = (np.mean(shares[0] > 0.5) + np.mean(shares[1] < 0.5)) / 2
    return (share_of_ours(unknown, range(1, 10)) > 0.7) & (right > SEPARABLE)
