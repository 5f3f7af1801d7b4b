from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxshape.geometry.grids import Grids
from jaxshape.model import shapes
from jaxshape.model.autoencoder import (
    AUTOENCODER,
    AutoEncoder,
    architecture_of,
    initialize,
)
from jaxshape.model.config import Architecture
from jaxshape.model.shapes import ShapePrior
from jaxshape.model.weights import flatten

TINY = Architecture((4, 4, 8, 8), (8, 8, 4), 10)
BATCHES = [(), (1,), (2, 3)]


def prior_of(params):
    d = params["params"]["decoder"]["conv0"].shape[-1]
    return ShapePrior(AUTOENCODER, params, jnp.zeros(d), jnp.eye(d))


def encode(params, grid):
    nothing = jnp.zeros(grid.shape, bool)
    return shapes.encode(prior_of(params), Grids(grid, nothing))


def decode(params, code):
    return shapes.decode(prior_of(params), code)


@pytest.fixture(scope="module")
def params():
    return jax.jit(initialize, static_argnums=1)(jax.random.key(0), TINY)


@pytest.fixture(scope="module")
def grids():
    """Three grids."""
    return jnp.asarray(np.random.default_rng(0).random((1, 3, 32, 32, 32)) < 0.2)


@pytest.fixture(scope="module")
def codes():
    return jax.random.normal(jax.random.key(1), (1, 3, 10))


@pytest.fixture(scope="module")
def logits(params, codes):
    return jax.jit(decode)(params, codes)


@pytest.fixture(scope="module")
def trained(params, grids):
    """Gradient by the parameters, and updated collections, of one pass in training."""

    @jax.jit
    def gradient(params, grids):
        def total(weights):
            variables = {**params, "params": weights}
            (logits, _), updates = AutoEncoder(TINY).apply(
                variables, grids[..., None], train=True, mutable=["batch_stats"]
            )
            return jnp.mean(jnp.sin(50 * logits + 1)), updates

        return jax.grad(total, has_aux=True)(params["params"])

    return gradient(params, grids[0])


@pytest.mark.parametrize("batch", BATCHES)
def test_codes_and_grids_keep_their_leading_axes(params, batch):
    grid = jax.ShapeDtypeStruct((*batch, 32, 32, 32), bool)
    code = jax.eval_shape(encode, params, grid)
    assert code.shape == (*batch, TINY.code) and code.dtype == jnp.float32
    logits = jax.eval_shape(decode, params, code)
    assert logits.shape == grid.shape and logits.dtype == jnp.float32


def test_decoding_many_codes_equals_decoding_each(params, codes, logits):
    one = jax.jit(decode)
    for i in range(3):
        np.testing.assert_allclose(logits[0, i], one(params, codes[0, i]), atol=1e-6)
    assert np.ptp(logits, axis=1).max() > 1e-4  # the codes differ in what they give


def test_encoding_many_grids_equals_encoding_each(params, grids):
    many, one = jax.jit(encode)(params, grids), jax.jit(encode)
    for i in range(3):
        np.testing.assert_allclose(many[0, i], one(params, grids[0, i]), atol=1e-6)
    assert np.ptp(many, axis=1).max() > 1e-6


def test_the_probability_is_that_of_the_papers_tanh(params, codes, logits):
    """With the bias moved, the pre-activation moves with it, and the output is (tanh + 1) / 2."""
    weights = params["params"]
    moved = {**weights, "decoder": {**weights["decoder"], "bias": jnp.float32(0.3)}}
    with_bias = jax.jit(decode)({**params, "params": moved}, codes)
    np.testing.assert_allclose(
        jax.nn.sigmoid(with_bias), (np.tanh(logits / 2 + 0.3) + 1) / 2, atol=1e-6
    )


def test_the_first_decoder_layer_is_a_transposed_convolution_of_one_voxel(params, codes):
    """Stride 2, padding 1 and output padding 1, as PyTorch defines them: output 2 i - 1 + k."""
    apply = jax.jit(partial(AutoEncoder(TINY).apply, method="decode", mutable=["intermediates"],
                            capture_intermediates=True))  # fmt: skip
    normalized = apply(params, codes[0])[1]["intermediates"]["decoder"]["norm0"]["__call__"][0]
    norm = params["params"]["decoder"]["norm0"]
    layer = (normalized - norm["bias"]) / norm["scale"] * np.sqrt(1 + 1e-5)

    kernel = np.asarray(params["params"]["decoder"]["conv0"])
    expected = np.zeros((3, 4, 4, 4, TINY.decoder[0]))
    for k in np.ndindex(5, 5, 5):
        out = np.array(k) - 1
        if (out >= 0).all() and (out < 4).all():
            expected[:, *out] = np.asarray(codes[0]) @ kernel[k].T
    np.testing.assert_allclose(layer, expected, atol=1e-5)


def test_every_parameter_is_used_but_the_taps_that_one_voxel_cannot_reach(trained):
    gradient = flatten(trained[0])
    for name, x in gradient.items():
        assert np.isfinite(x).all() and np.any(x), name
    first = np.asarray(gradient["decoder/conv0"])
    assert first[1:, 1:, 1:].any(axis=(-1, -2)).all()
    assert not first[0].any() and not first[:, 0].any() and not first[:, :, 0].any()
    for name in ("encoder/conv0", "encoder/conv3", "decoder/conv1", "decoder/conv3"):
        assert np.any(gradient[name], axis=(-1, -2)).all(), name


def test_training_moves_the_batch_statistics_and_evaluation_does_not(params, trained, grids):
    moved = flatten(trained[1]["batch_stats"])
    for name, before in flatten(params["batch_stats"]).items():
        assert np.all(moved[name] != before), name
    evaluate = partial(AutoEncoder(TINY).apply, train=False, mutable=["batch_stats"])
    same = jax.jit(lambda params, grid: evaluate(params, grid)[1])(params, grids[0, :1, ..., None])
    jax.tree.map(np.testing.assert_array_equal, same["batch_stats"], params["batch_stats"])


def test_noise_is_added_to_the_code_and_reaches_the_grid_alone(params, grids, codes):
    run = jax.jit(partial(AutoEncoder(TINY).apply, train=False))
    logits, code = run(params, grids[0][..., None], noise=codes[0])
    np.testing.assert_allclose(code[None], jax.jit(encode)(params, grids), atol=1e-6)
    noisy = jax.jit(decode)(params, code[None] + codes)
    np.testing.assert_allclose(logits[None], noisy, atol=1e-5)


def test_only_an_encoder_that_is_given_the_occlusion_mask_heeds_it(params):
    """And it takes both grids as soft as they are, where the paper's rounds F."""
    F, M = np.random.default_rng(2).uniform(0, 0.5, (2, 1, 32, 32, 32)).astype(np.float32)
    both = initialize(jax.random.key(0), replace(TINY, occlusion=True))
    assert architecture_of(both) == replace(TINY, occlusion=True)
    code = jax.jit(AUTOENCODER.encode)
    for weights, heeds in ((params, False), (both, True)):
        first = code(weights, Grids(F + 0.5, M))
        for other in (Grids(F + 0.5, M / 2), Grids(F / 2 + 0.5, M)):
            assert np.any(code(weights, other) != first) == heeds


def test_sizes_are_read_off_the_parameters(params):
    assert architecture_of(params) == TINY
    default = jax.eval_shape(partial(initialize, jax.random.key(0)))
    assert architecture_of(default) == Architecture()


def test_weights_start_as_the_paper_says(params):
    named = {name: np.asarray(x) for name, x in flatten(params["params"]).items()}
    kernels = {n: x for n, x in named.items() if "conv" in n or n.endswith("kernel")}
    assert len(kernels) == 9
    for name, x in kernels.items():
        error = 0.02 / np.sqrt(x.size)
        assert abs(x.mean()) < 4 * error, name
        assert abs(x.std() - 0.02) < 4 * error, name
    scales = np.concatenate([x for n, x in named.items() if n.endswith("scale")])
    assert abs(scales.mean() - 1) < 4 * 0.02 / np.sqrt(scales.size)
    assert 0.01 < scales.std() < 0.03
    assert not any(x.any() for n, x in named.items() if n.endswith("bias"))


@pytest.mark.parametrize("layers, resolution", [(3, 16), (4, 32), (5, 64)])
def test_the_number_of_layers_decides_the_resolution(layers, resolution):
    architecture = Architecture((4,) * layers, (4,) * (layers - 1), 6)
    assert architecture.resolution == resolution
    params = jax.eval_shape(partial(initialize, architecture=architecture), jax.random.key(0))
    assert architecture_of(params) == architecture
    grid = jax.ShapeDtypeStruct((2, *[resolution] * 3), bool)
    code = jax.eval_shape(encode, params, grid)
    assert code.shape == (2, 6)
    assert jax.eval_shape(decode, params, code).shape == grid.shape
    for other in (resolution // 2, 2 * resolution):
        with pytest.raises(ValueError, match=f"knows shapes of {resolution} x {resolution}"):
            jax.eval_shape(encode, params, jax.ShapeDtypeStruct((2, *[other] * 3), bool))


@pytest.mark.parametrize(
    "sizes, said",
    [
        (((8, 8), (8, 8)), "The encoder has 2 layers and the decoder 2 numbers"),
        (((8,), ()), r"decoder is \(\); give numbers of channels"),
        (((8, 8, 0), (8, 8)), r"encoder is \(8, 8, 0\); give numbers of channels"),
    ],
)
def test_layers_that_do_not_match_are_refused(sizes, said):
    with pytest.raises(ValueError, match=said):
        Architecture(*sizes)
