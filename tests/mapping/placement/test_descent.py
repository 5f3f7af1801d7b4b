"""Descent from several starts: each as if it were alone, and never worse than it began."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxshape.mapping.placement.descent import descend

STEPS, RISE = 30, 8
UNIT = {"one": jnp.float32(0.1), "many": jnp.full(5, 0.1)}


def bowl(points):
    """Least at 0.3 in every number of a point."""
    rows = jax.vmap(lambda point: sum(jnp.sum((x - 0.3) ** 2) for x in jax.tree.leaves(point)))
    return rows(points)


def starts(count):
    rng = np.random.default_rng(1)
    draw = lambda *shape: jnp.asarray(rng.normal(size=(count, *shape)), jnp.float32)  # noqa: E731
    return {"one": draw(), "many": draw(5)}


def alone(start):
    """The slow reference: Adam on one start, and the lowest misfit that it came by."""
    adam = optax.adam(1.0, b2=0.98)
    loss = lambda moves: bowl(  # noqa: E731
        jax.tree.map(lambda x, u, m: (x + u * m)[None], start, UNIT, moves)
    )[0]
    moves = jax.tree.map(jnp.zeros_like, start)
    state, lowest = adam.init(moves), float(loss(moves))
    for i in range(STEPS):
        step, state = adam.update(jax.grad(loss)(moves), state)
        length = min((i + 1) / RISE, 0.05 + 0.95 * (1 + np.cos(np.pi * i / STEPS)) / 2)
        moves = jax.tree.map(lambda m, s, length=length: m + length * s, moves, step)
        lowest = min(lowest, float(loss(moves)))
    return lowest


def test_each_start_descends_as_if_it_were_alone():
    start = starts(3)
    points, misfits = descend(start, bowl, UNIT, STEPS, RISE)
    np.testing.assert_allclose(bowl(points), misfits, rtol=1e-4)
    assert (misfits < 0.5 * bowl(start)).all()
    expected = [alone(jax.tree.map(lambda x, i=i: x[i], start)) for i in range(3)]
    np.testing.assert_allclose(misfits, expected, rtol=1e-3)


@pytest.mark.parametrize("steps", [0, 1, 4])
def test_no_start_gets_worse_even_by_steps_that_are_far_too_long(steps):
    start = starts(4)
    unit = jax.tree.map(lambda x: 100 * x, UNIT)
    descent = jax.jit(partial(descend, misfits=bowl, unit=unit, rise=1))
    points, misfits = descent(start, steps=jnp.int32(steps))
    assert (misfits <= bowl(start) * 1.00001).all()
    np.testing.assert_allclose(bowl(points), misfits, rtol=1e-5)


def test_a_number_without_unit_stays_and_a_nan_stays_alone():
    start = starts(3)
    start["many"] = start["many"].at[1].set(jnp.nan)
    points, misfits = descend(start, bowl, UNIT | {"one": jnp.float32(0)}, 5, RISE)
    np.testing.assert_array_equal(points["one"], start["one"])
    assert np.isinf(misfits[1]) and np.isfinite(np.delete(misfits, 1)).all()
