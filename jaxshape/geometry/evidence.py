"""What was measured of each voxel: the measurement grid F and the occlusion mask M of one object.

Both come from fused frames (`fusion`, paper Eq. 6), binary as in the paper, or soft: then they are
probabilities, and a voxel's surface, free space and ignorance weigh F (1 - M), (1 - F) (1 - M)
and M, which sum to 1.
"""

from typing import Any, NamedTuple

from jaxtyping import Array, Bool, Float

Grid = Bool[Array, "*batch x y z"] | Float[Array, "*batch x y z"]


class Grids(NamedTuple):
    """What shape models and residuals are given of an object; leading axes are batch axes.

    Attributes:
        occupied: **F** `[*batch x y z]`, True (or its probability) where the surface was measured.
            It counts only where the voxel is not occluded.
        occluded: **M** `[*batch x y z]`, True (or its probability) where nothing is known.
        data: Whatever else your own model or residual needs of each object: any pytree of arrays
            with the same batch axes.
    """

    occupied: Grid
    occluded: Grid
    data: Any = None


def binary(grids: Grids) -> Grids:
    """Round soft grids to the binary F and M of the paper.

    Args:
        grids: Binary or soft grids; binary ones come back unchanged.

    Returns:
        Grids of booleans: occluded where M is above 1/2, occupied where F is and M is not.
    """
    occluded = grids.occluded > 0.5
    return grids._replace(occupied=(grids.occupied > 0.5) & ~occluded, occluded=occluded)
