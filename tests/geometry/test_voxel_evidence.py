import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxshape.geometry import distance, evidence
from jaxshape.geometry.distance import DistanceField
from jaxshape.geometry.evidence import Evidence
from jaxshape.geometry.grids import Grids, binary

N = 128
find = jax.jit(evidence.evidence)


def occupied(found):
    return binary(evidence.as_grids(found)).occupied


def wall(at, *, weight=0.5, free=0.0):
    """A field whose surface is the plane x = `at`, in fine voxels, known 3 voxels to each side."""
    x = jnp.arange(N) + 0.5
    d = jnp.broadcast_to((x - at)[:, None, None] / N, (N,) * 3)
    near = jnp.abs(d) < 3 / N
    w = jnp.where(near, weight, 0.0)
    return DistanceField(w * d, w, jnp.where(d > 2 / N, 1.0, free) * jnp.ones_like(d))


def test_nothing_measured_is_unknown():
    found = find(distance.nothing_measured(N))
    assert (found.surface == 0).all() and (found.free == 0).all()
    F, M, _ = binary(evidence.as_grids(found))
    assert M.all() and not F.any()


def test_a_wall_is_surface_where_it_stands_free_before_it_and_unknown_behind():
    found = find(wall(66.2))
    F, M, _ = binary(evidence.as_grids(found))
    np.testing.assert_array_equal(F[16, 1:-1, 1:-1], True)  # fine voxels 64 to 67
    np.testing.assert_array_equal(np.asarray(F).any(axis=(1, 2)).sum(), 1)
    assert not M[17:].any() and (found.free[18:] == 1).all()
    assert M[:15].all()


@pytest.mark.parametrize("at", [3.6, 124.4])
def test_a_face_of_the_box_stays_inside_it(at):
    """Noise has taken it into the outermost voxels, which the box leaves free."""
    F = np.asarray(occupied(find(wall(at))))
    assert not F[[0, -1]].any() and F[1 if at < 64 else -2, 1:-1, 1:-1].all()


def test_probabilities_add_up_to_one_at_most():
    rng = np.random.default_rng(0)
    field = DistanceField(
        *(jnp.asarray(rng.normal(0, 1, (N,) * 3), jnp.float32) for _ in range(1)),
        *(jnp.asarray(rng.exponential(1, (N,) * 3), jnp.float32) for _ in range(2)),
    )
    found = find(field)
    for x in found:
        assert (x >= 0).all() and (x <= 1).all()
    assert (found.surface + found.free <= 1 + 1e-6).all()


def test_rays_that_passed_through_outvote_a_surface_of_little_weight():
    outvoted = find(wall(66.2, weight=0.02, free=3.0))
    kept = find(wall(66.2, weight=0.5, free=3.0))
    assert not occupied(outvoted).any() and (outvoted.free > 0.9).all()
    assert occupied(kept).any()


def test_crossings_are_the_voxels_that_hold_the_surface():
    for at in (40.3, 40.7, 63.99, 64.01):
        crossed = np.asarray(evidence.crossings(wall(at))).any(axis=(1, 2))
        np.testing.assert_array_equal(np.flatnonzero(crossed), int(at))


def test_more_of_the_surface_is_more_certain():
    crossed = []
    for share in (1, 2, 4):
        field = wall(66.2)
        some = (jnp.arange(N) % 4 < share)[:, None] & (jnp.arange(N) % 4 == 0)
        crossed.append(float(find(field._replace(weight=field.weight * some)).surface[16, 8, 8]))
    assert 0.4 < crossed[0] < crossed[1] < crossed[2] < 1


def test_evidence_broadcasts_over_objects():
    both = jax.tree.map(lambda *x: jnp.stack(x), wall(66.2), wall(30.0))
    found = find(both)
    for x, y in zip(found, find(wall(30.0)), strict=True):
        np.testing.assert_array_equal(x[1], y)


def test_thresholds_split_all_voxels():
    found = Evidence(jnp.linspace(0, 1, 32**3).reshape(32, 32, 32), jnp.zeros((32, 32, 32)))
    F, M, _ = binary(evidence.as_grids(found))
    np.testing.assert_array_equal(F ^ M, True)


def test_grids_and_evidence_say_the_same():
    """There and back, soft and binary; F is not defined where nothing is known."""
    F, M = jax.random.uniform(jax.random.key(0), (2, 3, 4, 5))
    again = evidence.as_grids(evidence.from_grids(Grids(F, M)))
    np.testing.assert_allclose(again.occupied, F, atol=1e-5)
    np.testing.assert_allclose(again.occluded, M, atol=1e-6)
    hard = Grids((F > 0.5) & (M < 0.5), M > 0.5)
    found = evidence.from_grids(hard)
    np.testing.assert_array_equal(found.surface, hard.occupied)
    np.testing.assert_array_equal(found.free, ~hard.occupied & ~hard.occluded)
