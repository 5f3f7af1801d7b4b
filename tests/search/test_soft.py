import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxshape.geometry.evidence import Evidence
from jaxshape.search.objective import BALANCED, target
from jaxshape.search.soft import LEAST_ALPHA, soft_compose, soft_target


def grids(hidden):
    """F, M and the same as evidence, with a share of the voxels hidden."""
    rng = np.random.default_rng(0)
    M = rng.random((32, 32, 32)) < hidden
    F = (rng.random(M.shape) < 0.1) & ~M
    found = Evidence(jnp.asarray(F, jnp.float32), jnp.asarray(~F & ~M, jnp.float32))
    return jnp.asarray(F), jnp.asarray(M), found


LOGITS = jax.random.normal(jax.random.key(0), (32, 32, 32))


def test_certain_evidence_gives_the_target_of_f_and_m():
    F, M, found = grids(0.6)
    for x, y in zip(soft_target(found, LOGITS), target(F, M, LOGITS), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-5, atol=1e-6)


def test_the_prior_keeps_its_weight_where_little_is_hidden():
    _, M, found = grids(0.1)
    occupied, empty = soft_target(found, LOGITS)
    np.testing.assert_allclose((occupied + empty)[M], LEAST_ALPHA, rtol=1e-5)


def test_half_certain_evidence_weighs_half():
    half = Evidence(jnp.full((32, 32, 32), 0.3), jnp.full((32, 32, 32), 0.2))
    occupied, empty = soft_target(half, LOGITS, BALANCED._replace(prior=0.0))
    np.testing.assert_allclose(occupied, 0.3)
    np.testing.assert_allclose(empty, 0.2 * BALANCED.free, rtol=1e-6)


@pytest.mark.parametrize("logit", [-20.0, 20.0])
def test_composing_keeps_what_is_certain_and_decodes_the_rest(logit):
    F, M, found = grids(0.5)
    composed = soft_compose(found, jnp.full((32, 32, 32), logit)) > 0.5
    np.testing.assert_array_equal(composed, F | (M & (logit > 0)))
