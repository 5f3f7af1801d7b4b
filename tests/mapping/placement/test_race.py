"""Descent from several starts: each as if it were alone, most steps for the finalists."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxshape.mapping.placement.race import HEAT, race

STEPS = 40
LEAST = 0.3


def bowl(points, those):
    """Least at 0.3 in every number of a point, and higher for some starts than for others."""
    del those
    rows = jax.vmap(lambda point: sum(jnp.sum((x - LEAST) ** 2) for x in jax.tree.leaves(point)))
    return rows(points)


def starts(count):
    rng = np.random.default_rng(1)
    draw = lambda *shape: jnp.asarray(rng.normal(size=(count, *shape)), jnp.float32)  # noqa: E731
    return {"one": draw(), "many": draw(5)}


UNIT = {"one": jnp.float32(0.1), "many": jnp.full(5, 0.1)}


def best_two(points, misfits):
    del points
    return jnp.argsort(misfits)[:2]


def alone(start, steps_of_schedule, steps):
    """The slow reference: Adam on one start, and the best point that it came by."""
    adam = optax.adam(1.0, b2=0.98)
    loss = lambda moves: bowl(  # noqa: E731
        jax.tree.map(lambda x, u, m: (x + u * m)[None], start, UNIT, moves), None
    )[0]
    moves = jax.tree.map(jnp.zeros_like, start)
    state, lowest = adam.init(moves), float(loss(moves))
    for i in range(steps):
        step, state = adam.update(jax.grad(loss)(moves), state)
        slower = 0.05 + 0.95 * (1 + np.cos(np.pi * i / steps_of_schedule)) / 2
        length = min((i + 1) / 8, slower)
        moves = jax.tree.map(lambda m, s, length=length: m + length * s, moves, step)
        lowest = min(lowest, float(loss(moves)))
    return lowest


@pytest.mark.parametrize("count", [2, 5, 6])
def test_finalists_take_all_steps_and_the_others_a_fifth_each_as_if_alone(count):
    start = starts(count)
    points, misfits = race(start, bowl, UNIT, STEPS, best_two)
    np.testing.assert_allclose(bowl(points, None), misfits, rtol=1e-4)
    heat = STEPS // HEAT
    one = lambda i: jax.tree.map(lambda x: x[i], start)  # noqa: E731
    # The point that the last step of a heat leads to is looked at in the final only.
    early = [alone(one(i), STEPS, heat - 1) for i in range(count)]
    finalists = set(np.argsort(early)[:2].tolist())
    for i in range(count):
        expected = alone(one(i), STEPS, STEPS) if i in finalists else early[i]
        np.testing.assert_allclose(misfits[i], expected, rtol=1e-3, atol=1e-5)


def test_the_finalists_are_those_chosen_after_the_heats():
    """Chosen once, from the misfits at that time; here the two worst."""
    worst_two = lambda points, misfits: jnp.argsort(-misfits)[:2]  # noqa: E731
    _, before = race(starts(6), bowl, UNIT, STEPS, best_two)
    _, after = race(starts(6), bowl, UNIT, STEPS, worst_two)
    improved = np.asarray(after) < np.asarray(before) - 1e-6
    assert improved.sum() == 2 and not improved[np.argmin(before)]


@pytest.mark.parametrize("steps", [0, 1, 4])
def test_few_steps_lose_nothing(steps):
    start = starts(4)
    _, misfits = jax.jit(partial(race, misfits=bowl, unit=UNIT, choose=best_two))(
        start, steps=jnp.int32(steps)
    )
    reached = np.isfinite(misfits)
    assert reached.sum() >= 2
    assert (np.asarray(misfits) <= np.asarray(bowl(start, None)) + 1e-6)[reached].all()


def test_a_number_without_unit_stays_and_a_nan_stays_alone():
    start = starts(4)
    start["many"] = start["many"].at[1].set(jnp.nan)
    unit = UNIT | {"one": jnp.float32(0)}
    points, misfits = race(start, bowl, unit, 10, best_two)
    np.testing.assert_array_equal(points["one"], start["one"])
    assert np.isinf(misfits[1]) and np.isfinite(np.delete(misfits, 1)).all()
