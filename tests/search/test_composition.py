"""The composed shape keeps what was measured; its mirror image tells of what is hidden."""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxshape.geometry.grids import Grids
from jaxshape.geometry.symmetry import mirror
from jaxshape.model.calibration import Calibration
from jaxshape.search.composition import (
    LEAST_PROBABILITY,
    agreed,
    best_threshold,
    complete,
    compose,
)

LOGITS = jnp.asarray(np.random.default_rng(0).normal(size=(2, 16, 16, 16)), jnp.float32)


def half_seen(*, symmetric=True) -> Grids:
    """A symmetric object of which the left half was measured, and of the right only a leg."""
    surface = jnp.asarray(np.random.default_rng(1).random((16, 16, 16)) < 0.2)
    surface = surface.at[6:10].set(False)
    surface = surface.at[:8].set(surface[:8] & mirror(surface)[:8])
    surface = surface.at[2:5, :4, 2:5].set(False).at[3, :4, 3].set(True)
    surface = surface | mirror(surface)
    if not symmetric:  # the leg of the right stands elsewhere, and more of it was seen
        surface = surface.at[8:].set(False).at[12, :, 10:14].set(True)
        surface = surface.at[1:6, :, 8:].set(False)
    hidden = jnp.ones((16, 16, 16), bool).at[:8].set(False)
    leg = jnp.s_[11:15, :4, 2:5] if symmetric else jnp.s_[11:15, :, 8:]
    hidden = hidden.at[leg].set(False)
    return Grids(surface & ~hidden, hidden)


def batch(*grids: Grids) -> Grids:
    return jax.tree.map(lambda *x: jnp.stack(x), *grids)


def test_what_is_hidden_is_the_mirror_image_of_what_was_seen():
    """Where a decoded shape is not sure of anything, the other side decides."""
    grids = half_seen()
    found = complete(grids, 0.5 * LOGITS[0], symmetry=True)
    assert bool(found.symmetric) and float(found.agreement) == 1
    whole = grids.occupied | mirror(grids.occupied)
    np.testing.assert_array_equal(found.composed[8:], whole[8:])


@pytest.mark.parametrize("soft", [False, True])
def test_each_object_decides_for_itself(soft):
    """One whose halves disagree is filled as if symmetry had not been asked for."""
    grids = batch(half_seen(), half_seen(symmetric=False))
    if soft:
        F, M, _ = grids
        grids = Grids(jnp.where(F, 0.95, 0.02), jnp.where(M, 0.98, 0.01))
    plain, found = (complete(grids, LOGITS, symmetry=symmetry) for symmetry in (False, True))
    np.testing.assert_array_equal(found.symmetric, [True, False])
    assert found.agreement[0] > 0.9 and found.agreement[1] < 0.5
    np.testing.assert_array_equal(found.logits[1], LOGITS[1])
    np.testing.assert_array_equal(found.composed[1], plain.composed[1])
    assert np.any(found.composed[0] != plain.composed[0])


def test_what_was_measured_stays():
    grids = batch(half_seen(), half_seen(symmetric=False))
    composed = np.asarray(complete(grids, LOGITS, symmetry=True).composed)
    seen = ~np.asarray(grids.occluded)
    np.testing.assert_array_equal(composed[seen], np.asarray(grids.occupied)[seen])


def test_without_symmetry_the_decoded_shape_fills_what_is_hidden():
    grids = batch(half_seen(), half_seen(symmetric=False))
    found = complete(grids, LOGITS, symmetry=False)
    assert found.symmetric is None and found.agreement is None
    np.testing.assert_array_equal(found.logits, LOGITS)
    np.testing.assert_array_equal(found.composed, compose(*grids[:2], LOGITS > 0))


def test_a_decoder_that_knew_the_measurement_decides_on_free_space_but_not_on_surface():
    grids = batch(half_seen(), half_seen(symmetric=False))
    found = complete(grids, LOGITS, symmetry=True, conditional=True)
    surface = np.asarray(grids.occupied)
    free = ~surface & ~np.asarray(grids.occluded)
    composed, decoded = np.asarray(found.composed), np.asarray(LOGITS > 0)
    assert composed[surface].all()
    np.testing.assert_array_equal(composed[free], decoded[free])
    np.testing.assert_array_equal(np.asarray(found.logits)[~np.asarray(grids.occluded)],
                                  np.asarray(LOGITS)[~np.asarray(grids.occluded)])  # fmt: skip
    assert np.any(found.logits[0] != LOGITS[0])
    np.testing.assert_array_equal(found.logits[1], LOGITS[1])


def test_soft_grids_count_as_much_as_a_decoder_that_knew_them():
    F = jnp.array([0.9, 0.9, 0.1, 0.1, 0.9, 0.1]).reshape(1, 1, 6)
    M = jnp.array([0.0, 0.0, 0.0, 0.0, 1.0, 1.0]).reshape(1, 1, 6)
    p = jnp.array([0.2, 0.05, 0.95, 0.8, 0.4, 0.6]).reshape(1, 1, 6)
    found = agreed(F, M, p).ravel() > 0.5
    np.testing.assert_array_equal(found, [True, False, True, False, False, True])


@pytest.mark.parametrize("seed", range(5))
def test_no_set_of_voxels_has_a_greater_expected_iou(seed):
    p = np.random.default_rng(seed).beta(1, 0.5, 8)  # the threshold is above the least one
    sets = np.array(list(product([False, True], repeat=8)))
    iou = (sets @ p) / (sets.sum(1) + (~sets) @ p)
    threshold = float(best_threshold(jnp.asarray(p).reshape(2, 2, 2)))
    np.testing.assert_array_equal(p > threshold, sets[np.argmax(iou)])
    assert threshold == pytest.approx(iou.max() / (1 + iou.max()), abs=1e-6)


def test_the_threshold_lies_between_a_third_and_a_half():
    surface = jnp.asarray(np.random.default_rng(0).random((16, 16, 16)) < 0.3).astype(float)
    sure, vague, none = surface, 0.2 + 0.1 * surface, 0.0 * surface
    found = best_threshold(jnp.stack([sure, vague, none]))
    np.testing.assert_allclose(found, [0.5, LEAST_PROBABILITY, LEAST_PROBABILITY], atol=1e-6)


@pytest.mark.parametrize("soft", [False, True])
def test_a_calibrated_shape_has_the_greatest_expected_iou(soft):
    """With truths drawn from the calibrated probabilities, no other offset is better on average."""
    grids, offset = half_seen(), -1.0
    if soft:
        grids = Grids(*(x.astype(float) for x in grids[:2]))
    logits = jnp.where(grids.occluded > 0.5, 2 * LOGITS[0], 9.0 * (2 * grids.occupied - 1))
    drawn = np.random.default_rng(2).random((64, 16, 16, 16))
    truth = drawn < np.asarray(jax.nn.sigmoid(logits + offset))
    truth = jnp.where(grids.occluded > 0.5, truth, grids.occupied > 0.5)

    def mean_iou(shape):
        axes = (-3, -2, -1)
        return float(jnp.mean((truth & shape).sum(axes) / (truth | shape).sum(axes)))

    calibration = Calibration(offset=offset)
    found = complete(grids, logits, symmetry=False, conditional=True, calibration=calibration)
    others = [
        complete(grids, logits + x, symmetry=False, conditional=True).composed
        for x in (-1.5, -1, -0.25, 0, 0.5)
    ]
    assert mean_iou(found.composed) > max(map(mean_iou, others))
    np.testing.assert_array_equal(found.logits, logits)


def test_objects_of_a_batch_are_independent():
    grids = batch(half_seen(), half_seen(symmetric=False))
    both = complete(grids, LOGITS, symmetry=True)
    for i in range(2):
        one = complete(jax.tree.map(lambda x, i=i: x[i], grids), LOGITS[i], symmetry=True)
        jax.tree.map(lambda x, y, i=i: np.testing.assert_allclose(x[i], y, atol=1e-6), both, one)
