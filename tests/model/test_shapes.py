"""What the seam promises for every model: any leading axes, few at a time, features of its own."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from marks import slow

from jaxshape.geometry.grids import Grids, binary
from jaxshape.model.shapes import (
    Prepared,
    ShapeModel,
    ShapePrior,
    decode,
    decode_prepared,
    encode,
)
from jaxshape.search.config import RefineConfig
from jaxshape.search.methods import build_refiner
from jaxshape.search.reconstruction import reconstruct

N, D = 4, 3
rng = np.random.default_rng(0)


def _encode(params, grids):
    return jnp.einsum("bxyz,dxyz->bd", grids.occupied.astype(jnp.float32), params)


def _prepare(params, grids, precision):
    del precision
    return Prepared(params, () if grids is None else grids.occupied.astype(jnp.float32))


def _decode(prepared, codes):
    logits = jnp.einsum("nd,dxyz->nxyz", codes, prepared.shared)
    return logits if isinstance(prepared.own, tuple) else logits + 10 * prepared.own


CONDITIONED = ShapeModel("conditioned", _encode, _decode, _prepare)
"""Its decoder is given what was measured of each object."""
PARAMS = jnp.asarray(rng.normal(size=(D, N, N, N)), jnp.float32)
PRIOR = ShapePrior(CONDITIONED, PARAMS, jnp.zeros(D), jnp.eye(D))


def grids(*batch):
    return Grids(*jnp.asarray(rng.random((2, *batch, N, N, N)) < 0.4))


def test_sizes_are_read_off_the_parameters():
    assert (PRIOR.resolution, PRIOR.code_size) == (N, D)


@pytest.mark.parametrize("batch", [(), (1,), (2, 3), (5, 7)])  # the last in several chunks
def test_leading_axes_are_a_batch(batch):
    seen = grids(*batch)
    codes = jax.jit(encode)(PRIOR, seen)
    assert codes.shape == (*batch, D)
    logits = jax.jit(decode)(PRIOR, codes)
    for i in np.ndindex(batch):
        one = jax.tree.map(lambda x, i=i: x[i][None], seen)
        np.testing.assert_allclose(codes[i], _encode(PARAMS, one)[0], rtol=1e-4, atol=1e-5)
        expected = _decode(Prepared(PARAMS), codes[i][None])[0]
        np.testing.assert_allclose(logits[i], expected, rtol=1e-4, atol=1e-4)


def test_each_code_is_decoded_with_its_own_objects_features():
    """Many codes for each of a few objects, more than go through the decoder at a time."""
    seen = grids(3)
    codes = jnp.asarray(rng.normal(size=(3, 11, D)), jnp.float32)
    prepared = CONDITIONED.prepare(PARAMS, seen, "float32")
    logits = jax.jit(lambda codes: decode_prepared(CONDITIONED, prepared, codes))(codes)
    expected = jnp.einsum("bkd,dxyz->bkxyz", codes, PARAMS) + 10.0 * seen.occupied[:, None]
    np.testing.assert_allclose(logits, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("method", ["gradient:adam", slow("cma"), slow("hybrid")])
def test_a_conditioned_decoder_is_searched_with_each_objects_features(method):
    """In company as alone; and what a search found is what its own object decodes to."""
    config = RefineConfig(iterations=5, population=4, space="raw")
    refiner, seen = build_refiner(method, D, config), grids(3)
    keys = jax.random.split(jax.random.key(0), 3)

    @jax.jit
    def run(keys, occupied, occluded):
        return reconstruct(keys, PRIOR, occupied, occluded, refiner, config)

    found = run(keys, seen.occupied, seen.occluded)
    assert np.all(found.objective < found.first_objective)
    expected = jnp.einsum("bd,dxyz->bxyz", found.code, PARAMS) + 10.0 * seen.occupied
    np.testing.assert_allclose(found.logits, expected, rtol=1e-3, atol=1e-3)
    alone = run(keys[1:2], seen.occupied[1:2], seen.occluded[1:2])
    np.testing.assert_allclose(alone.objective[0], found.objective[1], rtol=1e-4)


def test_models_of_the_same_functions_share_what_is_compiled():
    again = ShapeModel("conditioned", _encode, _decode, _prepare)
    assert again == CONDITIONED and hash(again) == hash(CONDITIONED)
    traced = []

    @jax.jit
    def first(prior):
        traced.append(prior.model.kind)
        return prior.params[0]

    first(PRIOR), first(PRIOR._replace(model=again))
    assert traced == ["conditioned"]


def test_rounding_soft_grids_gives_the_papers():
    F, M = jnp.array([0.9, 0.9, 0.1, 0.1]), jnp.array([0.1, 0.9, 0.1, 0.9])
    rounded = binary(Grids(F.reshape(4, 1, 1), M.reshape(4, 1, 1)))
    np.testing.assert_array_equal(rounded.occupied.ravel(), [True, False, False, False])
    np.testing.assert_array_equal(rounded.occluded.ravel(), [False, True, False, True])
    again = binary(rounded)
    jax.tree.map(np.testing.assert_array_equal, again, rounded)


@pytest.mark.parametrize(
    "function, change, said",
    [
        (
            "decode",
            lambda logits: logits[..., None],
            r"shape \(1, 4, 4, 4, 1\) for one code; it must",
        ),
        ("decode", lambda logits: logits[:, :2], r"shape \(1, 2, 4, 4\) for one code; it must"),
        ("decode", lambda logits: logits > 0, r"bool of shape .*must return float32 logits"),
        ("decode", lambda logits: (logits,), r"returned a tuple for one code"),
        (
            "encode",
            lambda codes: codes[:, :2],
            r"encode .* shape \(2, 2\) for 2 objects; .* \(2, 3\)",
        ),
        ("prepare", lambda prepared: prepared.shared, r"must return a Prepared\(shared, own\)"),
    ],
)
def test_a_model_that_breaks_its_promise_is_told_which(unchecked_types, function, change, said):
    """A channel axis was once told as grids of one voxel."""
    right = getattr(CONDITIONED, function)
    model = replace(CONDITIONED, **{function: lambda *given: change(right(*given))})
    with pytest.raises(ValueError, match=said):
        encode(PRIOR._replace(model=model), grids(2))
