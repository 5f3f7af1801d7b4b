import json
import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from jaxshape.model import weights
from jaxshape.model.autoencoder import AUTOENCODER, initialize
from jaxshape.model.calibration import Calibration
from jaxshape.model.config import Architecture
from jaxshape.model.shapes import ShapeModel, ShapePrior
from jaxshape.model.weights import (
    FORMAT,
    WeightsError,
    fingerprint,
    load_card,
    load_prior,
    save_prior,
)

TINY = Architecture((4, 4, 8, 8), (8, 8, 4), 10)
CARD = {"data": "chairs from seeds 0 to 9", "steps": 3, "iou": 0.5}
KERNEL = "params/decoder/conv1"


def random_prior(seed=0):
    """Weights of any value; only their names and shapes are those of a network."""
    rng = np.random.default_rng(seed)
    template = jax.eval_shape(lambda: initialize(jax.random.key(0), TINY))
    params = jax.tree.map(lambda x: jnp.float32(rng.normal(0, 0.02, x.shape)), template)
    root = rng.normal(size=(10, 10))
    return ShapePrior(
        AUTOENCODER, params, jnp.float32(rng.normal(size=10)), jnp.float32(root @ root.T)
    )


@pytest.fixture(scope="module")
def prior():
    return random_prior()


@pytest.fixture(scope="module")
def saved(prior, tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "prior.safetensors"
    save_prior(path, prior, CARD)
    return path


@pytest.fixture
def rewritten(saved, tmp_path):
    """Write the file anew with other tensors or another format."""

    def rewrite(change, format=FORMAT):
        tensors = load_file(saved)
        change(tensors)
        path = tmp_path / "changed.safetensors"
        save_file(tensors, path, {"format": format, "card": json.dumps(CARD)})
        return path

    return rewrite


def test_a_prior_comes_back_in_half_precision(prior, saved):
    loaded = load_prior(saved)
    assert jax.tree.structure(loaded) == jax.tree.structure(prior)
    for found, expected in zip(
        jax.tree.leaves(loaded.params), jax.tree.leaves(prior.params), strict=True
    ):
        assert found.dtype == jnp.float32
        np.testing.assert_array_equal(found, np.float32(np.float16(expected)))
    np.testing.assert_array_equal(loaded.code_mean, prior.code_mean)
    np.testing.assert_array_equal(loaded.code_covariance, prior.code_covariance)


def test_the_card_comes_back(saved):
    assert load_card(saved) == CARD


def test_names_of_arrays_and_nested_dictionaries_are_inverse(prior):
    assert KERNEL in weights.flatten(prior.params)
    again = weights.unflatten(weights.flatten(prior.params))
    assert jax.tree.structure(again) == jax.tree.structure(prior.params)
    jax.tree.map(np.testing.assert_array_equal, again, prior.params)


@pytest.mark.parametrize("load", [load_prior, load_card])
def test_a_missing_file_is_named(load, tmp_path):
    with pytest.raises(
        WeightsError,
        match=r"no weights file .*nowhere\.safetensors.*jaxshape train.*chair-autoencoder",
    ):
        load(tmp_path / "nowhere.safetensors")


@pytest.mark.parametrize("load", [load_prior, load_card])
@pytest.mark.parametrize("path", [5, "", b"chair"])
def test_a_path_that_is_none_is_refused(unchecked_types, load, path):
    with pytest.raises(ValueError, match=f"path is {path!r}; give a weights file, or one of"):
        load(path)


def test_a_model_that_is_none_is_refused(unchecked_types, saved):
    with pytest.raises(ValueError, match="model is of type str; give a ShapeModel"):
        load_prior(saved, "x")


@pytest.mark.parametrize("kept", [0, 7, 200, -1])
def test_a_truncated_file_is_named(kept, saved, tmp_path):
    path = tmp_path / "half.safetensors"
    path.write_bytes(saved.read_bytes()[:kept])
    with pytest.raises(
        WeightsError, match=r"half\.safetensors.* is not a readable safetensors file"
    ):
        load_prior(path)


@pytest.mark.parametrize("load", [load_prior, load_card])
def test_a_foreign_file_is_named_with_its_format(load, rewritten, tmp_path):
    with pytest.raises(WeightsError, match=f"format 'other-2', not '{FORMAT}'"):
        load(rewritten(lambda tensors: None, format="other-2"))
    save_file({"x": np.zeros(3)}, tmp_path / "bare.safetensors")
    with pytest.raises(WeightsError, match=r"bare\.safetensors.* is of format None"):
        load(tmp_path / "bare.safetensors")


@pytest.mark.parametrize(
    "name, shape, sentence",
    [
        (KERNEL, (5, 5, 5, 8, 7), rf"{KERNEL} is \(5, 5, 5, 8, 7\), expected \(5, 5, 5, 8, 8\)"),
        ("params/encoder/conv0", (3, 3, 3, 1, 4), r"encoder/conv0 is \(3, 3, 3, 1, 4\), expected"),
        ("params/decoder/conv0", (), "another architecture"),
        ("params/stranger", (2,), r"params/stranger is \(2,\), expected no such array"),
        ("code_mean", (9,), r"covariance of shape \(10, 10\) for a mean code of shape \(9,\)"),
        ("code_covariance", (10,), r"covariance of shape \(10,\)"),
    ],
)
def test_an_array_of_another_shape_is_named(name, shape, sentence, rewritten):
    path = rewritten(lambda tensors: tensors.update({name: np.zeros(shape, np.float32)}))
    with pytest.raises(WeightsError, match=sentence):
        load_prior(path)


@pytest.mark.parametrize(
    "name, sentence",
    [
        ("params/encoder/norm0/scale", "params/encoder/norm0/scale is missing"),
        ("params/encoder/conv2", "no array 'conv2'"),
        ("code_mean", "mean or covariance is missing"),
        ("code_covariance", "mean or covariance is missing"),
    ],
)
def test_a_missing_array_is_named(name, sentence, rewritten):
    path = rewritten(lambda tensors: tensors.pop(name))
    with pytest.raises(WeightsError, match=rf"changed\.safetensors.*{sentence}"):
        load_prior(path)


def test_a_kill_during_saving_leaves_the_former_file(prior, tmp_path, monkeypatch):
    path = tmp_path / "prior.safetensors"
    save_prior(path, prior, CARD)

    def killed_halfway(tensors, temporary, metadata):
        temporary.write_bytes(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(weights, "save_file", killed_halfway)
    with pytest.raises(KeyboardInterrupt):
        save_prior(path, random_prior(seed=1), {})
    assert os.listdir(tmp_path) == ["prior.safetensors"]
    assert load_card(path) == CARD
    np.testing.assert_array_equal(load_prior(path).code_mean, prior.code_mean)


def test_weights_are_known_by_their_numbers(prior):
    copy = jax.tree.map(lambda x: x + 0, prior)
    assert fingerprint(copy) == fingerprint(prior)
    changed = prior._replace(code_mean=prior.code_mean.at[3].set(1e-6))
    assert fingerprint(changed) != fingerprint(prior)


def test_the_calibration_is_kept_and_a_damaged_one_is_refused(prior, tmp_path):
    path = tmp_path / "sure.safetensors"
    save_prior(path, prior._replace(calibration=Calibration(0.75, 0.125, -0.5)), {})
    assert load_prior(path).calibration == Calibration(0.75, 0.125, -0.5)
    save_prior(path, prior, {})
    assert load_prior(path).calibration is None
    save_prior(path, prior._replace(calibration=Calibration(-1.0, 0.0, 0.0)), {})
    with pytest.raises(WeightsError, match="calibration is .*not negative"):
        load_prior(path)


# --- kinds of models ----------------------------------------------------------------------------

OWN = ShapeModel(
    "own",
    encode=lambda params, grids: jnp.zeros((len(grids.occupied), 3)),
    decode=lambda prepared, codes: jnp.einsum("nd,dxyz->nxyz", codes, prepared.shared["basis"]),
)
BASIS = {"basis": jnp.ones((3, 8, 8, 8))}


def test_weights_name_their_kind_and_an_unknown_one_is_a_sentence(tmp_path):
    path = tmp_path / "own.safetensors"
    save_prior(path, ShapePrior(OWN, BASIS, jnp.zeros(3), jnp.eye(3)), {})
    with pytest.raises(WeightsError, match=r"own\.safetensors.* kind 'own'; known are autoencoder"):
        load_prior(path)
    found = load_prior(path, OWN)
    assert found.model is OWN and found.resolution == 8 and found.code_size == 3


def test_codes_that_are_none_of_an_own_model_are_named(tmp_path):
    path = tmp_path / "own.safetensors"
    save_prior(path, ShapePrior(OWN, BASIS, jnp.zeros(4), jnp.eye(4)), {})
    with pytest.raises(WeightsError, match="4 numbers are no code of this model"):
        load_prior(path, OWN)


def test_weights_from_before_models_had_kinds_are_auto_encoders(prior, saved, tmp_path):
    with safe_open(saved, "np") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    save_file(tensors, tmp_path / "old.safetensors", {"format": FORMAT, "card": "{}"})
    assert load_prior(tmp_path / "old.safetensors").model == AUTOENCODER


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("name", [KERNEL, "code_mean"])
def test_numbers_that_are_not_finite_are_refused(name, value, rewritten):
    path = rewritten(lambda tensors: np.put(tensors[name], 0, value))
    with pytest.raises(WeightsError, match=f"{name} holds NaN or infinity"):
        load_prior(path)


@pytest.mark.parametrize("factor", [0, -1, 1e-300])
def test_a_covariance_that_is_none_is_refused(factor, rewritten):
    path = rewritten(lambda tensors: tensors.update(code_covariance=factor * np.eye(10)))
    with pytest.raises(WeightsError, match="not symmetric and positive definite"):
        load_prior(path)


def test_statistics_that_single_precision_cannot_hold_are_refused(rewritten):
    path = rewritten(lambda tensors: tensors.update(code_covariance=1e300 * np.eye(10)))
    with pytest.raises(WeightsError, match="code_covariance holds NaN or infinity"):
        load_prior(path)


def test_a_card_that_json_cannot_hold_is_refused(prior, tmp_path):
    with pytest.raises(ValueError, match="JSON cannot hold the card"):
        save_prior(tmp_path / "a.safetensors", prior, {"iou": np.float32(0.5)})
    assert not list(tmp_path.iterdir())


def test_large_parameters_are_not_lost_in_half_precision(tmp_path):
    path = tmp_path / "own.safetensors"
    large = {"basis": jnp.full((3, 8, 8, 8), 1e6)}
    save_prior(path, ShapePrior(OWN, large, jnp.zeros(3), jnp.eye(3)), {})
    np.testing.assert_array_equal(load_prior(path, OWN).params["basis"], 1e6)


def test_weights_in_bytes_are_within_half_a_step_and_half_the_size(prior, saved, tmp_path):
    path = tmp_path / "bytes.safetensors"
    save_prior(path, prior, CARD, in_bytes=True)
    assert load_card(path) == CARD
    for name, found in weights.flatten(load_prior(path).params).items():
        expected = np.asarray(weights.flatten(prior.params)[name])
        if expected.ndim == 1 or expected.size < weights.LEAST_IN_BYTES:
            np.testing.assert_array_equal(found, np.float32(np.float16(expected)), name)
        else:
            largest = np.abs(expected).max(axis=tuple(range(expected.ndim - 1)))
            assert (np.abs(found - expected) <= 0.5001 * largest / 127).all(), name
            assert np.any(found != expected), name
    assert path.stat().st_size < 0.7 * saved.stat().st_size


def test_a_channel_of_zeros_stays_zero_in_bytes(tmp_path):
    path = tmp_path / "own.safetensors"
    own = {"basis": jnp.ones((3, 16, 16, 16)).at[..., 5].set(0)}
    save_prior(path, ShapePrior(OWN, own, jnp.zeros(3), jnp.eye(3)), {}, in_bytes=True)
    np.testing.assert_allclose(load_prior(path, OWN).params["basis"], own["basis"], rtol=1e-6)


def test_factors_of_other_channels_are_refused(prior, tmp_path):
    path = tmp_path / "bytes.safetensors"
    save_prior(path, prior, CARD, in_bytes=True)
    tensors = load_file(path)
    tensors[weights.FACTORS + KERNEL] = np.ones(3, np.float32)
    save_file(tensors, path, {"format": weights.FORMAT_IN_BYTES, "card": json.dumps(CARD)})
    with pytest.raises(WeightsError, match=r"conv1 has \d+ channels and \(3,\) factors"):
        load_prior(path)
