"""Principal components against NumPy's, and what the first code promises."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxshape.geometry.grids import Grids
from jaxshape.geometry.overlap import iou
from jaxshape.model import shapes
from jaxshape.model.pca import fit
from jaxshape.model.weights import load_prior, save_prior
from jaxshape.search.config import RefineConfig
from jaxshape.search.reconstruction import reconstruct_jit, refiner_for

N, COUNT = 8, 120
decode, encode = jax.jit(shapes.decode), jax.jit(shapes.encode)


def boxes(count, seed):
    """Shells of boxes of random sizes: six numbers each, so that a few components hold most."""
    rng = np.random.default_rng(seed)
    grid = np.zeros((count, N, N, N), bool)
    for one in grid:
        low, high = rng.integers(0, 3, 3), rng.integers(5, N + 1, 3)
        one[tuple(map(slice, low, high))] = True
        one[tuple(map(slice, low + 1, high - 1))] = False
    return grid


@pytest.fixture(scope="module")
def prior():
    return fit(boxes(COUNT, 0), 12)


def test_the_components_are_numpys(prior):
    """Singular value decomposition of all rows in float64."""
    rows = boxes(COUNT, 0).reshape(COUNT, -1).astype(float)
    centred = rows - rows.mean(axis=0)
    _, singular, components = np.linalg.svd(centred, full_matrices=False)
    variances = singular**2 / COUNT
    np.testing.assert_allclose(prior.params["variances"], variances[:12], rtol=2e-3)
    ours = np.asarray(prior.params["components"]).reshape(12, -1)
    np.testing.assert_allclose(ours @ ours.T, np.eye(12), atol=1e-5)
    captured = np.sum((ours @ components[:12].T) ** 2)
    assert captured > 12 - 0.05  # the same subspace
    np.testing.assert_allclose(
        prior.params["noise"], variances[12:].sum() / rows.shape[1], rtol=1e-2
    )


def test_a_complete_surface_is_projected(prior):
    """With all voxels known the first code is that of the projection, shrunk a little."""
    whole = jnp.asarray(boxes(5, 1))
    codes = encode(prior, Grids(whole, jnp.zeros_like(whole)))
    components = np.asarray(prior.params["components"]).reshape(12, -1)
    projected = (whole.reshape(5, -1) - prior.params["mean"].ravel()) @ components.T
    shrink = prior.params["variances"] / (prior.params["variances"] + prior.params["noise"])
    np.testing.assert_allclose(codes, projected * shrink, rtol=1e-3, atol=1e-3)


def test_nothing_measured_is_the_mean(prior):
    nothing = jnp.zeros((1, N, N, N), bool)
    np.testing.assert_allclose(encode(prior, Grids(nothing, ~nothing)), 0, atol=1e-6)


def test_hidden_voxels_are_filled_by_what_was_seen(prior):
    """Half of each box is hidden; the first code knows it better than the mean does."""
    truth = jnp.asarray(boxes(20, 2))
    hidden = jnp.zeros_like(truth).at[:, N // 2 :].set(True)
    logits = decode(prior, encode(prior, Grids(truth & ~hidden, hidden)))
    mean = decode(prior, jnp.zeros((20, 12)))
    half = slice(N // 2, None)
    found, before = (iou(x[:, half] > 0, truth[:, half]).mean() for x in (logits, mean))
    assert found > before + 0.1


def test_from_training_to_a_refined_shape(prior, tmp_path):
    save_prior(tmp_path / "pca.safetensors", prior, {})
    loaded = load_prior(tmp_path / "pca.safetensors")
    truth = jnp.asarray(boxes(4, 3))
    hidden = jnp.zeros_like(truth).at[:, N // 2 :].set(True)
    config = RefineConfig(iterations=30)
    run = reconstruct_jit(refiner_for("gradient:adam", loaded, config), config)
    found = run(jax.random.key(0), loaded, truth & ~hidden, hidden)
    assert np.all(found.objective < found.first_objective)
    assert iou(found.completed, truth).mean() > 0.5


def test_too_few_grids_are_refused():
    with pytest.raises(ValueError, match="12 training grids for 12 components"):
        fit(boxes(12, 0), 12)
