"""Training pairs as a reconstruction would meet them: fused views, with faults. [host]"""

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from jaxshape.data.config import InputConfig
from jaxshape.data.dataset import unpack

Grid = Bool[np.ndarray, "x y z"]
Voxels = Int[np.ndarray, "n 3"]


def draw_pair(
    packed: UInt8[np.ndarray, "view bytes"], config: InputConfig, rng: np.random.Generator
) -> tuple[Grid, Grid]:
    """The measurement and the complete surface of one training pair.

    Args:
        packed: An object's surface, then its views, as `Dataset.packed` gives them.
        config: How the input is drawn.
        rng: Random generator of the draws.
    """
    surface, views = unpack(packed[0]), packed[1:]
    if rng.random() < config.complete:
        measured = surface
    else:
        count = rng.integers(1, min(config.max_views, len(views)) + 1)
        chosen = unpack(views[rng.choice(len(views), count, replace=False)])
        measured = np.any([faulty(view, config, rng) for view in chosen], axis=0)
    if config.mirror and rng.random() < 0.5:
        measured, surface = measured[::-1], surface[::-1]
    if config.scale:
        size = 1 - config.scale * rng.random(3)
        corner = (1 - size) * rng.random(3) * len(surface)
        measured, surface = shrunk(measured, size, corner), shrunk(surface, size, corner)
    return measured, surface


def faulty(view: Grid, config: InputConfig, rng: np.random.Generator) -> Grid:
    """One view with the faults of real ones, each in its share of the views."""
    if rng.random() < config.segmentation:
        view = _cut(view, rng) if rng.random() < 0.5 else _leaked(view, rng)
    if rng.random() < config.missing:
        view = _holed(view, rng)
    if rng.random() < config.pose_error:
        view = grid_of(voxels_of(view) + rng.integers(-1, 2, 3), len(view))
    return view


def _cut(view: Grid, rng: np.random.Generator) -> Grid:
    """The view without up to a quarter of the grid at one of its six sides."""
    kept = view.copy()
    inwards = np.moveaxis(kept, rng.integers(3), 0)[:: 1 if rng.random() < 0.5 else -1]
    inwards[: rng.integers(1, len(view) // 4 + 1)] = False
    return kept


def _leaked(view: Grid, rng: np.random.Generator) -> Grid:
    """The view with a patch of floor or wall: part of one of the sides of the grid."""
    n = len(view)
    low = rng.integers(0, n, 3)
    high = low + rng.integers(n // 8, n // 2, 3)
    side = rng.integers(3)
    low[side] = 0 if side == 1 else rng.choice([0, n - 1])  # a floor, but no ceiling
    high[side] = low[side] + 1
    leaked = view.copy()
    leaked[tuple(map(slice, low, high))] = True
    return leaked


def _holed(view: Grid, rng: np.random.Generator) -> Grid:
    """The view without the voxels in a ball around one of them."""
    voxels = voxels_of(view)
    if len(voxels) == 0:
        return view
    offset = voxels - voxels[rng.integers(len(voxels))]
    kept = voxels[np.sum(offset**2, axis=1) > rng.uniform(2, len(view) / 4) ** 2]
    return grid_of(kept, len(view))


def shrunk(grid: Grid, size: Float[np.ndarray, "3"], corner: Float[np.ndarray, "3"]) -> Grid:
    """The grid in a box of relative `size`, at most 1, whose low corner lies at `corner` [voxels].

    Neighbours stay neighbours or become one, so no surface gets holes.
    """
    return grid_of(np.floor((voxels_of(grid) + 0.5) * size + corner).astype(int), len(grid))


def voxels_of(grid: Grid) -> Voxels:
    """The occupied voxels; `np.argwhere`, but five times as fast."""
    return np.stack(np.unravel_index(np.flatnonzero(grid), grid.shape), axis=-1)


def grid_of(voxels: Voxels, resolution: int) -> Grid:
    """The grid in which these voxels are occupied; those outside it are left out."""
    inside = voxels[((voxels >= 0) & (voxels < resolution)).all(axis=1)]
    grid = np.zeros([resolution] * 3, bool)
    grid[tuple(inside.T)] = True
    return grid
