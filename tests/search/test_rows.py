"""Scores under every nesting of transformations, with a decoder that compiles at once."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from programs import equations_inside

from jaxshape.search.residuals import Target, cross_entropy
from jaxshape.search.rows import hoisted, loss_over_rows, one_network

SHAPE = (4, 3, 5)
rng = np.random.default_rng(0)
OBJECTS, CANDIDATES, D = 3, 5, 6
PARAMS = {
    "kernel": jnp.asarray(rng.normal(size=(D, *SHAPE)), jnp.float32),
    "bias": jnp.asarray(rng.normal(size=SHAPE[-1:]), jnp.float32),
}
CODES = jnp.asarray(rng.normal(size=(OBJECTS, CANDIDATES, D)), jnp.float32)
TARGETS = Target(*jnp.asarray(rng.random((2, OBJECTS, *SHAPE)), jnp.float32))


def quick_decode(params, code):
    return jnp.tanh(jnp.tensordot(code, params["kernel"], 1) + params["bias"]) * 3


def of_object(i):
    return jax.tree.map(lambda x: x[i], TARGETS)


def plain(params, code, target):
    return cross_entropy(quick_decode(params, code), target)


def score(params, codes, targets):
    return cross_entropy(quick_decode(params, codes), targets)


objective = loss_over_rows(score)


def expected_losses():
    loss = jax.jit(plain)
    return np.array(
        [[loss(PARAMS, code, of_object(i)) for code in CODES[i]] for i in range(OBJECTS)]
    )


def expected_slopes():
    slope = jax.jit(jax.grad(plain, argnums=1))
    return np.array(
        [[slope(PARAMS, code, of_object(i)) for code in CODES[i]] for i in range(OBJECTS)]
    )


def over_candidates(f):
    return jax.vmap(f, in_axes=(None, 0, None))


def over_objects(f):
    return jax.vmap(f, in_axes=(None, 0, 0))


def test_losses_under_every_nesting_are_those_of_a_plain_loop():
    expected = expected_losses()
    for wrap in (lambda f: f, jax.jit):
        one = wrap(objective)(PARAMS, CODES[1, 2], of_object(1))
        np.testing.assert_allclose(one, expected[1, 2], rtol=1e-5)

    population = jax.jit(over_candidates(objective))(PARAMS, CODES[1], of_object(1))
    np.testing.assert_allclose(population, expected[1], rtol=1e-5)

    firsts = jax.jit(over_objects(objective))(PARAMS, CODES[:, 0], TARGETS)
    np.testing.assert_allclose(firsts, expected[:, 0], rtol=1e-5)

    inside = jax.jit(over_objects(over_candidates(objective)))(PARAMS, CODES, TARGETS)
    np.testing.assert_allclose(inside, expected, rtol=1e-5)

    outside = jax.jit(over_candidates(over_objects(objective)))(
        PARAMS, CODES.swapaxes(0, 1), TARGETS
    )
    np.testing.assert_allclose(outside, expected.T, rtol=1e-5)


def test_one_code_under_many_targets_and_many_codes_under_one():
    """Only one of the two arguments is batched."""
    code = CODES[0, 0]
    losses = jax.jit(jax.vmap(objective, in_axes=(None, None, 0)))(PARAMS, code, TARGETS)
    expected = [plain(PARAMS, code, of_object(i)) for i in range(OBJECTS)]
    np.testing.assert_allclose(losses, expected, rtol=1e-5)

    all_under_one = jax.vmap(over_candidates(objective), in_axes=(None, 0, None))
    losses = jax.jit(all_under_one)(PARAMS, CODES, of_object(0))
    expected = [[plain(PARAMS, code, of_object(0)) for code in row] for row in CODES]
    np.testing.assert_allclose(losses, expected, rtol=1e-5)

    shared = jax.vmap(over_candidates(objective), in_axes=(None, None, 0))
    losses = jax.jit(shared)(PARAMS, CODES[0], TARGETS)
    expected = [[plain(PARAMS, c, of_object(i)) for c in CODES[0]] for i in range(OBJECTS)]
    np.testing.assert_allclose(losses, expected, rtol=1e-5)


def test_slopes_under_every_nesting_are_those_of_a_plain_loop():
    slope, expected = jax.grad(objective, argnums=1), expected_slopes()
    one = slope(PARAMS, CODES[1, 2], of_object(1))
    np.testing.assert_allclose(one, expected[1, 2], rtol=1e-4, atol=1e-7)

    firsts = jax.jit(over_objects(slope))(PARAMS, CODES[:, 0], TARGETS)
    np.testing.assert_allclose(firsts, expected[:, 0], rtol=1e-4, atol=1e-7)

    losses, slopes = jax.jit(over_objects(jax.value_and_grad(objective, argnums=1)))(
        PARAMS, CODES[:, 0], TARGETS
    )
    np.testing.assert_allclose(losses, expected_losses()[:, 0], rtol=1e-5)
    np.testing.assert_allclose(slopes, expected[:, 0], rtol=1e-4, atol=1e-7)


def test_slopes_of_many_candidates_of_many_objects():
    """Two vmaps over a gradient, as a population of descents would need."""
    slopes = jax.jit(over_objects(over_candidates(jax.grad(objective, argnums=1))))(
        PARAMS, CODES, TARGETS
    )
    np.testing.assert_allclose(slopes, expected_slopes(), rtol=1e-4, atol=1e-7)


def test_the_slope_scales_with_what_comes_after():
    slope = jax.grad(lambda code: -7 * objective(PARAMS, code, of_object(0)) ** 2)(CODES[0, 0])
    expected = -14 * expected_losses()[0, 0] * expected_slopes()[0, 0]
    np.testing.assert_allclose(slope, expected, rtol=1e-4)


def test_three_levels_of_nesting_and_any_mixture_of_axes():
    codes = jnp.stack([CODES, CODES + 1, -CODES, CODES / 2])  # 4 starts of 3 objects of 5
    many = jax.vmap(over_objects(over_candidates(objective)), in_axes=(None, 0, None))
    losses = jax.jit(many)(PARAMS, codes, TARGETS)
    plain_loss = jax.jit(plain)
    for a, i, k in np.ndindex(losses.shape):
        expected = plain_loss(PARAMS, codes[a, i, k], of_object(i))
        np.testing.assert_allclose(losses[a, i, k], expected, rtol=1e-5)

    # The same codes with their axes the other way round, and the objects innermost.
    inside_out = jax.vmap(over_candidates(over_objects(objective)), in_axes=(None, 3, None))
    turned = jax.jit(inside_out)(PARAMS, codes.transpose(2, 1, 3, 0), TARGETS)
    np.testing.assert_allclose(turned, losses.transpose(0, 2, 1), rtol=1e-5)


def test_only_one_part_of_a_target_may_be_batched():
    one = of_object(0)
    in_axes = (None, 0, Target(occupied=0, empty=None))
    losses = jax.jit(jax.vmap(objective, in_axes=in_axes))(
        PARAMS, CODES[:, 0], Target(TARGETS.occupied, one.empty)
    )
    for i in range(OBJECTS):
        expected = plain(PARAMS, CODES[i, 0], Target(TARGETS.occupied[i], one.empty))
        np.testing.assert_allclose(losses[i], expected, rtol=1e-5)


def test_several_networks_are_refused_when_they_are_traced():
    several = jax.tree.map(lambda x: jnp.stack([x, 2 * x]), PARAMS)
    with pytest.raises(ValueError, match="2 networks at once.*jax.lax.map"):
        jax.jit(jax.vmap(one_network)).lower(several)
    jax.tree.map(np.testing.assert_array_equal, one_network(PARAMS), PARAMS)


def test_a_closure_becomes_a_function_of_what_it_closes_over():
    """Also where that is traced, and batched only afterwards."""
    x = jnp.arange(3.0)

    @jax.jit
    def both(y):
        closure = lambda a, pair: jnp.sum(a * y) + pair["b"][0] * x[1]  # noqa: E731
        arguments = jnp.ones(3), {"b": jnp.full(2, 5.0)}
        pure, constants = hoisted(closure, *arguments)
        batch = jax.tree.map(lambda x: jnp.stack([x, 2 * x]), constants)
        return closure(*arguments), pure(constants, *arguments), jax.vmap(
            lambda constants: pure(constants, *arguments))(batch)  # fmt: skip

    plain, again, batched = both(jnp.arange(3.0))
    np.testing.assert_allclose(again, plain)
    np.testing.assert_allclose(batched, [plain, 2 * plain])


def test_a_branch_that_vmap_turns_into_a_select_keeps_its_losses():
    """Under vmap a conditional copies the network for each element, as line searches do."""

    @jax.jit
    @partial(jax.vmap, in_axes=(0, 0, 0))
    def of_one(wanted, codes, target):
        def slopes():
            return jax.vmap(jax.grad(objective, argnums=1), in_axes=(None, 0, None))(
                PARAMS, codes, target
            )

        return jax.lax.cond(wanted, slopes, lambda: jnp.zeros_like(codes))

    wanted = jnp.array([True, False, True])
    expected = np.where(wanted[:, None, None], expected_slopes(), 0)
    np.testing.assert_allclose(of_one(wanted, CODES, TARGETS), expected, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("at_a_time", [1, 2, 3, 15, 100])
def test_codes_that_are_not_finite_score_nan_and_cost_nothing(at_a_time):
    """Only chunks with a finite code are decoded; the others of a chunk score as ever."""
    decoded = []

    def counting_score(params, codes, targets):
        jax.debug.callback(lambda: decoded.append(len(codes)))
        logits = jnp.nan_to_num(quick_decode(params, codes))  # hides what it was given
        return cross_entropy(logits, targets)

    objective = loss_over_rows(counting_score, {"cpu": at_a_time, "default": at_a_time})
    finite = rng.random((OBJECTS, CANDIDATES)) < 0.4
    finite[1] = False
    failures = rng.choice([np.nan, np.inf, -np.inf], (OBJECTS, CANDIDATES))
    codes = CODES.at[..., 2].set(jnp.where(finite, CODES[..., 2], failures))
    slope = jax.value_and_grad(objective, argnums=1)
    losses, slopes = jax.jit(over_objects(over_candidates(slope)))(PARAMS, codes, TARGETS)
    jax.effects_barrier()

    size = min(at_a_time, finite.size)
    rows = np.pad(finite.ravel(), (0, -finite.size % size), constant_values=finite.ravel()[-1])
    assert sum(decoded) == size * np.count_nonzero(rows.reshape(-1, size).any(axis=1))
    expected = np.where(finite, expected_losses(), np.nan)
    np.testing.assert_allclose(losses, expected, rtol=1e-5)
    expected = np.where(finite[..., None], expected_slopes(), np.nan)
    np.testing.assert_allclose(slopes, expected, rtol=1e-4, atol=1e-7)


def test_nesting_adds_no_call_of_the_decoder():
    """All candidates of all objects share the call, one for each kind of device."""
    objective = loss_over_rows(score, {"cpu": 1, "default": CANDIDATES})

    def calls(function, *args):
        jaxpr = jax.make_jaxpr(function)(PARAMS, *args).jaxpr
        return sum(equation.primitive.name == "tanh" for equation in equations_inside(jaxpr))

    assert calls(over_candidates(objective), CODES[0], of_object(0)) == 2
    assert calls(over_objects(objective), CODES[:, 0], TARGETS) == 2
    assert calls(over_objects(over_candidates(objective)), CODES, TARGETS) == 2
    assert calls(over_candidates(over_objects(objective)), CODES.swapaxes(0, 1), TARGETS) == 2
