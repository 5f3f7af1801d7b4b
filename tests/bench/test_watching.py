"""Evaluations are counted by the problem, however they are made."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxshape.bench.watching import Observer, evaluates_in_a_branch, watched
from jaxshape.search.config import RefineConfig
from jaxshape.search.methods import build_refiner

D = 3
CENTRES = jnp.array([[1.0, 0, 0], [0, 2.0, 0]])


def objective_of(owner):
    return lambda code: jnp.sum((code - CENTRES[owner]) ** 2)


@pytest.fixture
def observer():
    found = Observer(budget=20)
    found.begin(np.zeros((2, D)), np.array([1.0, 4.0]))
    return found


@pytest.fixture
def loss(observer):
    each = watched(objective_of, observer)
    return lambda code, owner: each(owner)(code)


def test_values_and_gradients_are_those_of_the_objective(loss):
    code = jnp.array([0.5, -1.0, 2.0])
    for owner in jnp.arange(2):
        value, slope = jax.jit(jax.value_and_grad(loss))(code, owner)
        assert value == objective_of(owner)(code)
        np.testing.assert_array_equal(slope, jax.grad(objective_of(owner))(code))


def test_candidates_of_a_nest_of_vmaps_are_counted_once_each(observer, loss):
    points = jax.random.normal(jax.random.key(0), (2, 5, D)).at[1, 2:].set(jnp.nan)
    nest = jax.vmap(jax.vmap(loss, (0, None)))
    losses = jax.jit(nest)(points, jnp.arange(2))
    jax.effects_barrier()
    assert observer.calls == [5, 2]  # what is not finite is not decoded
    for owner, found in enumerate(observer.improvements):
        lowest = np.minimum.accumulate([found[0].loss, *np.nan_to_num(losses[owner], nan=9)])
        assert [one.loss for one in found] == list(dict.fromkeys(lowest.tolist()))


def test_a_gradient_counts_as_three_in_any_loop(observer, loss):
    def step(code, _):
        return code - 0.1 * jax.grad(loss)(code, jnp.int32(1)), None

    jax.lax.scan(step, jnp.zeros(D), length=4)
    jax.effects_barrier()
    assert observer.calls == [0, 12]
    assert [one.calls for one in observer.improvements[1]] == [0, 6, 9, 12]  # the first is no gain


def test_nothing_counts_once_the_budget_is_spent(observer, loss):
    code = jnp.zeros(D)
    for _ in range(9):
        jax.grad(loss)(code, jnp.int32(0))
        jax.effects_barrier()
        code = CENTRES[0] * (observer.calls[0] / 20)
    assert observer.calls[0] == 21 and observer.spent[0]  # the last began within the budget,
    assert observer.improvements[0][-1].calls == 18  # and ended outside
    observer.begin_alone(0)
    assert observer.calls == [0, 0] and len(observer.improvements[0]) == 1


@pytest.mark.parametrize(
    "method, alone", [("cma", False), ("gradient:adam", False), ("gradient:lbfgs", True)]
)
def test_line_searches_are_told(method, alone, loss):
    refiner = build_refiner(method, D, RefineConfig(population=4))
    state, _ = refiner.init(jax.random.key(0), jnp.zeros(D), jnp.float32(1))

    def step(key, state):
        return refiner.step(key, state, lambda code: loss(code, jnp.int32(0)))

    assert evaluates_in_a_branch(step, jax.random.key(0), state) == alone
