"""Intersection over union, of whatever may stand for an occupied voxel."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxshape as js
from jaxshape.geometry.overlap import iou


def random_grids(*shape, seed=0):
    return np.random.default_rng(seed).random(shape) < 0.3


@pytest.mark.parametrize("batch", [(), (1,), (2, 3)])
def test_iou_is_that_of_the_sets_of_voxels(batch):
    a, b = random_grids(*batch, 4, 5, 6), random_grids(*batch, 4, 5, 6, seed=1)
    expected = [
        len(p & t) / len(p | t)
        for p, t in zip(
            *([set(np.flatnonzero(grid)) for grid in x.reshape(-1, 120)] for x in (a, b)),
            strict=True,
        )
    ]
    np.testing.assert_allclose(iou(a, b), np.reshape(expected, batch), rtol=1e-6)


def test_iou_broadcasts_and_ends_at_its_limits():
    truth = random_grids(4, 4, 4)
    predicted = np.stack([truth, ~truth, np.zeros_like(truth)])
    np.testing.assert_array_equal(iou(predicted, truth), [1, 0, 0])
    assert iou(np.zeros_like(truth), np.zeros_like(truth)) == 1


@pytest.mark.parametrize("kind", [np.uint8, np.int8, np.int32, bool])
@pytest.mark.parametrize("of", [np.asarray, jnp.asarray])
def test_ones_and_zeros_are_occupied_and_free(kind, of):
    a, b = random_grids(4, 5, 6), random_grids(4, 5, 6, seed=1)
    expected = iou(a, b)
    for pair in ((of(a.astype(kind)), b), (a, of(b.astype(kind))), (of(a.astype(kind)),) * 2):
        assert iou(*pair) == (1 if pair[0] is pair[1] else expected)
    assert jax.jit(iou)(a.astype(kind), b) == pytest.approx(float(expected))


@pytest.mark.parametrize(
    "wrong, sentence",
    [
        (np.full((2, 2, 2), 0.7, np.float32), "predicted grid holds float32; booleans.* with 0.5"),
        (np.full((2, 2, 2), 255, np.uint8), "predicted grid holds integers other than 0 and 1"),
        (np.full((2, 2, 2), -1), "predicted grid holds integers other than 0 and 1"),
    ],
)
def test_what_is_neither_occupied_nor_free_is_refused(wrong, sentence):
    truth = np.ones((2, 2, 2), bool)
    with pytest.raises(ValueError, match=sentence):
        js.iou(wrong, truth)
    with pytest.raises(ValueError, match=sentence.replace("predicted", "truth")):
        js.iou(truth, wrong)
