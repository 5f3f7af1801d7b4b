"""What tests of pictures look at."""

import numpy as np


def grid_of(*cells, n=32):
    """A grid in which these voxels are occupied."""
    grid = np.zeros((n, n, n), bool)
    for cell in cells:
        grid[cell] = True
    return grid


def drawn(image):
    """The pixels that are not white."""
    return np.any(image < 250, axis=-1)


def rgb(color):
    """The parts of a colour `#rrggbb`, up to 255."""
    return np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)])
