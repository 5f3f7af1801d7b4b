"""Each fault does what its name says, in its share of the views, and nothing else happens."""

import itertools
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from jaxshape.data import inputs
from jaxshape.data.config import InputConfig
from jaxshape.data.dataset import pack
from jaxshape.data.inputs import draw_pair, faulty, grid_of, shrunk, voxels_of

VIEWS = 6
CLEAN = InputConfig(max_views=3, complete=0.0, mirror=False, scale=0.0, pose_error=0.0, missing=0.0,
                    segmentation=0.0)  # fmt: skip
ALL_FAULTS = InputConfig(complete=0.2, scale=0.3, pose_error=0.5, missing=0.5, segmentation=0.5)


def solid(low, high):
    grid = np.zeros([32] * 3, bool)
    grid[tuple(map(slice, low, high))] = True
    return grid


SURFACE = solid((3, 2, 5), (21, 30, 27)) & ~solid((4, 3, 6), (20, 29, 26))  # hollow, off centre
RNG = np.random.default_rng(0)
OBJECT = np.concatenate([[SURFACE], SURFACE & (RNG.random((VIEWS, 32, 32, 32)) < 0.2)])
PACKED = pack(OBJECT)
SPECKLED = RNG.random((32, 32, 32)) < 0.5  # each fault changes this one


def draw(config, seed):
    return draw_pair(PACKED, config, np.random.default_rng(seed))


def test_without_faults_a_measurement_fuses_one_to_the_most_views():
    counts = []
    for seed in range(150):
        measured, surface = draw(CLEAN, seed)
        np.testing.assert_array_equal(surface, SURFACE)
        chosen = [view for view in OBJECT[1:] if not (view & ~measured).any()]
        np.testing.assert_array_equal(np.any(chosen, axis=0), measured)
        counts.append(len(chosen))
    assert set(counts) == {1, 2, 3}
    assert np.bincount(counts)[1:].min() > 30


def test_more_views_than_there_are_means_at_most_all_of_them():
    fused = {draw(replace(CLEAN, max_views=99), seed)[0].sum() for seed in range(50)}
    assert max(fused) == OBJECT[1:].any(axis=0).sum()


def test_complete_inputs_are_the_surface_in_their_share():
    for seed in range(10):
        pair = draw(replace(ALL_FAULTS, complete=1.0), seed)
        np.testing.assert_array_equal(*pair)
    share = np.mean([np.array_equal(*draw(replace(CLEAN, complete=0.3), s)) for s in range(300)])
    assert abs(share - 0.3) < 0.1


def test_half_of_the_pairs_are_mirrored_left_to_right_both_grids_alike():
    flips = []
    for seed in range(60):
        plain, pair = draw(CLEAN, seed), draw(replace(CLEAN, mirror=True), seed)
        flips.append(not np.array_equal(pair[1], SURFACE))
        for before, after in zip(plain, pair, strict=True):
            np.testing.assert_array_equal(after, before[::-1] if flips[-1] else before)
    assert 15 < sum(flips) < 45


def test_a_shrunk_pair_lies_in_the_grid_in_one_piece_and_still_fits():
    config, fractions = replace(CLEAN, scale=0.4), []
    for seed in range(30):
        measured, surface = draw(config, seed)
        assert not (measured & ~surface).any() and measured.any()
        _, pieces = ndimage.label(surface, np.ones((3, 3, 3)))
        assert pieces == 1
        holes = ndimage.binary_fill_holes(surface).sum() / np.prod(extent(surface))
        assert holes == 1  # still closed: filled, it is its bounding box
        fractions.append(extent(surface) / extent(SURFACE))
    assert np.min(fractions) > 0.55 and np.max(fractions) <= 1.06
    assert np.std(fractions, axis=1).min() > 0  # each axis by its own factor


def extent(grid):
    return np.ptp(voxels_of(grid), axis=0) + 1


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_a_solid_box_stays_solid_when_shrunk(data):
    three = partial(st.tuples, *[st.floats(0, 1)] * 3)
    size = 0.3 + 0.7 * np.array(data.draw(three()))
    corner = (1 - size) * np.array(data.draw(three())) * 32
    sides = [sorted(data.draw(st.lists(st.integers(0, 32), min_size=2, max_size=2, unique=True)))
             for _ in range(3)]  # fmt: skip
    low, high = np.array(sides).T
    voxels = voxels_of(shrunk(solid(low, high), size, corner))
    assert len(voxels) == np.prod(np.ptp(voxels, axis=0) + 1)
    assert np.all(np.abs(voxels.min(axis=0) - (low * size + corner)) <= 1)
    assert np.all(np.abs(voxels.max(axis=0) + 1 - (high * size + corner)) <= 1)


def test_without_shrinking_every_voxel_stays_where_it_is():
    np.testing.assert_array_equal(shrunk(SPECKLED, np.ones(3), np.zeros(3)), SPECKLED)
    np.testing.assert_array_equal(grid_of(voxels_of(SPECKLED), 32), SPECKLED)
    np.testing.assert_array_equal(voxels_of(SPECKLED), np.argwhere(SPECKLED))


def test_a_cut_takes_whole_layers_off_one_side():
    cuts = set()
    for seed in range(200):
        cut = ~inputs._cut(np.ones([32] * 3, bool), np.random.default_rng(seed))
        low, high = voxels_of(cut).min(axis=0), voxels_of(cut).max(axis=0) + 1
        np.testing.assert_array_equal(cut, solid(low, high))
        (axis,) = np.flatnonzero(high - low < 32)
        assert low[axis] == 0 or high[axis] == 32
        cuts.add((axis, low[axis] == 0, high[axis] - low[axis]))
    assert {cut[:2] for cut in cuts} == {(axis, low) for axis in range(3) for low in (False, True)}
    assert {cut[2] for cut in cuts} == set(range(1, 9))
    view = inputs._cut(SPECKLED, np.random.default_rng(0))
    assert not (view & ~SPECKLED).any()


def test_a_leak_adds_a_patch_of_floor_or_wall_and_no_ceiling():
    sides = set()
    for seed in range(200):
        patch = inputs._leaked(np.zeros([32] * 3, bool), np.random.default_rng(seed))
        voxels = voxels_of(patch)
        low, high = voxels.min(axis=0), voxels.max(axis=0) + 1
        np.testing.assert_array_equal(patch, solid(low, high))
        assert (high - low).max() < 16
        flat = [(axis, low[axis]) for axis in np.flatnonzero(high - low == 1)]
        on_side = [(axis, i) for axis, i in flat if i == 0 or i == 31 and axis != 1]
        assert on_side
        sides |= set(on_side) if len(on_side) == 1 else set()
    assert sides == {(0, 0), (0, 31), (1, 0), (2, 0), (2, 31)}
    assert not (SPECKLED & ~inputs._leaked(SPECKLED, np.random.default_rng(0))).any()


def test_a_hole_is_a_ball_around_one_of_the_voxels():
    view, radii = OBJECT[1], []
    voxels = voxels_of(view)
    for seed in range(30):
        kept = inputs._holed(view, np.random.default_rng(seed))
        assert not (kept & ~view).any()
        is_kept = kept[tuple(voxels.T)]
        squared = np.sum((voxels[:, None] - voxels) ** 2, axis=-1)  # from every centre
        farthest_lost = np.max(squared, axis=1, where=~is_kept, initial=0)
        nearest_kept = np.min(squared, axis=1, where=is_kept, initial=9999)
        balls = ~is_kept & (farthest_lost < nearest_kept) & (nearest_kept > 4)
        assert (farthest_lost[balls] <= 64).any()
        radii.append(np.sqrt(farthest_lost[balls].min()))
    assert min(radii) < 3 < 6 < max(radii)


def test_a_pose_error_moves_a_view_by_at_most_a_voxel_along_each_axis():
    view, config = OBJECT[1], replace(CLEAN, pose_error=1.0)  # the view does not reach the sides
    moves = set()
    for seed in range(300):
        moved = faulty(view, config, np.random.default_rng(seed))
        move = voxels_of(moved)[0] - voxels_of(view)[0]
        np.testing.assert_array_equal(moved, np.roll(view, move, axis=(0, 1, 2)))
        moves.add(tuple(move))
    assert moves == set(itertools.product((-1, 0, 1), repeat=3))


def test_what_a_pose_error_moves_out_of_the_grid_is_gone():
    full, config = np.ones([32] * 3, bool), replace(CLEAN, pose_error=1.0)
    counts = [faulty(full, config, np.random.default_rng(s)).sum() for s in range(100)]
    assert set(counts) == {32**3, 31 * 32**2, 31**2 * 32, 31**3}


@pytest.mark.parametrize(
    "fault, changes", [("pose_error", 26 / 27), ("missing", 1), ("segmentation", 1)]
)
def test_a_fault_strikes_its_share_of_the_views(fault, changes):
    config = replace(CLEAN, **{fault: 0.3})
    rng = np.random.default_rng(0)
    struck = [not np.array_equal(faulty(SPECKLED, config, rng), SPECKLED) for _ in range(400)]
    assert abs(np.mean(struck) - 0.3 * changes) < 4 * np.sqrt(0.3 * 0.7 / 400)


def test_a_wrong_mask_cuts_as_often_as_it_leaks():
    config, rng = replace(CLEAN, segmentation=1.0), np.random.default_rng(0)
    cuts = [(SPECKLED & ~faulty(SPECKLED, config, rng)).any() for _ in range(200)]
    assert 70 < sum(cuts) < 130


def test_faults_strike_each_view_on_its_own_before_fusion():
    """With six views of the same thing, a hole in some of them is seldom one in their union."""
    same = pack(np.stack([SURFACE] * 7))
    config = replace(CLEAN, max_views=6, missing=0.5)
    whole = [np.array_equal(*draw_pair(same, config, np.random.default_rng(s))) for s in range(60)]
    assert 0.5 < np.mean(whole) < 0.95


def test_a_pair_is_a_function_of_the_random_numbers_alone():
    before = PACKED.copy()
    for seed in range(5):
        for grid, again in zip(draw(ALL_FAULTS, seed), draw(ALL_FAULTS, seed), strict=True):
            np.testing.assert_array_equal(grid, again)
    assert len({draw(ALL_FAULTS, seed)[0].tobytes() for seed in range(20)}) == 20
    np.testing.assert_array_equal(PACKED, before)


def test_faults_leave_the_view_they_were_given_as_it_was():
    before = SPECKLED.copy()
    for seed in range(50):
        faulty(SPECKLED, replace(ALL_FAULTS, segmentation=1.0), np.random.default_rng(seed))
    np.testing.assert_array_equal(SPECKLED, before)


def test_a_view_of_nothing_goes_through_every_fault():
    empty = np.zeros([32] * 3, bool)
    for seed in range(50):
        faults = faulty(empty, replace(ALL_FAULTS, missing=1.0), np.random.default_rng(seed))
        assert faults.shape == empty.shape
    everything = replace(ALL_FAULTS, segmentation=0.0, complete=0.0)
    measured, _ = draw_pair(pack(np.stack([SURFACE, empty])), everything, np.random.default_rng(0))
    assert not measured.any()
