"""What the tests of procedural objects share."""

import numpy as np
import trimesh


def voxels(mesh: trimesh.Trimesh, side: int = 16, points: int = 4000) -> np.ndarray:
    """Cells of the box, `side` along each axis, that hold one of so many points of the surface."""
    sample = trimesh.sample.sample_surface(mesh, points, seed=0)[0]
    cells = np.clip(np.floor((sample / mesh.extents + 0.5) * side), 0, side - 1).astype(int)
    grid = np.zeros((side, side, side), bool)
    grid[tuple(cells.T)] = True
    return grid
