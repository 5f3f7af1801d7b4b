"""Which chairs are voluminous: what a surface encloses, against SciPy's filling of holes."""

import jax.numpy as jnp
import numpy as np
from scipy.ndimage import binary_fill_holes

from iou_by_frames import solid, voluminous
from study import TestSet


def test_solids_are_surfaces_with_their_holes_filled():
    random = np.random.default_rng(0)
    box = np.zeros((3, 12, 12, 12), bool)
    box[:, 2:9, 3:12, 0:8] = True
    box[:, 4:7, 5:10, 2:6] = False  # a closed cavity; the second has a way out, the third is cut
    box[1, 5, 7, 6:8] = False
    box[2] &= random.random((12, 12, 12)) < 0.9
    speckled = random.random((3, 12, 12, 12)) < np.array([0.3, 0.6, 0.8])[:, None, None, None]
    for grids in (box, speckled):
        filled = solid(jnp.array(grids))
        assert np.array_equal(filled, [binary_fill_holes(grid) for grid in grids])
    assert solid(jnp.array(box))[0].sum() == 7 * 9 * 8
    assert np.array_equal(solid(jnp.array(box))[1], box[1])


def test_voluminous_chairs_are_few_and_the_same_each_time():
    found = [chair.name for chair in voluminous(TestSet(chairs=11, seats=0))]
    assert sorted(found) == ["chair-1000009", "chair-1000010"]
