"""Procedural chairs: canonical and of real sizes."""

import numpy as np
import pytest
from procedural_shapes import voxels

from jaxshape.data.chairs import STYLES, VOLUMINOUS, random_chair

NO_BACK_OR_A_TRAY = {"stool", "bar stool", "bench", "folding", "pouffe", "high chair"}


@pytest.mark.parametrize("style", STYLES)
def test_box_is_centred_and_of_a_real_size(style, without_shape_checks):
    for seed in range(20):
        mesh = random_chair(seed, style=style)
        scale = 0.55 if mesh.metadata["drawn"].get("for") == "child" else 1.0
        assert np.allclose(mesh.bounds.sum(0), 0, atol=1e-9)
        low, high = np.array([0.25, 0.3, 0.25]) * scale, np.array([2.6, 1.6, 2.3])
        assert (mesh.extents > low).all() and (mesh.extents < high).all(), (seed, mesh.extents)


@pytest.mark.parametrize("style", sorted(set(STYLES) - NO_BACK_OR_A_TRAY))
def test_the_back_is_behind(style, without_shape_checks):
    """Above the middle of the box, the surface lies behind its centre."""
    offsets = []
    for seed in range(20):
        mesh = random_chair(seed, style=style)
        high = mesh.triangles_center[:, 1] > 0.35 * mesh.extents[1]
        offsets.append(np.average(mesh.triangles_center[high, 2], weights=mesh.area_faces[high]))
    assert np.mean(np.array(offsets) < 0) >= 0.95


@pytest.mark.parametrize("style", ["side chair", "armchair", "stool", "bar stool", "office"])
def test_up_is_y(style, without_shape_checks):
    """A ray from above meets the seat where `seat height` says, above the floor."""
    for seed in range(10):
        mesh = random_chair(seed, style=style)
        if "seat height" not in mesh.metadata["drawn"] or "for" in mesh.metadata["drawn"]:
            continue
        hits, _, _ = mesh.ray.intersects_location([[0.01, 2.0, 0.0]], [[0.0, -1.0, 0.0]])
        top = hits[:, 1].max() - mesh.bounds[0, 1]
        assert abs(top - mesh.metadata["drawn"]["seat height"]) < 0.13


def test_voluminous_seats_fill_more_of_their_box(without_shape_checks):
    """Seen as the share of the box that lies between the lowest and the highest surface."""

    def filled(style: str) -> float:
        shares = []
        for seed in range(10):
            grid = voxels(random_chair(seed, style=style))
            below = np.maximum.accumulate(grid, 1)
            above = np.maximum.accumulate(grid[:, ::-1], 1)[:, ::-1]
            shares.append((below & above).mean())
        return float(np.mean(shares))

    assert VOLUMINOUS < set(STYLES)
    slender = max(filled(style) for style in ("side chair", "shell", "cantilever", "lounge"))
    assert min(filled(style) for style in VOLUMINOUS) > slender
