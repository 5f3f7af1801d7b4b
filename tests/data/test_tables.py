"""Procedural tables: of one piece, on their feet, of real sizes, with the long side along x."""

import numpy as np
import pytest
from procedural_shapes import voxels
from scipy import ndimage
from scipy.spatial import ConvexHull

from jaxshape.data.tables import STYLES, random_table

every_style = pytest.mark.parametrize("style", STYLES)

FRONT_FIRST = {"corner desk", "nest"}
"""Styles whose depth is that of something in front of the top."""


@every_style
def test_a_table_is_one_piece(style, without_shape_checks):
    """Its surface on a grid hangs together; a chip of a few voxels may stand off, as a thin pane
    between two of them does."""
    for seed in range(12):
        labels, count = ndimage.label(voxels(random_table(seed, style=style), 24, 60_000),
                                      np.ones((3, 3, 3)))  # fmt: skip
        sizes = np.bincount(labels.ravel())[1:]
        assert sizes.max() > 0.98 * sizes.sum(), (seed, sizes)


@every_style
def test_a_table_stands_on_its_feet(style, without_shape_checks):
    """The middle of its surface lies above what touches the floor."""
    for seed in range(20):
        mesh = random_table(seed, style=style)
        low = mesh.vertices[:, 1] < mesh.bounds[0, 1] + 0.03
        feet = ConvexHull(mesh.vertices[low][:, [0, 2]])
        x, z = mesh.centroid[[0, 2]]
        assert (feet.equations @ (x, z, 1) < 0).all(), seed


@every_style
def test_box_is_centred_and_of_a_real_size(style, without_shape_checks):
    for seed in range(20):
        mesh = random_table(seed, style=style)
        scale = 0.55 if mesh.metadata["drawn"].get("for") == "child" else 1.0
        assert np.allclose(mesh.bounds.sum(0), 0, atol=1e-9)
        low, high = np.array([0.28, 0.22, 0.22]) * scale, np.array([3.3, 2.1, 2.1])
        assert (mesh.extents > low).all() and (mesh.extents < high).all(), (seed, mesh.extents)


@pytest.mark.parametrize("style", sorted(set(STYLES) - FRONT_FIRST))
def test_the_long_side_of_the_top_lies_along_x(style, without_shape_checks):
    """Feet and leaves may stand out by a few centimetres."""
    for seed in range(20):
        extents = random_table(seed, style=style).extents
        assert extents[2] < 1.15 * extents[0] + 0.06 or style in ("picnic", "drop leaf"), seed


@pytest.mark.parametrize("style", ["dining", "pedestal", "coffee", "console", "bar"])
def test_the_top_is_on_top(style, without_shape_checks):
    """Seen from above, most of the box is covered within the uppermost eighth."""
    for seed in range(10):
        grid = voxels(random_table(seed, style=style), 16)
        assert grid[:, 13:].any(1).mean() > 0.5, seed


def test_the_sitter_of_a_desk_has_room_in_front(without_shape_checks):
    """Behind more than in front, the lower half of a desk is closed between its ends."""
    closed = np.zeros(2)
    for seed in range(30):
        middle = voxels(random_table(seed, style="desk"), 16)[6:10, 2:9]
        closed += middle[:, :, 12:].mean(), middle[:, :, :4].mean()
    assert closed[1] > 2 * closed[0] > 0
