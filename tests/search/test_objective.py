"""Eq. 7 against the paper in NumPy, and under every nesting of transformations."""

from functools import partial

import jax
import jax.extend as jex
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from jaxshape.search import objective as module
from jaxshape.search.config import RefineConfig
from jaxshape.search.methods import build_refiner
from jaxshape.search.objective import BALANCED, PAPER, objective
from jaxshape.search.run import refine

SHAPE = (4, 3, 5)
rng = np.random.default_rng(0)


def random_grids(*batch):
    return jnp.asarray(rng.random((*batch, *SHAPE)) < 0.5)


def random_logits(*batch):
    return jnp.asarray(rng.normal(size=(*batch, *SHAPE)), jnp.float32)


# --- the equation -----------------------------------------------------------------------------


def sigmoid(x):
    return 1 / (1 + np.exp(-np.float64(x)))


def printed_equation(F, M, G, G0):
    """Eq. 7 term by term, in float64, with the 1 / N^3 of the training loss."""
    alpha = M.sum() / (1 - M).sum()

    def f(t, g):
        return -(t * np.log(g) + (1 - t) * np.log(1 - g))

    total = 0.0
    for voxel in np.ndindex(F.shape):
        total += (1 - M[voxel]) * f(F[voxel], G[voxel]) + alpha * M[voxel] * f(G0[voxel], G[voxel])
    return total / F.size


booleans = arrays(bool, SHAPE)
logits_of_a_grid = arrays(np.float32, SHAPE, elements=st.floats(-9, 9, width=32))


@settings(max_examples=40, deadline=None)
@given(booleans, booleans, logits_of_a_grid, logits_of_a_grid)
def test_it_is_the_equation_as_printed(occupied, occluded, prior_logits, logits):
    occluded[0, 0, 0] = False  # else the printed alpha is infinite
    weights = target(jnp.asarray(occupied), jnp.asarray(occluded), jnp.asarray(prior_logits), PAPER)
    ours = cross_entropy(jnp.asarray(logits), weights)
    expected = printed_equation(
        occupied.astype(int), occluded.astype(int), sigmoid(logits), sigmoid(prior_logits)
    )
    # The softplus of logits far from 0 is small, and rounded as 1 + small is.
    rounding = np.finfo(np.float32).eps * float(np.mean(weights.occupied + weights.empty))
    np.testing.assert_allclose(ours, expected, rtol=1e-5, atol=rounding)


def test_only_measured_free_voxels_are_weighed_down():
    occupied, occluded = random_grids(2)
    logits = random_logits()
    printed = target(occupied, occluded, logits, PAPER)
    balanced = target(occupied, occluded, logits)
    np.testing.assert_array_equal(printed.occupied, balanced.occupied)
    expected = np.where(~occupied & ~occluded, printed.empty / 3, printed.empty)
    np.testing.assert_allclose(balanced.empty, expected, rtol=1e-6)
    assert (balanced.empty < printed.empty).sum() == (~occupied & ~occluded).sum() > 0


def test_the_prior_is_scaled_and_nothing_else():
    occupied, occluded = random_grids(2)
    logits = random_logits()
    once = target(occupied, occluded, logits, PAPER)
    twice = target(occupied, occluded, logits, Weights(prior=2.0))
    factor = np.where(occluded, 2, 1)
    np.testing.assert_allclose(twice.occupied, factor * once.occupied, rtol=1e-6)
    np.testing.assert_allclose(twice.empty, factor * once.empty, rtol=1e-6)


def test_nothing_or_everything_occluded_is_defined():
    occupied, (prior_logits, logits) = random_grids(), random_logits(2)

    none = target(occupied, jnp.zeros(SHAPE, bool), prior_logits, PAPER)
    np.testing.assert_array_equal(none.occupied, occupied)
    np.testing.assert_array_equal(none.empty, ~occupied)
    assert np.isfinite(cross_entropy(logits, none))

    everything = target(occupied, jnp.ones(SHAPE, bool), prior_logits, PAPER)
    count = np.prod(SHAPE)
    np.testing.assert_allclose(everything.occupied, count * sigmoid(prior_logits), rtol=1e-5)
    assert np.isfinite(cross_entropy(logits, everything))


def test_saturated_logits_stay_exact():
    """Where float32 rounds G to 0 or 1, log G would be infinite."""
    logits = jnp.array([-200.0, -30.0, 30.0, 200.0]).reshape(4, 1, 1)
    ones, zeros = jnp.ones((4, 1, 1)), jnp.zeros((4, 1, 1))
    wants_occupied = jax.grad(lambda x: cross_entropy(x, Target(ones, zeros)))(logits)
    np.testing.assert_allclose(cross_entropy(logits, Target(ones, zeros)), 230 / 4, rtol=1e-6)
    np.testing.assert_allclose(cross_entropy(logits, Target(zeros, ones)), 230 / 4, rtol=1e-6)
    np.testing.assert_allclose(wants_occupied.ravel(), [-0.25, -0.25, 0, 0], atol=1e-7)


def test_voxels_without_weight_have_no_say():
    """Observed voxels ignore the prior; with none occluded, the prior counts for nothing."""
    occupied, occluded = random_grids(2)
    logits, prior_logits = random_logits(2)

    def loss(logits, prior_logits, occluded):
        return cross_entropy(logits, target(occupied, occluded, prior_logits))

    slope_of = jax.jit(jax.grad(loss, argnums=1))
    slope = slope_of(logits, prior_logits, occluded)
    assert np.all(slope[~occluded] == 0) and np.all(slope[occluded] != 0)
    assert np.all(slope_of(logits, prior_logits, occluded & False) == 0)

    weights = target(occupied, occluded, prior_logits)
    silent = jax.tree.map(lambda x: jnp.where(jnp.arange(5) < 2, 0, x), weights)
    slope = jax.grad(cross_entropy)(logits, silent)
    assert np.all(slope[..., :2] == 0) and np.any(slope[..., 2:] != 0)


@pytest.mark.parametrize("weights", [PAPER, BALANCED])
def test_its_minimum_is_the_measurement_where_observed_and_the_prior_elsewhere(weights):
    """The slope over logits is zero at the prior, and points to the measurement at any logit."""
    occupied, occluded = random_grids(2)
    prior_logits, logits = random_logits(2)
    weights = target(occupied, occluded, prior_logits, weights)
    slope_at = jax.grad(cross_entropy)

    np.testing.assert_allclose(slope_at(prior_logits, weights)[occluded], 0, atol=1e-7)
    towards_prior = np.sign(logits - prior_logits)
    np.testing.assert_array_equal(
        np.sign(slope_at(logits, weights))[occluded], towards_prior[occluded]
    )
    towards_measured = np.where(occupied, -1, 1)
    for start in (logits, prior_logits):
        np.testing.assert_array_equal(
            np.sign(slope_at(start, weights))[~occluded], towards_measured[~occluded]
        )


def test_leading_axes_are_a_batch():
    occupied, occluded = random_grids(2, 2, 3)
    prior_logits, logits = random_logits(2, 2, 3)
    score = jax.jit(lambda *grids: cross_entropy(grids[2], target(grids[0], grids[1], grids[3])))
    losses = score(occupied, occluded, logits, prior_logits)
    for i in np.ndindex(2, 3):
        one = score(occupied[i], occluded[i], logits[i], prior_logits[i])
        np.testing.assert_allclose(losses[i], one, rtol=1e-6)


# --- the objective over codes, with a decoder that compiles at once -----------------------------

OBJECTS, CANDIDATES, D = 3, 5, 6
PARAMS = {
    "kernel": jnp.asarray(rng.normal(size=(D, *SHAPE)), jnp.float32),
    "bias": jnp.asarray(rng.normal(size=SHAPE[-1:]), jnp.float32),
}
CODES = jnp.asarray(rng.normal(size=(OBJECTS, CANDIDATES, D)), jnp.float32)
TARGETS = target(*random_grids(2, OBJECTS), random_logits(OBJECTS))


def quick_decode(params, code):
    return jnp.tanh(jnp.tensordot(code, params["kernel"], 1) + params["bias"]) * 3


def of_object(i):
    return jax.tree.map(lambda x: x[i], TARGETS)


def plain(params, code, target):
    return cross_entropy(quick_decode(params, code), target)


@pytest.fixture
def decoded(monkeypatch):
    """The shapes of the codes of every trace of the decoder, now the quick one."""
    shapes = []

    def counting_decode(params, code):
        shapes.append(code.shape)
        return quick_decode(params, code)

    monkeypatch.setattr(module, "decode", counting_decode)
    return shapes


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


def test_losses_under_every_nesting_are_those_of_a_plain_loop(decoded):
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


def test_one_code_under_many_targets_and_many_codes_under_one(decoded):
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


def test_slopes_under_every_nesting_are_those_of_a_plain_loop(decoded):
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


def test_slopes_of_many_candidates_of_many_objects(decoded):
    """Two vmaps over a gradient, as a population of descents would need."""
    slopes = jax.jit(over_objects(over_candidates(jax.grad(objective, argnums=1))))(
        PARAMS, CODES, TARGETS
    )
    np.testing.assert_allclose(slopes, expected_slopes(), rtol=1e-4, atol=1e-7)


def test_the_slope_scales_with_what_comes_after(decoded):
    slope = jax.grad(lambda code: -7 * objective(PARAMS, code, of_object(0)) ** 2)(CODES[0, 0])
    expected = -14 * expected_losses()[0, 0] * expected_slopes()[0, 0]
    np.testing.assert_allclose(slope, expected, rtol=1e-4)


def test_three_levels_of_nesting_and_any_mixture_of_axes(decoded):
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


def test_only_one_part_of_a_target_may_be_batched(decoded):
    one = of_object(0)
    in_axes = (None, 0, Target(occupied=0, empty=None))
    losses = jax.jit(jax.vmap(objective, in_axes=in_axes))(
        PARAMS, CODES[:, 0], Target(TARGETS.occupied, one.empty)
    )
    for i in range(OBJECTS):
        expected = plain(PARAMS, CODES[i, 0], Target(TARGETS.occupied[i], one.empty))
        np.testing.assert_allclose(losses[i], expected, rtol=1e-5)


def test_equal_networks_are_one_and_different_ones_score_nan(decoded):
    scored = jax.jit(jax.vmap(objective, in_axes=(0, None, None)))
    same = jax.tree.map(lambda x: jnp.stack([x, x]), PARAMS)
    expected = plain(PARAMS, CODES[0, 0], of_object(0))
    np.testing.assert_allclose(scored(same, CODES[0, 0], of_object(0)), expected, rtol=1e-5)
    different = jax.tree.map(lambda x: jnp.stack([x, 2 * x]), PARAMS)
    assert np.all(np.isnan(scored(different, CODES[0, 0], of_object(0))))


def test_a_branch_that_vmap_turns_into_a_select_keeps_its_losses(decoded):
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
def test_codes_that_are_not_finite_score_nan_and_cost_nothing(monkeypatch, at_a_time):
    """Only chunks with a finite code are decoded; the others of a chunk score as ever."""
    decoded = []

    def counting_decode(params, code):
        rows = code.size // D
        jax.debug.callback(lambda: decoded.append(rows))
        return jnp.nan_to_num(quick_decode(params, code))  # a decoder that hides what it was given

    monkeypatch.setattr(module, "decode", counting_decode)
    monkeypatch.setattr(module, "CANDIDATES_AT_A_TIME", {"cpu": at_a_time, "default": at_a_time})
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


def equations_inside(jaxpr):
    """Every equation of a program, with those of its inner programs."""
    for equation in jaxpr.eqns:
        yield equation
        for value in equation.params.values():
            for inner in value if isinstance(value, tuple | list) else (value,):
                if isinstance(inner, jex.core.ClosedJaxpr):
                    yield from equations_inside(inner.jaxpr)
                elif isinstance(inner, jex.core.Jaxpr):
                    yield from equations_inside(inner)


def test_nesting_adds_no_call_of_the_decoder(decoded, monkeypatch):
    """All candidates of all objects share the call, one for each kind of device."""
    monkeypatch.setattr(module, "CANDIDATES_AT_A_TIME", {"cpu": 1, "default": CANDIDATES})

    def calls(function, *args):
        jaxpr = jax.make_jaxpr(function)(PARAMS, *args).jaxpr
        return sum(equation.primitive.name == "tanh" for equation in equations_inside(jaxpr))

    assert calls(over_candidates(objective), CODES[0], of_object(0)) == 2
    assert calls(over_objects(objective), CODES[:, 0], TARGETS) == 2
    assert calls(over_objects(over_candidates(objective)), CODES, TARGETS) == 2
    assert calls(over_candidates(over_objects(objective)), CODES.swapaxes(0, 1), TARGETS) == 2


# --- with the real decoder --------------------------------------------------------------------


def test_memory_does_not_grow_with_objects_and_candidates(prior):
    """The largest array of the program is that of one chunk, however many there are."""

    def largest(objects, candidates):
        codes = jax.ShapeDtypeStruct((objects, candidates, 10), jnp.float32)
        grids = jax.ShapeDtypeStruct((objects, 32, 32, 32), jnp.float32)
        nested = over_objects(over_candidates(objective))
        jaxpr = jax.make_jaxpr(nested)(prior.params, codes, Target(grids, grids)).jaxpr
        return max(v.aval.size for eqn in equations_inside(jaxpr) for v in eqn.outvars)

    few, many = largest(4, 256), largest(64, 1024)
    assert few == many < 64 * 1024 * 32**3


def test_a_line_search_over_the_network_can_be_batched(prior):
    """Its branches turn into selects, which copy whatever the network's program holds."""
    keys, codes = jax.random.split(jax.random.key(0), 2), jnp.zeros((2, 10))
    grids = jax.random.bernoulli(jax.random.key(1), 0.3, (2, 2, 32, 32, 32))
    targets = target(*grids, jnp.zeros((2, 32, 32, 32)))
    refiner = build_refiner("gradient:lbfgs", 10, RefineConfig())
    search = partial(refine, refiner=refiner, iterations=2)
    found = jax.eval_shape(search, keys, prior.params, codes, targets)
    assert found.code.shape == codes.shape


@pytest.mark.slow
def test_it_scores_what_the_network_decodes(prior):
    codes = jax.random.normal(jax.random.key(1), (2, 3, 10))
    logits = jax.jit(decode)(prior.params, codes)
    occupied, occluded = jax.random.bernoulli(jax.random.key(2), 0.3, (2, 2, 32, 32, 32))
    targets = target(occupied, occluded, logits[:, 0])
    losses = jax.jit(over_objects(over_candidates(objective)))(prior.params, codes, targets)
    expected = cross_entropy(logits, jax.tree.map(lambda x: x[:, None], targets))
    np.testing.assert_allclose(losses, expected, rtol=1e-5)
    assert np.ptp(losses, axis=1).min() > 1e-3  # the codes do matter
