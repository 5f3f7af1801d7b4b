import jax
import jax.numpy as jnp
import numpy as np

from jaxshape.geometry.evidence import Evidence
from jaxshape.geometry.symmetry import AGREEMENT, NATS, mirror, mirrored, symmetrised

find = jax.jit(mirrored)


def half_seen(*, asymmetric=False):
    """A box whose left half was measured, with one leg on the right that is measured as well."""
    surface, free = np.zeros((2, 32, 32, 32), np.float32)
    surface[4:16, 10, 8:24] = 1  # the left half of a seat
    surface[6, 2:10, 8] = 1  # a leg on the left
    free[:16] = 1 - surface[:16]
    right = 20 if asymmetric else 25
    surface[right, 2:10, 8] = 1
    free[16:, 2:10, 8] = 1 - surface[16:, 2:10, 8]
    return Evidence(jnp.asarray(surface), jnp.asarray(free))


def test_unknown_voxels_learn_from_their_seen_mirror_images():
    found = find(half_seen())
    assert bool(found.symmetric) and float(found.agreement) == 1
    logits = np.asarray(found.logits)
    np.testing.assert_allclose(logits[16:28, 10, 8:24], NATS)
    assert logits[20, 20, 20] == -NATS
    np.testing.assert_array_equal(logits[:16], 0)  # seen themselves


def test_an_object_whose_sides_disagree_is_left_as_it_is():
    found = find(half_seen(asymmetric=True))
    assert not bool(found.symmetric) and float(found.agreement) < AGREEMENT
    np.testing.assert_array_equal(found.logits, 0)
    logits = jax.random.normal(jax.random.key(0), (32, 32, 32))
    np.testing.assert_array_equal(symmetrised(logits, found), logits)


def test_a_surface_one_voxel_off_still_agrees():
    evidence = half_seen()
    shifted = Evidence(
        evidence.surface.at[25].set(0).at[26, 2:10, 8].set(1),
        evidence.free.at[26, 2:10, 8].set(0),
    )
    assert float(find(shifted).agreement) == 1


def test_where_nothing_was_seen_twice_symmetry_is_taken_for_granted():
    nothing = Evidence(*jnp.zeros((2, 32, 32, 32)))
    found = find(nothing)
    assert float(found.agreement) == 1 and bool(found.symmetric)
    np.testing.assert_array_equal(found.logits, 0)


def test_symmetrised_logits_are_the_mean_with_their_mirror_image():
    found = find(Evidence(*jnp.zeros((2, 32, 32, 32))))
    logits = jax.random.normal(jax.random.key(0), (32, 32, 32))
    mean = symmetrised(logits, found)
    np.testing.assert_allclose(mean, mirror(mean), atol=1e-6)
    np.testing.assert_allclose(mean[3], (logits[3] + logits[28]) / 2, atol=1e-6)
