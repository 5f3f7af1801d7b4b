"""Thin parts, which appear as specks in single frames, confirmed by other frames. [host]

A leg two pixels wide falls into pieces too small for clusters, and so does noise. Specks that
several frames show in the same place, connected with the object, belong to it.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage
from skimage.measure import label

from jaxshape.data.boxes import Box

CELL = 0.02
"""Edge of the cells in which frames are compared, in metres."""

CONFIRMED = 2
"""Frames that have to show a speck."""


def confirmed(
    specks: list[Float[np.ndarray, "_ 3"]], ours: list[Float[np.ndarray, "_ 3"]], reach: Box
) -> list[Bool[np.ndarray, " _"]]:
    """Whether specks of frames are part of the object.

    Args:
        specks: Points of the specks of each frame, in the world, in metres.
        ours: Points of each frame that are known to be the object.
        reach: The largest box that the object may fill.

    Returns:
        For each frame, True for specks that at least `CONFIRMED` frames show, as specks or as the
        object, and that are connected with it.
    """
    shape = tuple(np.ceil(reach.size / CELL).astype(int).tolist())
    ours_in = [_filled(points, reach, shape) for points in ours]
    specks_in = [_filled(points, reach, shape) for points in specks]
    shown = np.zeros(shape, np.int32)
    for mine, loose in zip(ours_in, specks_in, strict=True):
        shown += _grown(mine | loose)
    body, loose = np.any(ours_in, axis=0), np.any(specks_in, axis=0) & (shown >= CONFIRMED)
    # Neighbours of neighbours are connected: thin parts have gaps.
    labels = np.asarray(label(_grown(body | loose), connectivity=3))
    connected = loose & np.isin(labels, np.unique(labels[body]))
    return [connected[tuple(_cells(points, reach, shape).T)] for points in specks]


def _filled(
    points: Float[np.ndarray, "n 3"], reach: Box, shape: tuple[int, ...]
) -> Bool[np.ndarray, "x y z"]:
    """Cells that hold points."""
    filled = np.zeros(shape, bool)
    filled[tuple(_cells(points, reach, shape).T)] = True
    return filled


def _grown(cells: Bool[np.ndarray, "x y z"]) -> Bool[np.ndarray, "x y z"]:
    """The cells and all their neighbours."""
    return ndimage.maximum_filter(cells, 3)  # much faster than a dilation


def _cells(points: Float[np.ndarray, "n 3"], reach: Box, shape: tuple[int, ...]) -> np.ndarray:
    """The cell of each point; the outermost for those outside."""
    R, t = reach.T_world_object[:3, :3], reach.T_world_object[:3, 3]
    cell = np.floor(((points - t) @ R + reach.size / 2) / CELL).astype(int)
    return np.clip(cell, 0, np.array(shape) - 1)
