"""The objective with a real network: memory, line searches, penalties, and several networks."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from programs import largest

from jaxshape.geometry.grids import Grids
from jaxshape.model.shapes import decode
from jaxshape.search.config import RefineConfig
from jaxshape.search.methods import build_refiner
from jaxshape.search.objective import objective
from jaxshape.search.residuals import BALANCED, Residual, Target, cross_entropy
from jaxshape.search.run import refine

pytestmark = pytest.mark.usefixtures("compile_quickly")


def losses_of(prior, codes, targets, **options):
    """Losses of all candidates of all objects."""

    def of_object(codes, target):
        return jax.vmap(objective(prior, target, **options))(codes)

    return jax.vmap(of_object)(codes, targets)


def size(prior, objects, candidates, **options):
    codes = jax.ShapeDtypeStruct((objects, candidates, prior.code_size), jnp.float32)
    grids = jax.ShapeDtypeStruct((objects, 32, 32, 32), jnp.float32)
    score = partial(losses_of, prior, **options)
    return largest(jax.make_jaxpr(score)(codes, Target(grids, grids)).jaxpr)


def test_memory_does_not_grow_with_objects_and_candidates(prior):
    """The largest array of the program is that of one chunk, however many there are."""
    few, many = size(prior, 4, 256), size(prior, 64, 1024)
    assert few == many < 64 * 1024 * 32**3


def test_nor_does_it_where_a_penalty_decodes_again(prior):
    def penalty(code):
        return jnp.mean(jax.nn.sigmoid(decode(prior, code)))

    few, many = size(prior, 4, 256, penalty=penalty), size(prior, 64, 1024, penalty=penalty)
    assert few == many < 64 * 1024 * 32**3


def test_a_penalty_may_close_over_arrays_of_the_program(linear_prior):
    """Also under a branch that `jax.vmap` turns into a select, as in a line search."""
    prior = linear_prior
    code, target = jnp.ones(10), Target(*jnp.ones((2, 32, 32, 32)))

    @jax.jit
    def slopes(centre, wanted):
        def one(wanted):
            loss = objective(prior, target, penalty=lambda code: jnp.sum((code - centre) ** 2))
            return jax.lax.cond(wanted, lambda: jax.grad(loss)(code), lambda: 0 * code)

        return jax.vmap(one)(wanted)

    found = slopes(jnp.full(10, 3.0), jnp.array([True, False]))
    without = jax.grad(objective(prior, target))(code)
    np.testing.assert_allclose(found[0], without - 4, rtol=1e-4)
    np.testing.assert_array_equal(found[1], 0)


@pytest.mark.slow
def test_a_line_search_over_the_network_can_be_batched(prior):
    """Its branches turn into selects, which copy whatever the network's program holds."""
    keys, codes = jax.random.split(jax.random.key(0), 2), jnp.zeros((2, 10))
    grids = Grids(*jax.random.bernoulli(jax.random.key(1), 0.3, (2, 2, 32, 32, 32)))
    targets = jax.vmap(BALANCED.target)(grids, jnp.zeros((2, 32, 32, 32)))
    refiner = build_refiner("gradient:lbfgs", 10, RefineConfig())
    search = partial(refine, refiner=refiner, iterations=2)
    found = jax.eval_shape(search, keys, prior, codes, targets)
    assert found.code.shape == codes.shape


def test_several_networks_at_once_are_refused_and_mapped_ones_are_right(linear_prior):
    """Networks that differ in their kernels alone were all searched with the first one's."""
    networks = jax.tree.map(lambda x: jnp.stack([x, 1.1 * x]), linear_prior)
    code, targets = jnp.ones((1, 10)), Target(*jnp.ones((2, 1, 32, 32, 32)))
    refiner = build_refiner("gradient", 10, RefineConfig(step_size=0.1))

    def search(prior):
        return refine(jax.random.key(0), prior, code, targets, refiner, 2).loss[0]

    with pytest.raises(ValueError, match="2 networks at once.*jax.lax.map"):
        jax.vmap(search)(networks)
    with pytest.raises(ValueError, match="2 networks at once"):
        jax.jit(jax.vmap(search)).lower(networks)
    found = jax.jit(partial(jax.lax.map, search))(networks)
    expected = [search(jax.tree.map(lambda x, i=i: x[i], networks)) for i in range(2)]
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    assert abs(found[0] - found[1]) > 1e-3


def test_a_residual_of_ones_own_sees_the_objects_own_data(linear_prior):
    """Its target is whatever it returns: here other arrays than those of Eq. 7."""
    residual = Residual(
        target=lambda grids, first: {"wanted": grids.data["scale"] * grids.occupied},
        score=lambda logits, target: jnp.mean((logits - target["wanted"]) ** 2),
    )
    F = jax.random.bernoulli(jax.random.key(0), 0.3, (3, 32, 32, 32))
    grids = Grids(F, ~F, {"scale": jnp.arange(3.0)})
    targets = jax.vmap(residual.target)(grids, jnp.zeros(F.shape))
    codes = jax.random.normal(jax.random.key(1), (3, 2, 10))
    losses = losses_of(linear_prior, codes, targets, residual=residual)
    logits = decode(linear_prior, codes)
    for i, k in np.ndindex(3, 2):
        expected = np.mean((np.asarray(logits[i, k], np.float64) - i * np.asarray(F[i])) ** 2)
        np.testing.assert_allclose(losses[i, k], expected, rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_slopes_of_the_network_are_right_in_64_bits(prior, dtype):
    """Accumulators without a type of their own were float64, and every gradient an error."""
    grids = np.asarray(jax.random.bernoulli(jax.random.key(1), 0.3, (2, 32, 32, 32)), np.float32)
    code = np.linspace(-1, 1, 10)

    def slope(prior, code):
        return jax.jit(jax.value_and_grad(objective(prior, Target(*grids))))(code)

    loss, expected = slope(prior, jnp.float32(code))
    with jax.enable_x64(True):
        wide = jax.tree.map(lambda x: jnp.asarray(np.asarray(x), dtype), prior)
        found_loss, found = slope(wide, jnp.asarray(code))
        assert found_loss.dtype == found.dtype == jnp.float64
        np.testing.assert_allclose(found_loss, loss, rtol=1e-4)
        np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-6)


@pytest.mark.slow
def test_it_scores_what_the_network_decodes(prior):
    codes = jax.random.normal(jax.random.key(1), (2, 3, 10))
    logits = jax.jit(decode)(prior, codes)
    grids = Grids(*jax.random.bernoulli(jax.random.key(2), 0.3, (2, 2, 32, 32, 32)))
    targets = jax.vmap(BALANCED.target)(grids, logits[:, 0])
    losses = jax.jit(partial(losses_of, prior))(codes, targets)
    expected = cross_entropy(logits, jax.tree.map(lambda x: x[:, None], targets))
    np.testing.assert_allclose(losses, expected, rtol=1e-5)
    # The codes do matter: they differ by far more than rounding does.
    assert np.ptp(losses, axis=1).min() > 20 * 1e-5 * losses.max()


def test_whole_numbers_are_a_code_like_any_other(unchecked_types, linear_prior):
    """The loss takes the type of the code: it was cut off to 0."""
    target = Target(*jnp.ones((2, 32, 32, 32)))
    loss, expected = objective(linear_prior, target), objective(linear_prior, target)(jnp.ones(10))
    assert loss(jnp.ones(10, int)) == expected > 0
    refiner = build_refiner("gradient", 10, RefineConfig())
    codes, targets = np.ones((1, 10)), jax.tree.map(lambda x: x[None], target)
    found = [
        refine(jax.random.key(0), linear_prior, codes.astype(kind), targets, refiner, 1).code
        for kind in (np.int32, np.float32)
    ]
    np.testing.assert_array_equal(*found)


@pytest.mark.parametrize(
    "shape, said", [((3,), r"shape \(3,\); the codes.*10 numbers"), ((1, 10), "takes one code")]
)
def test_codes_of_another_size_are_named(unchecked_types, linear_prior, shape, said):
    target = Target(*jnp.ones((2, 32, 32, 32)))
    with pytest.raises(ValueError, match=said):
        objective(linear_prior, target)(jnp.ones(shape))
    with pytest.raises(ValueError, match=r"shape \(2, 3\); the codes of this prior have 10"):
        decode(linear_prior, jnp.ones((2, 3)))
