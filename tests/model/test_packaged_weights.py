"""The weights that come with the package: they load for ever, and they do their job."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxshape.data.capture import camera_distance, capture, measure_frames
from jaxshape.data.chairs import random_chair
from jaxshape.data.dataset import TEST_SEEDS
from jaxshape.geometry import camera, fusion
from jaxshape.geometry.grids import Grids
from jaxshape.geometry.overlap import iou
from jaxshape.model.autoencoder import architecture_of
from jaxshape.model.config import Architecture
from jaxshape.model.shapes import decode, encode
from jaxshape.model.weights import load_card, load_prior
from jaxshape.search.config import RefineConfig
from jaxshape.search.reconstruction import reconstruct, refiner_for

FRAMES = 6
CHAIRS = 4


@pytest.fixture(scope="module")
def prior():
    return load_prior("chair-autoencoder")


@pytest.fixture(scope="module")
def observed():
    """F, M and Y of a few chairs nobody trained on, after an orbit."""
    grids = []
    for seed in range(TEST_SEEDS, TEST_SEEDS + CHAIRS):
        mesh = random_chair(seed)
        views = camera.orbit(FRAMES, camera_distance(mesh))
        seen = capture(mesh, views, noise=False, seed=seed)
        merged = fusion.merge_all(measure_frames(seen))
        grids.append((fusion.occupied(merged), fusion.occluded(merged), seen.surface))
    return [jnp.stack(x) for x in zip(*grids, strict=True)]


def test_they_have_the_default_architecture_and_a_card(prior):
    assert architecture_of(prior.params) == Architecture()
    assert load_card("chair-autoencoder")["licence"] == "Apache-2.0"


def test_codes_of_chairs_lie_where_the_stored_statistics_say(prior, observed):
    codes = encode(prior, Grids(*observed[:2])) - prior.code_mean
    whitened = np.linalg.solve(np.linalg.cholesky(prior.code_covariance), np.asarray(codes).T)
    assert 0.3 < np.sqrt(np.mean(whitened**2)) < 3


@pytest.fixture(scope="module")
def rebuilt(prior, observed):
    config = RefineConfig(iterations=30)
    run = partial(reconstruct, refiner=refiner_for("cma", prior, config), config=config)
    return jax.jit(run)(jax.random.split(jax.random.key(0), CHAIRS), prior, *observed[:2])


def test_the_search_brings_shapes_nearer_to_the_truth(observed, rebuilt):
    first, refined, composed = (
        float(jnp.mean(iou(grids, observed[2])))
        for grids in (rebuilt.completed_first, rebuilt.completed, rebuilt.composed)
    )
    assert first > 0.45
    assert refined > first
    assert composed > first
    assert np.all(np.asarray(rebuilt.objective) < np.asarray(rebuilt.first_objective))


def test_they_decode_to_stored_values(prior):
    """A change of format, layout or arithmetic would show here."""
    logits = decode(prior, prior.code_mean)
    expected = [-5.9285, -5.9050, -5.7864, -4.7429, -5.2473, -4.4433, -4.8925, -4.4301]
    np.testing.assert_allclose(logits[::8, 3::8, 5::8].ravel()[:8], expected, rtol=1e-3, atol=1e-3)
