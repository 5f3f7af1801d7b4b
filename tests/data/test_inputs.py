"""Training pairs are drawn from what was measured, sometimes mirrored, sometimes complete."""

import numpy as np
import pytest
from scipy import ndimage

from jaxshape.data.config import InputConfig
from jaxshape.data.dataset import Dataset, pack, pack_measured
from jaxshape.data.inputs import draw_pair, source_layers, warped
from jaxshape.geometry.grids import Grids

RNG = np.random.default_rng(0)
SURFACE = RNG.random((2, 3, 16, 16, 16)) < 0.2  # two objects, three paths
OCCLUDED = RNG.random((2, 3, 4, 16, 16, 16)) < 0.3
OCCUPIED = SURFACE[:, :, None] & ~OCCLUDED
DATASET = Dataset(
    ["a", "b"], [pack(SURFACE)], [pack_measured(Grids(OCCUPIED, OCCLUDED))], [(0, 0), (0, 1)]
)
PLAIN = InputConfig(complete=0.0, mirror=False, warp=0.0)


def draw(config, seed, index=1):
    return draw_pair(DATASET, index, config, np.random.default_rng(seed))


def test_plain_pairs_are_the_measurements_of_the_object_each_with_the_surface_of_its_path():
    drawn = set()
    for seed in range(200):
        grids, surface = draw(PLAIN, seed)
        (path,) = [p for p in range(3) if np.array_equal(surface, SURFACE[1, p])]
        (number,) = [k for k in range(4) if np.array_equal(grids.occluded, OCCLUDED[1, path, k])]
        np.testing.assert_array_equal(grids.occupied, OCCUPIED[1, path, number])
        drawn.add((path, number))
    assert len(drawn) == 12


def test_complete_inputs_are_the_surface_and_hide_nothing():
    shares = []
    for seed in range(300):
        grids, surface = draw(InputConfig(complete=0.3, mirror=False, warp=0.0), seed)
        complete = np.array_equal(grids.occupied, surface)
        assert not complete or not grids.occluded.any()
        shares.append(complete)
    assert abs(np.mean(shares) - 0.3) < 0.1


def test_half_of_the_pairs_are_mirrored_left_to_right_all_grids_alike():
    flips = []
    for seed in range(60):
        grids, surface = draw(PLAIN, seed)
        other, mirrored = draw(InputConfig(complete=0.0, mirror=True, warp=0.0), seed)
        flips.append(not np.array_equal(mirrored, surface))
        step = -1 if flips[-1] else 1
        np.testing.assert_array_equal(mirrored, surface[::step])
        np.testing.assert_array_equal(other.occupied, grids.occupied[::step])
        np.testing.assert_array_equal(other.occluded, grids.occluded[::step])
    assert 15 < sum(flips) < 45


def solid(low, high, side=32):
    grid = np.zeros([side] * 3, bool)
    grid[tuple(map(slice, low, high))] = True
    return grid


def test_warps_keep_both_ends_and_the_order_of_layers():
    for seed in range(50):
        first = source_layers(32, 0.4, np.random.default_rng(seed))
        assert first[0] == 0 and 30 <= first[-1] <= 31
        steps = np.diff(first)
        assert steps.min() >= 0 and steps.max() <= 3
    np.testing.assert_array_equal(source_layers(32, 0.0, np.random.default_rng(0)), np.arange(32))


def test_a_warped_pair_is_one_piece_without_holes_and_still_agrees():
    hollow = solid((3, 2, 5), (21, 30, 27)) & ~solid((4, 3, 6), (20, 29, 26))
    changed = 0
    for seed in range(30):
        M = np.float32(solid((0, 0, 0), (32, 32, 12)))
        grids = Grids(np.float32(hollow) * (1 - M), M)
        other, surface = warped(grids, hollow, 0.4, np.random.default_rng(seed))
        _, pieces = ndimage.label(surface, np.ones((3, 3, 3)))
        box = np.ptp(np.argwhere(surface), axis=0) + 1
        assert pieces == 1 and ndimage.binary_fill_holes(surface).sum() == box.prod()
        known = other.occluded < 0.5
        np.testing.assert_array_equal((other.occupied > 0.5) & known, surface & known)
        assert known.any() and not known.all()
        changed += (surface != hollow).any()
    assert changed > 25


def test_a_soft_pair_stays_a_probability_and_no_warp_changes_nothing():
    rng = np.random.default_rng(0)
    grids = Grids(*np.float32(rng.random((2, 16, 16, 16))))
    other, _ = warped(grids, SURFACE[0, 0], 0.3, rng)
    for x in other[:2]:
        assert x.min() >= 0 and x.max() <= 1
    same, surface = warped(grids, SURFACE[0, 0], 0.0, rng)
    np.testing.assert_allclose(same.occupied, grids.occupied, atol=1e-5)
    np.testing.assert_allclose(same.occluded, grids.occluded, atol=1e-5)
    np.testing.assert_array_equal(surface, SURFACE[0, 0])


@pytest.mark.parametrize("share", [-0.1, 1.1])
def test_a_share_is_from_0_to_1(share):
    with pytest.raises(ValueError, match="complete"):
        InputConfig(complete=share)
