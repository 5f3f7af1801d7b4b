"""What priors predict of hidden parts, and the classes and fronts that follow."""

import jax.numpy as jnp
import numpy as np
import pytest
from known_shape import known_shape

from jaxshape.data.boxes import Box
from jaxshape.data.chairs import random_chair
from jaxshape.data.tables import random_table
from jaxshape.geometry.grids import Grids
from jaxshape.mapping.scene.boxing import turned_box
from jaxshape.mapping.scene.classes import (
    EXCLUDED,
    UNUSUAL,
    Decision,
    decide,
    decided,
    deviation,
    unfilled,
)
from jaxshape.mapping.scene.evidence import TURNS, hidden_parts, predict_hidden, turned

CLEAR = np.array([-1.4, -1.0, -1.5, -1.4])
"""Log-likelihoods of a chair with its front at the second side."""


@pytest.fixture(scope="module")
def meshes():
    return {"chair": random_chair(2, style="side chair"), "table": random_table(4)}


@pytest.fixture(scope="module")
def priors(meshes):
    return {name: known_shape(mesh, mesh.extents) for name, mesh in meshes.items()}


def measured(one, quarters=0):
    """A whole measurement of what a prior knows, in a box whose front is turned away."""
    occupied = turned(jnp.float32(one.params["mean"]), -quarters)
    return Grids(occupied, jnp.zeros_like(occupied))


def stacked(*grids):
    return Grids(*(jnp.stack(x) for x in list(zip(*grids, strict=True))[:2]))


def test_a_grid_is_turned_as_the_box_is():
    """Voxels of a turned grid lie where they lay in the world."""
    rng = np.random.default_rng(0)
    grid, size = rng.random((6, 6, 6)), np.array([1.0, 2.0, 3.0])
    box = Box(np.eye(4), size)

    def centers(box):
        unit = (np.stack(np.indices((6, 6, 6)), -1) + 0.5) / 6 - 0.5
        T = box.T_world_object
        return (unit * box.size) @ T[:3, :3].T + T[:3, 3]

    where = centers(box).reshape(-1, 3).round(6) + 0.0
    value = dict(zip(map(tuple, where), grid.ravel(), strict=True))
    for quarters in range(TURNS):
        found = np.asarray(turned(jnp.asarray(grid), quarters)).ravel()
        where = centers(turned_box(box, quarters)).reshape(-1, 3).round(6)
        np.testing.assert_allclose(found, [value[tuple(p + 0.0)] for p in where], rtol=1e-6)


def test_every_voxel_is_hidden_and_seen_equally_often():
    hidden = hidden_parts(32)
    np.testing.assert_array_equal(hidden.sum(axis=0), len(hidden) / 2)


@pytest.mark.parametrize("quarters", range(TURNS))
def test_class_and_front_are_those_of_the_prior_that_knows_the_object(priors, quarters):
    grids = stacked(*(measured(one, quarters) for one in priors.values()))
    chair, table = decide(priors, grids)
    assert (chair.name, chair.quarters) == ("chair", quarters)
    assert chair.sure > 0.9
    assert table.name == "table"  # its front may look any way


def test_noise_is_of_no_class(priors):
    rng = np.random.default_rng(0)
    occupied = jnp.float32(rng.random((32, 32, 32)) < 0.1)
    (found,) = decide(priors, stacked(Grids(occupied, jnp.zeros_like(occupied))))
    assert found.name is None


def test_what_is_decided_does_not_depend_on_what_stands_beside(priors):
    chair, table = (measured(one) for one in priors.values())
    alone = decide(priors, stacked(chair))[0]
    among = decide(priors, stacked(table, chair, table))[1]
    assert (alone.name, alone.quarters) == (among.name, among.quarters)
    assert alone.sure == pytest.approx(among.sure, abs=1e-4)


def test_scores_are_means_over_the_hidden_voxels(priors):
    """Against a slow sum, for one prior and one turn."""
    one = priors["chair"]
    grids = measured(one)
    found = predict_hidden(one, stacked(grids))
    F = np.asarray(grids.occupied)
    logits = []
    from jaxshape.model.shapes import decode, encode

    for hidden in hidden_parts(32):
        rows = Grids(jnp.where(hidden, 0, F)[None], jnp.float32(hidden)[None])
        logits.append(np.asarray(decode(one, encode(one, rows)))[0])
    slow = [
        np.mean(-np.log1p(np.exp(-x[hidden & (F > 0)])))
        for x, hidden in zip(logits, hidden_parts(32), strict=True)
    ]
    assert float(found[0, 0]) == pytest.approx(np.mean(slow), rel=1e-3)


def test_nothing_is_added_to_an_object_of_no_class(priors):
    grids = measured(priors["chair"])
    shape = unfilled(grids, jnp.zeros(6))
    np.testing.assert_array_equal(shape.composed[0], np.asarray(grids.occupied) > 0)
    assert not shape.completed.any() and (shape.fill_logits < -10).all()


def test_a_decision_needs_more_than_the_best_of_bad_answers():
    worse = decided({"chair": np.array([-3.0, -4, -4, -4])})
    assert worse.name is None
    clear = decided({"chair": CLEAR, "table": np.full(8, -0.5)})
    assert (clear.name, clear.quarters) == ("chair", 1)
    tied = decided({"chair": np.full(4, -1.0), "table": np.full(8, -1.0)})
    assert tied.name is None


def test_a_confident_prior_does_not_win_every_object():
    """Likelihoods count against those of wrong stances of the same prior."""
    on_legs = np.array([-0.6, -0.7, -0.6, -0.7, -0.9, -0.9, -0.9, -0.9])
    beside = np.full(4, -0.1)  # more likely from all sides
    table = decided({"chair": beside, "table": on_legs})
    assert (table.name, table.sure > 0.9) == ("table", True)
    assert decided({"chair": beside, "table": np.roll(on_legs, 4)}).name is None
    assert decided({"chair": CLEAR, "table": on_legs}).name == "chair"  # it has a front
    doubtful = np.array([-0.9, -1.0, -1.1, -1.0])  # it may have one
    assert decided({"chair": doubtful, "table": on_legs}).name is None


def test_an_object_of_no_usual_size_is_of_no_class():
    """A strip of wall, 0.2 m by 1.35 m, is no chair, however well it is predicted."""
    found = {"chair": CLEAR}
    chair, strip = np.array([0.55, 0.85, 0.6]), np.array([0.55, 1.35, 0.2])
    assert decided(found, chair).name == "chair"
    assert decided(found, strip).name is None
    assert deviation("chair", strip, 1) > UNUSUAL > 10 * deviation("chair", chair, 0)
    # The box's x is along the front of an object that is turned by a quarter.
    assert deviation("chair", strip, 1) == deviation("chair", strip[::-1], 0)


def test_an_object_with_the_size_of_no_class_is_not_scored(priors):
    """And it is as surely of no class as one that was scored and is excluded."""
    chair, table = (measured(one) for one in priors.values())
    sizes = np.array([[0.1, 0.2, 0.1], [1.2, 0.7, 0.8]])
    small, usual = decide(priors, stacked(chair, table), sizes)
    assert small == Decision(None, 0, 1 - EXCLUDED, {}) and set(usual.scores) == set(priors)
