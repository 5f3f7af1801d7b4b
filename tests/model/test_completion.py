"""The conditional network: each object's features stay its own, and codes are normal."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxshape.geometry.grids import Grids
from jaxshape.model import completion, shapes
from jaxshape.model.completion import COMPLETION
from jaxshape.model.config import Completion, TrainConfig
from jaxshape.model.families import COMPLETIONS, Batch, completion_cost
from jaxshape.model.shapes import ShapePrior, decode_prepared
from jaxshape.model.weights import load_prior, save_prior

SMALL = Completion(channels=(4, 6, 8), depth=1, code=5, resolution=16)


@pytest.fixture(scope="module")
def params():
    drawn = completion.initialize(jax.random.key(0), SMALL)
    # The last layers start small; larger ones make every input count.
    return jax.tree.map(lambda x: 2 * x + 0.01, drawn)


@pytest.fixture(scope="module")
def prior(params):
    return ShapePrior(COMPLETION, params, jnp.zeros(SMALL.code), jnp.eye(SMALL.code))


decode, encode = jax.jit(shapes.decode), jax.jit(shapes.encode)


def cost_of(config):
    return jax.jit(partial(completion_cost, config=config, axis=None))


def grids_of(count, seed=0):
    rng = np.random.default_rng(seed)
    M = rng.random((count, 16, 16, 16)) < 0.4
    F = (rng.random(M.shape) < 0.2) & ~M
    return Grids(jnp.asarray(F), jnp.asarray(M))


def test_the_first_code_is_zero_for_every_object(prior):
    np.testing.assert_array_equal(encode(prior, grids_of(3)), np.zeros((3, SMALL.code)))


def test_sizes_are_read_off_the_parameters(params):
    assert completion.architecture_of(params) == SMALL
    found = jax.tree.map(jnp.shape, completion.shapes(params))
    assert found == jax.tree.map(jnp.shape, params)


def test_an_object_decodes_in_company_as_alone(prior):
    grids = grids_of(3)
    codes = jax.random.normal(jax.random.key(1), (3, 4, SMALL.code))
    together = decode(prior, codes, grids)
    assert together.shape == (3, 4, 16, 16, 16)
    for i in range(3):
        alone = decode(prior, codes[i : i + 1], jax.tree.map(lambda x, i=i: x[i : i + 1], grids))
        np.testing.assert_allclose(together[i], alone[0], atol=1e-4)


def test_measurement_and_code_both_count(prior):
    code = jax.random.normal(jax.random.key(1), (2, SMALL.code))
    one, other = grids_of(2), grids_of(2, seed=1)
    base = decode(prior, code, one)
    assert float(jnp.max(jnp.abs(base - decode(prior, code, other)))) > 1e-2
    assert float(jnp.max(jnp.abs(base - decode(prior, -code, one)))) > 1e-2


def test_what_an_occluded_voxel_says_does_not_count(prior):
    grids = grids_of(2)
    code = jnp.zeros((2, SMALL.code))
    lying = grids._replace(occupied=grids.occupied | grids.occluded)
    np.testing.assert_allclose(decode(prior, code, grids), decode(prior, code, lying), atol=1e-5)


def test_without_a_measurement_nothing_is_known(prior):
    nothing = Grids(jnp.zeros((1, 16, 16, 16)), jnp.ones((1, 16, 16, 16)))
    codes = jax.random.normal(jax.random.key(1), (3, SMALL.code))
    np.testing.assert_allclose(
        decode(prior, codes), decode(prior, codes[None], nothing)[0], atol=1e-5
    )


def test_a_mirrored_measurement_gets_the_mirrored_answer(prior):
    grids, code = grids_of(2), jax.random.normal(jax.random.key(1), (2, SMALL.code))
    mirrored = Grids(*(jnp.flip(x, axis=1) for x in grids[:2]))
    expected = jnp.flip(decode(prior, code, grids), axis=1)
    np.testing.assert_allclose(decode(prior, code, mirrored), expected, atol=1e-5)


def test_half_precision_is_close(prior):
    grids, code = grids_of(2), jax.random.normal(jax.random.key(1), (2, SMALL.code))
    half = jax.jit(
        lambda params: decode_prepared(
            COMPLETION, COMPLETION.prepare(params, grids, "bfloat16"), code
        )
    )(prior.params)
    exact = decode(prior, code, grids)
    assert half.dtype == jnp.float32
    assert float(jnp.std(half - exact) / jnp.std(exact)) < 0.05


def test_patches_come_apart_as_they_were_put_together():
    x = jnp.arange(2 * 4 * 4 * 4 * 3.0).reshape(2, 4, 4, 4, 3)
    np.testing.assert_array_equal(completion._spread(completion._gathered(x)), x)


def test_weights_on_disk_are_the_same_network(prior, tmp_path):
    save_prior(tmp_path / "w.safetensors", prior, {})
    again = load_prior(tmp_path / "w.safetensors")
    assert again.model == COMPLETION and again.resolution == 16
    grids, code = grids_of(1), jnp.ones((1, SMALL.code))
    np.testing.assert_allclose(
        decode(again, code, grids), decode(prior, code, grids), rtol=0.05, atol=0.05
    )


def test_the_cost_is_the_evidence_bound():
    """Cross-entropy of the first codes and of posterior ones, and the latter's divergence."""
    variables = COMPLETIONS.initialize(jax.random.key(0), SMALL)
    config = TrainConfig(SMALL, occupied_weight=1.0, occluded_weight=1.0, code_weight=1.0)
    grids = grids_of(4)
    surface = jnp.asarray(np.random.default_rng(2).random((4, 16, 16, 16)) < 0.2)
    batch = Batch(*(x.astype(jnp.float32) for x in grids[:2]), surface)
    noise = jax.random.normal(jax.random.key(3), (4, SMALL.code))
    cost = cost_of(config)(variables, batch, noise)

    params = variables["params"]
    mean, log_variance = jax.jit(completion.posterior)(params, batch.grids, surface)
    code = jnp.where((jnp.arange(4) % 2)[:, None] == 1, mean + jnp.exp(log_variance / 2) * noise, 0)
    found = jax.jit(completion.skips)(params, batch.grids)
    logits = jax.jit(completion.decode_skips)(params, found, code)
    p = np.asarray(jax.nn.sigmoid(logits), np.float64)
    entropy = -np.log(np.where(surface, p, 1 - p)).mean()
    # Of normal distributions, by sampling.
    draws = np.random.default_rng(0).normal(size=(20_000, 4, SMALL.code))
    deviation = np.exp(np.asarray(log_variance) / 2)
    x = np.asarray(mean) + deviation * draws
    log_ratio = (0.5 * x**2 - 0.5 * draws**2 - np.log(deviation)).sum(-1).mean(0)
    expected = entropy + log_ratio[1::2].sum() / surface.size
    np.testing.assert_allclose(cost.loss, expected, rtol=1e-3)


@pytest.mark.parametrize("share, searched", [(0.0, 0), (0.25, 1), (0.5, 2), (1.0, 4)])
def test_a_share_of_the_batch_decodes_posterior_codes(share, searched):
    """Only they depend on the noise."""
    variables = COMPLETIONS.initialize(jax.random.key(0), SMALL)
    grids = grids_of(4)
    batch = Batch(*(x.astype(jnp.float32) for x in grids[:2]), grids.occupied)
    config = TrainConfig(SMALL, posterior_share=share)

    def loss_by_example(noise):
        return completion_cost(variables, batch, noise, config, None).loss

    slope = jax.jit(jax.grad(loss_by_example))(jnp.ones((4, SMALL.code)))
    assert int((jnp.abs(slope).max(axis=1) > 0).sum()) == searched


def test_weights_of_voxels_count():
    variables = COMPLETIONS.initialize(jax.random.key(0), SMALL)
    grids = grids_of(2)
    batch = Batch(*(x.astype(jnp.float32) for x in grids[:2]), grids.occupied)
    noise = jnp.zeros((2, SMALL.code))
    plain = TrainConfig(SMALL, occupied_weight=1.0, occluded_weight=1.0, code_weight=0.0)
    heavy = TrainConfig(SMALL, occupied_weight=1.0, occluded_weight=3.0, code_weight=0.0)
    hidden = batch._replace(occluded=jnp.ones_like(batch.occluded))
    once, thrice = (cost_of(config)(variables, hidden, noise).loss for config in (plain, heavy))
    np.testing.assert_allclose(3 * once, thrice, rtol=1e-5)
