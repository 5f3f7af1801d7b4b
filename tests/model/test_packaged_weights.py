"""The weights that come with the package: they load for ever, and they do their job."""

from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxshape.data.capture import camera_distance, capture, measure_frames
from jaxshape.data.chairs import random_chair
from jaxshape.data.families import TEST_SEEDS
from jaxshape.geometry import camera, fusion
from jaxshape.geometry.grids import Grids
from jaxshape.geometry.overlap import iou
from jaxshape.model.autoencoder import architecture_of
from jaxshape.model.completion import COMPLETION
from jaxshape.model.config import Architecture
from jaxshape.model.shapes import decode, encode
from jaxshape.model.weights import PACKAGED, fingerprint, load_card, load_prior
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


@pytest.mark.parametrize("name", PACKAGED)
def test_their_names_are_paths_too(name):
    """The command line gives every name as a path."""
    assert fingerprint(load_prior(Path(name))) == fingerprint(load_prior(name))


def test_codes_of_chairs_lie_where_the_stored_statistics_say(prior, observed):
    codes = jax.jit(encode)(prior, Grids(*observed[:2])) - prior.code_mean
    whitened = np.linalg.solve(np.linalg.cholesky(prior.code_covariance), np.asarray(codes).T)
    assert 0.3 < np.sqrt(np.mean(whitened**2)) < 3


@pytest.fixture(scope="module")
def rebuilt(prior, observed):
    config = RefineConfig(iterations=30)
    run = partial(reconstruct, refiner=refiner_for("gradient:adam", prior, config), config=config)
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


# ------------------------------------------------------------------ the conditional network


@pytest.fixture(scope="module")
def chair():
    return load_prior()


def test_the_default_is_the_network_that_knows_the_measurement(chair):
    assert chair.model == COMPLETION and chair.resolution == 32
    assert load_card()["licence"] == "Apache-2.0"
    np.testing.assert_array_equal(chair.code_mean, np.zeros(chair.code_size))
    np.testing.assert_array_equal(chair.code_covariance, np.eye(chair.code_size))


@pytest.fixture(scope="module")
def completed(chair, observed):
    config = RefineConfig()
    return jax.jit(partial(reconstruct, refiner=None, config=config))(
        jax.random.key(0), chair, *observed[:2]
    )


def test_it_fills_what_is_hidden_better_than_the_auto_encoder(observed, rebuilt, completed):
    F, M, surface = observed

    def hidden(shapes):
        return float(jnp.mean(iou(shapes & M, surface & M)))

    assert hidden(completed.fill_logits > 0) > 0.5
    assert hidden(completed.fill_logits > 0) > hidden(rebuilt.fill_logits > 0) + 0.05
    composed, measured = (float(jnp.mean(iou(x, surface))) for x in (completed.composed, F))
    assert composed > 0.7 and composed > measured + 0.05
    assert composed > float(jnp.mean(iou(rebuilt.composed, surface)))


def test_its_codes_move_what_is_hidden_and_little_else(chair, observed):
    F, M, _ = observed
    grids = Grids(F[:1], M[:1])
    codes = jax.random.normal(jax.random.key(0), (1, 8, chair.code_size))
    shapes = np.asarray(jax.nn.sigmoid(jax.jit(decode)(chair, codes, grids)))[0]
    spread = shapes.std(axis=0)
    hidden = np.asarray(M[0])
    assert spread[hidden].mean() > 2 * spread[~hidden].mean()
    assert spread[hidden].max() > 0.1


# ------------------------------------------------------------------ stored values


def test_they_decode_to_stored_values(prior):
    """A change of format, layout or arithmetic would show here."""
    logits = jax.jit(decode)(prior, prior.code_mean)
    expected = [-5.9285, -5.9050, -5.7864, -4.7429, -5.2473, -4.4433, -4.8925, -4.4301]
    np.testing.assert_allclose(logits[::8, 3::8, 5::8].ravel()[:8], expected, rtol=1e-3, atol=1e-3)
