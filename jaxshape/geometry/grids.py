"""The measurement grid F and the occlusion mask M of one object.

Both come from fused frames (`fusion`, paper, Eq. 6). They are binary, as in the paper, or soft.
Soft grids hold probabilities: in each voxel, surface, free space and unknown have the weights
F (1 - M), (1 - F) (1 - M) and M, which sum to 1.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float

Grid = Bool[Array | np.ndarray, "*batch x y z"] | Float[Array | np.ndarray, "*batch x y z"]


class Grids(NamedTuple):
    """Measurement of an object, as shape models and residuals take it; leading axes are batch axes.

    Attributes:
        occupied: **F** `[*batch x y z]`, True (or its probability, 0 to 1) where the surface was
            measured. It is used only where the voxel is not occluded.
        occluded: **M** `[*batch x y z]`, True (or its probability, 0 to 1) where nothing is known.
        data: Further arrays that your own model or residual needs for each object: any pytree of
            arrays with the same batch axes. None if there are no such arrays.
    """

    occupied: Grid
    occluded: Grid
    data: Any = None


def binary(grids: Grids) -> Grids:
    """Round soft grids to the binary F and M of the paper.

    Args:
        grids: Binary or soft grids `[*batch x y z]`; binary ones come back unchanged.

    Returns:
        Grids of booleans: occluded where M is above 1/2, occupied where F is above 1/2 and M is
        not.
    """
    occluded = grids.occluded > 0.5
    return grids._replace(occupied=(grids.occupied > 0.5) & ~occluded, occluded=occluded)
