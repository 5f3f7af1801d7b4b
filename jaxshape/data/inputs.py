"""Training pairs as a reconstruction would meet them. [host]"""

import numpy as np
from jaxtyping import Bool

from jaxshape.data.config import InputConfig
from jaxshape.data.dataset import Dataset
from jaxshape.geometry.grids import Grids


def draw_pair(
    dataset: Dataset, index: int, config: InputConfig, rng: np.random.Generator
) -> tuple[Grids, Bool[np.ndarray, "x y z"]]:
    """What was measured of an object, and its complete surface.

    Args:
        dataset: The dataset.
        index: Number of the object.
        config: How the input is drawn.
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
    return grids, surface
