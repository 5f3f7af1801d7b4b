"""How sure each vertex of a mesh is. [host]"""

import numpy as np
from jaxtyping import Float

from jaxshape.geometry.grid import GridFrame


def confidence_at(
    vertices: Float[np.ndarray, "n 3"],
    probability: Float[np.ndarray, "x y z"],
    frame: GridFrame,
) -> Float[np.ndarray, " n"]:
    """The probability that there is surface where each vertex is, from 0 to 1.

    Vertices lie between occupied and free voxels, so the result is the highest probability of the
    eight voxels around a vertex.

    Args:
        vertices: Vertices in the object frame, in metres.
        probability: Probability that each voxel is surface.
        frame: Voxel frame of the grid.
    """
    # Voxel centres lie at + 0.5.
    at = (vertices - np.asarray(frame.origin)) / np.asarray(frame.voxel_size) - 0.5
    lower = np.floor(at).astype(int)
    last = np.array(probability.shape) - 1
    corners = np.stack(np.meshgrid(*[[0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3)
    around = np.clip(lower[:, None] + corners, 0, last)
    return probability[tuple(np.moveaxis(around, -1, 0))].max(axis=1)
