"""Test functions with their minimum 0, and the loop that every refiner test runs."""

import jax
import jax.numpy as jnp


def sphere(x):
    return jnp.sum(x**2)


def ellipsoid(x):
    """Condition number 1e4."""
    return jnp.sum(jnp.logspace(0, 4, len(x)) * x**2)


def rosenbrock(x):
    return jnp.sum(100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2)


def rastrigin(x):
    return jnp.sum(x**2 + 10 * (1 - jnp.cos(2 * jnp.pi * x)))


def run(refiner, objective, key, code, iterations):
    """One search over one code: the final state, and the trace over the iterations."""

    def body(state, key):
        return refiner.step(key, state, objective)

    init_key, loop_key = jax.random.split(key)
    state = refiner.init(init_key, code, objective(code))
    return jax.lax.scan(body, state, jax.random.split(loop_key, iterations))


def run_batch(refiner, objective_of, key, codes, iterations, *data):
    """Searches over a batch of codes, the objective of each closing over its row of `data`."""

    def one(key, code, *row):
        return run(refiner, objective_of(*row), key, code, iterations)

    return jax.vmap(one)(jax.random.split(key, len(codes)), codes, *data)
