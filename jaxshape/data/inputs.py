"""Draw training pairs like the inputs of a reconstruction. [host]"""

import numpy as np
from jaxtyping import Bool, Int

from jaxshape.data.config import InputConfig
from jaxshape.data.dataset import Dataset
from jaxshape.geometry.grids import Grids

KNOTS = 5
"""Number of points along an axis between which its stretch is interpolated linearly."""


def draw_pair(
    dataset: Dataset, index: int, config: InputConfig, rng: np.random.Generator
) -> tuple[Grids, Bool[np.ndarray, "x y z"]]:
    """A measurement of an object, and its complete surface.

    Args:
        dataset: The dataset.
        index: Number of the object.
        config: Settings of the draw.
        rng: Random generator of the draws.

    Returns:
        Soft F and M `[x y z]`, float32, and Y.
    """
    paths, numbers = dataset.inputs_of(index)
    path, number = int(rng.integers(paths)), int(rng.integers(numbers))
    surface = dataset.surface(index, path)
    if rng.random() < config.complete:
        grids = Grids(surface.astype(np.float32), np.zeros(surface.shape, np.float32))
    else:
        grids = dataset.grids(index, path, number)
    if config.mirror and rng.random() < 0.5:
        grids, surface = Grids(grids.occupied[::-1], grids.occluded[::-1]), surface[::-1]
    if config.warp:
        return warped(grids, surface, config.warp, rng)
    return grids, surface


def warped(
    grids: Grids, surface: Bool[np.ndarray, "x y z"], share: float, rng: np.random.Generator
) -> tuple[Grids, Bool[np.ndarray, "x y z"]]:
    """Change the proportions of a pair: a random map of each axis that keeps both ends.

    If several layers become one, a voxel is surface if it was surface in any of them, and free if
    it was free in all of them, so that no surface gets holes.
    """
    known = 1 - grids.occluded
    seen, free = grids.occupied * known, (1 - grids.occupied) * known
    for axis in range(3):
        first = source_layers(len(surface), share, rng)
        surface = np.logical_or.reduceat(surface, first, axis)
        seen = np.maximum.reduceat(seen, first, axis)
        free = np.minimum.reduceat(free, first, axis)
    known = seen + free
    return Grids(seen / np.where(known > 0, known, 1), 1 - known), surface


def source_layers(count: int, share: float, rng: np.random.Generator) -> Int[np.ndarray, " n"]:
    """The first source layer of each new layer, by steps of 1 plus or minus `share`.

    `reduceat` takes the layers up to the next entry, or only the layer itself if the next entry is
    equal.
    """
    steps = np.interp(
        np.arange(count), np.linspace(0, count - 1, KNOTS), rng.uniform(1 - share, 1 + share, KNOTS)
    )
    ends = np.concatenate([[0], np.cumsum(steps)])
    return np.floor(ends[:-1] * count / ends[-1] + 1e-6).astype(int)
