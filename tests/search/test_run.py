"""The refinement loop: what every search promises over a batch of objects."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from marks import slow

from jaxshape.geometry.grids import Grids
from jaxshape.search.config import RefineConfig
from jaxshape.search.methods import build_refiner
from jaxshape.search.refiner import StopReason
from jaxshape.search.residuals import LESS_FREE, cross_entropy, weigh
from jaxshape.search.run import refine
from jaxshape.search.space import LatentSpace

OBJECTS, D, SHAPE, ITERATIONS = 3, 4, (3, 3, 3), 8
FINAL = 2 * OBJECTS  # codes decoded in the end: the best, and where the search stands
KEYS = jax.random.split(jax.random.key(0), OBJECTS)
CONFIG = RefineConfig(iterations=ITERATIONS, population=6, sigma0=0.3, tolerance=0.0, space="raw")
rng = np.random.default_rng(1)
PARAMS = jnp.asarray(rng.normal(size=(D, *SHAPE)), jnp.float32)  # those of `counted`
CODES = jnp.asarray(rng.normal(size=(OBJECTS, D)), jnp.float32)
TARGETS = weigh(
    Grids(*jnp.asarray(rng.random((2, OBJECTS, *SHAPE)) < 0.5)),
    jnp.tensordot(CODES, PARAMS, 1),
    LESS_FREE,
)
METHODS = [
    "cma",
    "gradient",
    "evosax:SNES",
    "gauss-newton",
    slow("gradient:lbfgs"),
    slow("hybrid:adam"),
]


def searching(prior, method, iterations=ITERATIONS, config=CONFIG, **options):
    refiner = build_refiner(method, D, config)
    options = {"refiner": refiner, "iterations": iterations} | options
    return jax.jit(lambda keys, *args, **more: refine(keys, prior, *args, **options, **more))


def loss_of(code, i, targets=TARGETS):
    one = jax.tree.map(lambda x: x[i], targets)
    return cross_entropy(jnp.tensordot(code, PARAMS, 1), one)


def of_object(i):
    return jax.tree.map(lambda x: x[i : i + 1], TARGETS)


# --- every method -------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=METHODS)
def method(request):
    return request.param


@pytest.fixture(scope="module")
def search(method, counted):
    return searching(counted, method)


@pytest.fixture(scope="module")
def counts(counter):
    """Codes decoded by the search of each method."""
    return {}


@pytest.fixture(scope="module")
def refined(method, search, counter, counts):
    counter.codes()
    found = search(KEYS, CODES, TARGETS)
    counts[method] = counter.codes() - FINAL
    return found


def draws(refined):
    """Whether the search is random."""
    return bool(np.any(np.asarray(refined.trace.spread) > 0))


def test_the_outcome_is_the_best_code_and_never_worse_than_the_first(refined):
    for i in range(OBJECTS):
        assert refined.loss[i] < loss_of(CODES[i], i)
        np.testing.assert_allclose(refined.loss[i], loss_of(refined.code[i], i), rtol=1e-5)
        # Where the search stands at last counts too, though no iteration evaluated it.
        assert refined.loss[i] <= loss_of(refined.state.mean[i], i) * (1 + 1e-6)
    np.testing.assert_allclose(refined.logits, jnp.tensordot(refined.code, PARAMS, 1), atol=1e-5)
    assert np.all(refined.loss <= refined.trace.best_loss[:, -1] * (1 + 1e-6))


def test_the_path_holds_the_best_code_after_each_iteration(refined):
    assert refined.path.shape == (OBJECTS, ITERATIONS, D)
    for i in range(OBJECTS):
        losses = [loss_of(code, i) for code in refined.path[i]]
        np.testing.assert_allclose(losses, refined.trace.best_loss[i], rtol=1e-5)


def test_the_trace_never_rises_and_counts_what_was_decoded(method, refined, counts):
    trace = refined.trace
    assert trace.best_loss.shape == (OBJECTS, ITERATIONS)
    assert np.all(np.diff(trace.best_loss, axis=1) <= 0)
    assert np.all(np.diff(trace.evaluations, axis=1) > 0)
    np.testing.assert_array_equal(refined.iterations, ITERATIONS)
    np.testing.assert_array_equal(refined.stop, StopReason.BUDGET)
    np.testing.assert_array_equal(refined.state.stop, StopReason.RUNNING)  # it could go on
    counted = trace.evaluations[:, -1].sum()
    if method == "gradient:lbfgs":  # in a batch, line searches wait for the longest
        assert counted <= counts[method]
    elif method == "gauss-newton":  # every model takes a decoded code, and D products
        assert counted - counts[method] == D / (1 + D) * (counted - OBJECTS * ITERATIONS)
    else:
        assert counted == counts[method]


def test_a_key_decides_the_outcome_and_a_second_call_traces_nothing(search, refined, counter):
    before = counter.traces
    again = search(KEYS, CODES, TARGETS)
    jax.tree.map(np.testing.assert_array_equal, refined, again)
    other = search(jax.random.split(jax.random.key(7), OBJECTS), CODES, TARGETS)
    if draws(refined):
        assert not np.allclose(refined.code, other.code)
    else:
        np.testing.assert_array_equal(refined.code, other.code)
    assert counter.traces == before > 0


def test_an_object_that_fails_does_not_disturb_the_others(search, refined):
    poisoned = jax.tree.map(lambda x: x.at[1].set(jnp.nan), TARGETS)
    found = search(KEYS, CODES, poisoned)
    for row in (0, 2):
        np.testing.assert_array_equal(found.code[row], refined.code[row])
        np.testing.assert_array_equal(found.loss[row], refined.loss[row])
    np.testing.assert_array_equal(found.code[1], CODES[1])
    assert not np.isfinite(found.loss[1])


def test_equal_objects_search_by_keys_of_their_own(search, refined):
    same = jax.tree.map(lambda x: jnp.stack([x[0]] * OBJECTS), (CODES, TARGETS))
    found = search(KEYS, *same)
    if draws(refined):
        assert not np.allclose(found.code[0], found.code[1])
    np.testing.assert_array_equal(found.code[0], refined.code[0])


@pytest.mark.parametrize("method", ["cma"], indirect=True)
def test_an_object_alone_finds_what_it_finds_in_company(search, refined):
    alone = search(KEYS[1:2], CODES[1:2], of_object(1))
    np.testing.assert_allclose(alone.code[0], refined.code[1], rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(alone.loss[0], refined.loss[1], rtol=1e-4)


def test_a_search_that_was_interrupted_goes_on_as_if_it_had_not_been(method, refined, counted):
    half = searching(counted, method, ITERATIONS // 2)
    first = half(KEYS, CODES, TARGETS)
    found = half(KEYS, CODES, TARGETS, previous=first)
    for name in ("code", "loss", "iterations", "stop", "state"):
        both = getattr(found, name), getattr(refined, name)
        jax.tree.map(np.testing.assert_array_equal, *both)
    halves = jax.tree.map(lambda *x: jnp.concatenate(x, axis=1), first[3:5], found[3:5])
    jax.tree.map(np.testing.assert_array_equal, halves, refined[3:5])  # trace and path


# --- objects that are done ----------------------------------------------------------------------

LONG = 60
# One object three times, so that a loss means the same for all; the keys tell them apart.
SAME_CODES, SAME_TARGETS = jax.tree.map(lambda x: jnp.stack([x[0]] * OBJECTS), (CODES, TARGETS))


@pytest.fixture(scope="module")
def to_goal(counted):
    """A search until its loss is that of the last argument."""
    refiner = build_refiner("cma", D, CONFIG)

    def search(codes, targets, goal, **options):
        return refine(KEYS, counted, codes, targets, refiner, LONG, target_loss=goal, **options)

    return jax.jit(search)


@pytest.fixture(scope="module")
def endless(to_goal):
    return to_goal(SAME_CODES, SAME_TARGETS, -jnp.inf)


def test_an_object_at_its_target_freezes_and_is_no_longer_decoded(
    to_goal, endless, counter, counted
):
    """Up to the first iteration at the target, the search is the one without a target."""
    losses = np.asarray(endless.trace.best_loss)
    goal = float(losses[:, 12].max())
    counter.codes()
    found = to_goal(SAME_CODES, SAME_TARGETS, goal)
    count = counter.codes() - FINAL

    reached = np.argmax(losses <= goal, axis=1) + 1
    assert 1 < reached.min() < reached.max() < LONG
    np.testing.assert_array_equal(found.iterations, reached)
    np.testing.assert_array_equal(found.stop, StopReason.TARGET)
    assert count == np.sum(1 + CONFIG.population * reached)
    for i, last in enumerate(reached):
        best = np.asarray(found.trace.best_loss[i])
        np.testing.assert_array_equal(best[:last], losses[i, :last])
        assert np.all(best[last:] == best[last - 1])
        assert np.all(found.trace.evaluations[i, last - 1 :] == 1 + CONFIG.population * last)
        np.testing.assert_array_equal(found.state.best.loss[i], best[last - 1])


def test_a_first_code_that_is_good_enough_is_the_answer(to_goal, counter, counted):
    counter.codes()
    found = to_goal(CODES, TARGETS, 1e9)
    assert counter.codes() == OBJECTS + FINAL  # the first codes
    np.testing.assert_array_equal(found.iterations, 0)
    np.testing.assert_array_equal(found.stop, StopReason.TARGET)
    np.testing.assert_array_equal(found.code, CODES)


def test_a_search_that_converged_stops_and_costs_no_quality(to_goal, counter, counted):
    full = to_goal(CODES, TARGETS, -jnp.inf)
    counter.codes()
    config = RefineConfig(population=6, sigma0=0.3, tolerance=1e-5)
    found = searching(counted, "cma", 150, config)(KEYS, CODES, TARGETS)
    assert set(np.asarray(found.stop)) <= {StopReason.TOLFUN, StopReason.TOLFUNHIST}
    assert np.all(found.iterations < 150) and np.all(found.iterations > 20)
    assert counter.codes() == np.sum(1 + 6 * found.iterations) + FINAL
    assert np.all(found.loss < full.loss + 1e-4)


@pytest.mark.slow
def test_polishing_counts_towards_the_iterations_of_a_hybrid(counted):
    """CMA-ES stops early, the gradient goes on from there, and stops by its own criterion."""
    config = RefineConfig(population=6, sigma0=0.3, tolerance=1e-5, iterations=150)
    found = searching(counted, "hybrid", 150, config)(KEYS, CODES, TARGETS)
    np.testing.assert_array_equal(found.stop, StopReason.TOLFUNHIST)
    handed_over = found.state.searched[0].generation
    assert np.all(handed_over < 120) and np.all(found.iterations > handed_over)
    assert np.all(found.loss <= found.state.searched[0].best.loss * (1 + 1e-6))


# --- warm starts --------------------------------------------------------------------------------

CHANGED = jax.tree.map(lambda x: x * (1 + 0.1 * jax.random.normal(KEYS[0], x.shape)), SAME_TARGETS)


def test_a_warm_start_keeps_the_distribution_and_scores_it_anew(to_goal, endless):
    before = endless.state
    found = to_goal(CODES, CHANGED, jnp.inf, warm_start=before)  # content with the start
    np.testing.assert_array_equal(found.iterations, 0)
    for name in ("mean", "sigma", "covariance"):
        np.testing.assert_array_equal(getattr(found.state, name), getattr(before, name))
    np.testing.assert_array_equal(found.state.best.point, before.best.point)
    for i in range(OBJECTS):
        loss = loss_of(before.best.point[i], i, CHANGED)
        np.testing.assert_allclose(found.state.best.loss[i], loss, rtol=1e-5)
        assert not np.isclose(loss, before.best.loss[i], rtol=1e-4)


def test_after_a_small_change_a_warm_start_needs_fewer_iterations(to_goal, endless):
    goal = to_goal(SAME_CODES, CHANGED, -jnp.inf).loss.max() + 1e-3
    cold = to_goal(SAME_CODES, CHANGED, goal)
    warm = to_goal(SAME_CODES, CHANGED, goal, warm_start=endless.state)
    np.testing.assert_array_equal(cold.stop, StopReason.TARGET)
    np.testing.assert_array_equal(warm.stop, StopReason.TARGET)
    assert np.all(2 * warm.iterations < cold.iterations)


def test_searches_without_a_resume_begin_again_at_the_best_point(endless, counted):
    """The losses of the first codes say nothing of where the search begins now."""
    best, known = endless.state.best.point, jnp.zeros(OBJECTS)
    again = searching(counted, "evosax:SNES", 1)
    found = again(KEYS, CODES, CHANGED, first_losses=known, warm_start=endless.state)
    np.testing.assert_array_equal(found.state.origin, best)
    for i in range(OBJECTS):
        assert 0 < found.state.best.loss[i] <= loss_of(best[i], i, CHANGED) * (1 + 1e-5)


def test_a_search_at_its_target_goes_on_to_a_lower_one(to_goal, endless):
    first, second = (float(endless.trace.best_loss[:, i].max()) for i in (8, 20))
    near = to_goal(SAME_CODES, SAME_TARGETS, first)
    found = to_goal(SAME_CODES, SAME_TARGETS, second, previous=near)
    unbroken = to_goal(SAME_CODES, SAME_TARGETS, second)
    assert np.all(near.iterations <= unbroken.iterations) and np.any(near.iterations < LONG)
    np.testing.assert_array_equal(found.iterations, unbroken.iterations)
    np.testing.assert_array_equal(found.code, unbroken.code)


def test_going_on_and_beginning_anew_exclude_each_other(counted, endless):
    with pytest.raises(ValueError, match="Both previous and warm_start are given; give previous"):
        searching(counted, "cma")(KEYS, CODES, TARGETS, previous=endless, warm_start=endless.state)


def test_a_callback_hears_of_every_iteration(to_goal, endless):
    heard = []
    goal = float(endless.trace.best_loss[:, 12].max())
    found = to_goal(
        SAME_CODES, SAME_TARGETS, goal, callback=jax.tree_util.Partial(lambda *x: heard.append(x))
    )
    jax.effects_barrier()
    assert len(heard) == found.iterations.max()
    for objects, iterations, trace in heard:
        np.testing.assert_array_equal(objects, range(OBJECTS))
        for i in range(OBJECTS):
            expected = found.trace.best_loss[i, iterations[i] - 1]
            np.testing.assert_array_equal(trace.best_loss[i], expected)
    np.testing.assert_array_equal(heard[-1][1], found.iterations)


# --- spaces and penalties -----------------------------------------------------------------------


def test_a_space_only_changes_the_coordinates(counted):
    """A fixed step in the space u, code = mean + a u, is one of a^2 times its length in codes."""
    space = LatentSpace(jnp.arange(4.0), 2 * jnp.eye(D))
    short = searching(counted, "gradient", config=RefineConfig(step_size=0.1), space=space)
    long = searching(counted, "gradient", config=RefineConfig(step_size=0.4))
    short, long = (search(KEYS, CODES, TARGETS) for search in (short, long))
    np.testing.assert_allclose(short.code, long.code, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(short.loss, long.loss, rtol=1e-4)
    np.testing.assert_allclose(short.state.mean, (long.state.mean - jnp.arange(4.0)) / 2, atol=1e-4)


def test_a_penalty_is_part_of_the_loss(counted):
    def penalty(code):
        return 1e3 * jnp.sum((code - 2) ** 2)

    descent = searching(counted, "gradient", config=RefineConfig(step_size=4e-4), penalty=penalty)
    found = descent(KEYS, CODES, TARGETS)
    np.testing.assert_allclose(found.code, 2, atol=0.01)
    for i in range(OBJECTS):
        expected = loss_of(found.code[i], i) + penalty(found.code[i])
        np.testing.assert_allclose(found.loss[i], expected, rtol=1e-4)


# --- what is given ------------------------------------------------------------------------------


def test_one_key_is_one_for_each_object(counted):
    search = searching(counted, "cma")
    jax.tree.map(
        np.testing.assert_array_equal,
        search(jax.random.key(0), CODES, TARGETS),
        search(KEYS, CODES, TARGETS),
    )


@pytest.mark.parametrize(
    "keys, codes, said",
    [
        (KEYS[:2], CODES, r"keys of shape \(2,\) for 3 objects; give one for each"),
        (jnp.zeros(3, jnp.uint32), CODES, r"keys are uint32 numbers of shape \(3,\); give random"),
        (jnp.zeros((3, 2)), CODES, r"keys are float32 numbers of shape \(3, 2\); give random"),
        (KEYS[:1], CODES[0], r"codes have shape \(4,\); give \[object, 4\].*code\[None\]"),
        (KEYS, CODES[:, :3], r"codes have shape \(3, 3\); give \[object, 4\]"),
    ],
)
def test_keys_and_codes_that_do_not_fit_are_named(unchecked_types, counted, keys, codes, said):
    refiner = build_refiner("cma", D, CONFIG)
    with pytest.raises(ValueError, match=said):
        refine(keys, counted, codes, TARGETS, refiner, 2)


GRADIENT = build_refiner("gradient", D, CONFIG)


def floating(state, trace):
    return state._replace(stop=jnp.float32(state.stop)), trace


@pytest.mark.parametrize(
    "name, change, said",
    [
        ("init", lambda state, trace: state, "init of the search must return a state and a"),
        ("init", lambda state, trace: (state.best, trace), "a NamedTuple with best, mean and stop"),
        ("step", lambda state, trace: (trace, state), "step of the search must return a state and"),
        ("step", floating, r"returned state.stop as float32\[\]; it was int32\[\] before"),
    ],
)
def test_a_search_that_breaks_its_promise_is_told_which(counted, name, change, said):
    function = getattr(GRADIENT, name)
    refiner = GRADIENT._replace(**{name: lambda *given: change(*function(*given))})
    with pytest.raises(ValueError, match=said):
        refine(KEYS, counted, CODES, TARGETS, refiner, 2)


def lost(state, trace):
    """The search has lost its way: its best candidate and its mean are NaN."""
    nothing = jnp.full_like(state.mean, jnp.nan)
    best = state.best._replace(point=nothing, loss=jnp.nan * state.best.loss)
    return state._replace(best=best, mean=nothing), trace


def test_a_search_that_loses_its_best_candidate_gives_the_first_code(counted):
    refiner = GRADIENT._replace(step=lambda *given: lost(*GRADIENT.step(*given)))
    found = refine(KEYS, counted, CODES, TARGETS, refiner, 2)
    np.testing.assert_array_equal(found.code, CODES)
    losses = [loss_of(CODES[i], i) for i in range(OBJECTS)]
    np.testing.assert_allclose(found.loss, losses, rtol=1e-5)


@pytest.mark.parametrize(
    "change, said",
    [
        ({"iterations": 0}, "iterations is 0; give a whole number, 1 or more"),
        ({"precision": "float16"}, "precision is 'float16'; give 'float32' or 'bfloat16'"),
        ({"previous": CODES}, "previous is of type ArrayImpl; give a Refined, as refine makes it"),
        (
            {"targets": of_object(0)},
            r"targets has an array of shape \(1, 3, 3, 3\), but there are 3",
        ),
        (
            {"first_losses": 1.0},
            r"first_losses has an array of shape \(\), but there are 3 objects",
        ),
        ({"targets": None}, r"targets is None; give the targets of all objects, jax.vmap\("),
        ({"penalty_weight": -1.0}, "penalty_weight is -1.0; give a number, 0 or more"),
        ({"target_loss": float("nan")}, "target_loss is nan; give a number"),
        ({"space": "raw"}, "space is of type str; give a LatentSpace, as whitened"),
        ({"penalty": 0.1}, "penalty is 0.1; give a function, or None"),
        ({"callback": "print"}, "callback is 'print'; give a function, or None"),
        ({"penalty": lambda code: code}, r"penalty must return one .* float32 of shape \(4,\)"),
    ],
)
def test_arguments_that_do_not_fit_are_named(unchecked_types, counted, change, said):
    given = {"keys": KEYS, "prior": counted, "codes": CODES, "targets": TARGETS,
             "refiner": GRADIENT, "iterations": 2}  # fmt: skip
    with pytest.raises(ValueError, match=said):
        refine(**given | change)
