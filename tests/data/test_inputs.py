"""Training pairs are drawn from what was measured, sometimes mirrored, sometimes complete."""

import numpy as np
import pytest

from jaxshape.data.config import InputConfig
from jaxshape.data.dataset import Dataset, pack, pack_measured
from jaxshape.data.inputs import draw_pair
from jaxshape.geometry.grids import Grids

RNG = np.random.default_rng(0)
SURFACE = RNG.random((2, 3, 16, 16, 16)) < 0.2  # two objects, three paths
OCCLUDED = RNG.random((2, 3, 4, 16, 16, 16)) < 0.3
OCCUPIED = SURFACE[:, :, None] & ~OCCLUDED
DATASET = Dataset(
    ["a", "b"], [pack(SURFACE)], [pack_measured(Grids(OCCUPIED, OCCLUDED))], [(0, 0), (0, 1)]
)
PLAIN = InputConfig(complete=0.0, mirror=False)


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
        grids, surface = draw(InputConfig(complete=0.3, mirror=False), seed)
        complete = np.array_equal(grids.occupied, surface)
        assert not complete or not grids.occluded.any()
        shares.append(complete)
    assert abs(np.mean(shares) - 0.3) < 0.1


def test_half_of_the_pairs_are_mirrored_left_to_right_all_grids_alike():
    flips = []
    for seed in range(60):
        grids, surface = draw(PLAIN, seed)
        other, mirrored = draw(InputConfig(complete=0.0, mirror=True), seed)
        flips.append(not np.array_equal(mirrored, surface))
        step = -1 if flips[-1] else 1
        np.testing.assert_array_equal(mirrored, surface[::step])
        np.testing.assert_array_equal(other.occupied, grids.occupied[::step])
        np.testing.assert_array_equal(other.occluded, grids.occluded[::step])
    assert 15 < sum(flips) < 45


@pytest.mark.parametrize("share", [-0.1, 1.1])
def test_a_share_is_from_0_to_1(share):
    with pytest.raises(ValueError, match="complete"):
        InputConfig(complete=share)
