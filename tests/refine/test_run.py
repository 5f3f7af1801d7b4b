"""The refinement loop: what every refiner promises over a batch of objects."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxshape.refine import objective as objective_module
from jaxshape.refine.cma import cma
from jaxshape.refine.gradient import gradient
from jaxshape.refine.objective import cross_entropy, target
from jaxshape.refine.run import refine
from jaxshape.refine.strategies import evosax_strategy

OBJECTS, D, SHAPE, ITERATIONS = 3, 4, (3, 3, 3), 8
KEYS = jax.random.split(jax.random.key(0), OBJECTS)
rng = np.random.default_rng(1)
PARAMS = jnp.asarray(rng.normal(size=(D, *SHAPE)), jnp.float32)
CODES = jnp.asarray(rng.normal(size=(OBJECTS, D)), jnp.float32)


def quick_decode(params, code):
    """Stands for the network, so that a search compiles at once."""
    return jnp.tensordot(code, params, 1)


TARGETS = target(*jnp.asarray(rng.random((2, OBJECTS, *SHAPE)) < 0.5), quick_decode(PARAMS, CODES))
REFINERS = {
    "cma": cma(dim=D, sigma0=0.3),
    "gradient": gradient(0.5),
    "adam": gradient(optax.adam(0.1)),
    "SNES": evosax_strategy("SNES", dim=D, population=8, sigma0=0.3),
}


@pytest.fixture(scope="module")
def traces():
    return []


@pytest.fixture(scope="module", params=list(REFINERS))
def search(request, traces):
    """A compiled search; the decoder is replaced for as long as any test needs it."""
    patch = pytest.MonkeyPatch()

    def counting_decode(params, code):
        traces.append(request.param)
        return quick_decode(params, code)

    patch.setattr(objective_module, "decode", counting_decode)
    yield jax.jit(partial(refine, refiner=REFINERS[request.param], iterations=ITERATIONS))
    patch.undo()


@pytest.fixture(scope="module")
def refined(search):
    return search(KEYS, PARAMS, CODES, TARGETS)


def loss_of(code, i):
    one = jax.tree.map(lambda x: x[i], TARGETS)
    return cross_entropy(quick_decode(PARAMS, code), one)


def test_the_outcome_is_the_best_code_and_never_worse_than_the_first(refined):
    for i in range(OBJECTS):
        assert refined.loss[i] < loss_of(CODES[i], i)
        np.testing.assert_allclose(refined.loss[i], loss_of(refined.code[i], i), rtol=1e-5)
        # Where the search stands at last counts too, though no iteration evaluated it.
        assert refined.loss[i] <= loss_of(refined.state.mean[i], i) * (1 + 1e-6)
    assert np.all(refined.loss <= refined.trace.best_loss[:, -1])


def test_the_trace_never_rises(refined):
    assert refined.trace.best_loss.shape == (OBJECTS, ITERATIONS)
    assert np.all(np.diff(refined.trace.best_loss, axis=1) <= 0)


def test_a_key_decides_the_outcome_and_a_second_call_traces_nothing(search, refined, traces):
    before = len(traces)
    again = search(KEYS, PARAMS, CODES, TARGETS)
    jax.tree.map(np.testing.assert_array_equal, refined, again)
    other = search(jax.random.split(jax.random.key(7), OBJECTS), PARAMS, CODES, TARGETS)
    if np.any(np.asarray(refined.trace.spread) > 0):  # the search draws at random
        assert not np.allclose(refined.code, other.code)
    else:
        np.testing.assert_array_equal(refined.code, other.code)
    assert len(traces) == before > 0


def test_an_object_that_fails_does_not_disturb_the_others(search, refined):
    poisoned = jax.tree.map(lambda x: x.at[1].set(jnp.nan), TARGETS)
    found = search(KEYS, PARAMS, CODES, poisoned)
    for row in (0, 2):
        np.testing.assert_array_equal(found.code[row], refined.code[row])
        np.testing.assert_array_equal(found.loss[row], refined.loss[row])
    np.testing.assert_array_equal(found.code[1], CODES[1])
    assert np.isinf(found.loss[1])


def test_an_object_alone_finds_what_it_finds_in_company(search, refined):
    alone = search(KEYS[1:2], PARAMS, CODES[1:2], jax.tree.map(lambda x: x[1:2], TARGETS))
    np.testing.assert_allclose(alone.code[0], refined.code[1], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(alone.loss[0], refined.loss[1], rtol=1e-5)


def test_equal_objects_search_by_keys_of_their_own(search, refined):
    same = jax.tree.map(lambda x: jnp.stack([x[0]] * OBJECTS), (CODES, TARGETS))
    found = search(KEYS, PARAMS, *same)
    if np.any(np.asarray(refined.trace.spread) > 0):
        assert not np.allclose(found.code[0], found.code[1])
    np.testing.assert_array_equal(found.code[0], refined.code[0])
