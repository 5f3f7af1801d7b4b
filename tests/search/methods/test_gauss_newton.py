"""Gauss-Newton steps: closed forms, the matrix itself, damping, and when they end."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import rosenbrock, run, sphere

from jaxshape.model.shapes import decode
from jaxshape.search.curvature import expand
from jaxshape.search.methods.gauss_newton import damped_step, gauss_newton
from jaxshape.search.objective import ObjectTerms, composed, evaluation, objective, prepare_one
from jaxshape.search.refiner import StopReason
from jaxshape.search.residuals import BALANCED, Target
from jaxshape.search.space import LatentSpace

KEY = jax.random.key(0)
rng = np.random.default_rng(0)
D = 10
TARGET = Target(*jnp.asarray(rng.random((2, 32, 32, 32)), jnp.float32))

pytestmark = pytest.mark.usefixtures("compile_quickly")


def test_a_quadratic_is_solved_in_one_step():
    """The first iteration finds the model, the second one goes to its minimum."""
    A, minimum = rng.normal(size=(6, 4)), jnp.arange(4.0)
    refiner = gauss_newton(dim=4, directions=9, damping=1e-7)
    bowl = lambda x: jnp.sum((A @ (x - minimum)) ** 2)  # noqa: E731
    state, trace = run(refiner, bowl, KEY, jnp.full(4, 5.0), 2)
    np.testing.assert_allclose(state.mean, minimum, atol=1e-4)
    np.testing.assert_array_equal(trace.evaluations, [1 + 5, 1 + 5 + 1 + 5])
    np.testing.assert_allclose(trace.loss[0], bowl(jnp.full(4, 5.0)), rtol=1e-6)
    # The curvature that it leaves is that of the quadratic.
    model = state.model
    found = model.directions.T @ model.matrix @ model.directions
    np.testing.assert_allclose(found, 2 * A.T @ A, rtol=1e-3, atol=1e-3)


@pytest.fixture(scope="module")
def about(linear_prior):
    """The objective about a point of a skewed space with a bound, and a dense slow reference."""
    prior, penalty = linear_prior, lambda code: jnp.sum(code**4)
    root = jnp.asarray(np.tril(rng.normal(size=(D, D))) + 3 * np.eye(D), jnp.float32)
    space, point = LatentSpace(jnp.ones(D), root, 1.0), jnp.linspace(-0.95, 0.9, D)
    own = ObjectTerms((), TARGET, jnp.float32(0.01))
    how = evaluation(
        prior.model, prepare_one(prior, None, "float32"), BALANCED, penalty, point, own
    )
    found = jax.jit(lambda: expand(composed(how, space, own), point, D))()

    def both(point):
        code = space.to_code(point)
        return code, decode(prior, code)

    code, logits = both(point)
    J_code, J = (np.asarray(x, np.float64).reshape(-1, D) for x in jax.jacfwd(both)(point))
    p = np.asarray(jax.nn.sigmoid(logits), np.float64).ravel()
    occupied, empty = (np.asarray(x, np.float64).ravel() for x in TARGET)
    H = (occupied + empty) * p * (1 - p) / p.size
    matrix = J.T @ (H[:, None] * J) + J_code.T @ (0.12 * np.asarray(code)[:, None] ** 2 * J_code)
    slope = J.T @ ((occupied + empty) * p - occupied) / p.size
    return found, matrix, slope + J_code.T @ (0.04 * np.asarray(code) ** 3)


def test_as_many_directions_as_numbers_give_the_whole_matrix(about):
    found, matrix, slope = about
    Q = found.directions
    np.testing.assert_allclose(Q @ Q.T, np.eye(D), atol=1e-4)
    np.testing.assert_allclose(found.slope, slope, rtol=1e-3, atol=1e-3 * np.abs(slope).max())
    np.testing.assert_allclose(Q.T @ found.matrix @ Q, matrix, atol=1e-3 * np.abs(matrix).max())
    assert np.linalg.eigvalsh(found.matrix).min() > 0


def test_a_damped_step_solves_the_damped_equations(about):
    found, matrix, slope = about
    step, promised = damped_step(found, 0.1)
    largest = np.linalg.eigvalsh(matrix)[-1]
    expected = -np.linalg.solve(matrix + 0.1 * largest * np.eye(D), slope)
    np.testing.assert_allclose(step, expected, atol=1e-3 * np.abs(expected).max())
    np.testing.assert_allclose(promised, -slope @ step - step @ matrix @ step / 2, rtol=1e-2)


@pytest.mark.slow
def test_the_curvature_of_a_network_is_that_of_its_differences(prior):
    """Its layers have derivatives in reverse only. All of a batch share the calls."""
    codes = jnp.asarray(rng.normal(size=(3, D)), jnp.float32)
    of_one = objective(prior, TARGET)
    batch = jax.jit(jax.vmap(lambda code: expand(of_one, code, 3)))(codes.at[1].set(jnp.nan))
    assert np.all(np.isnan(batch.matrix[1])) and np.all(np.isfinite(batch.matrix[::2]))
    q, code = batch.directions[0], codes[0]
    here, left, right = (
        jax.jit(decode)(prior, x) for x in (code, code - 1e-2 * q, code + 1e-2 * q)
    )
    J = (right - left).reshape(3, -1) / 2e-2
    p = jax.nn.sigmoid(here).ravel()
    H = (TARGET.occupied + TARGET.empty).ravel() * p * (1 - p) / p.size
    expected = (J * H) @ J.T
    np.testing.assert_allclose(batch.matrix[0], expected, atol=0.02 * np.abs(expected).max())
    loss, slope = jax.jit(jax.value_and_grad(of_one))(code)
    np.testing.assert_allclose(batch.loss[0], loss, rtol=1e-5)
    np.testing.assert_allclose(batch.slope[0], slope, rtol=1e-3, atol=1e-6)


def test_few_directions_descend_a_curved_valley_and_negative_curvature_is_no_obstacle():
    state, trace = run(gauss_newton(dim=3, directions=2), rosenbrock, KEY, jnp.zeros(3), 300)
    assert state.best.loss < 1e-6
    assert np.all(np.diff(trace.best_loss) <= 0)
    saddle = lambda x: x[0] ** 2 - x[1] ** 2 + x[1] ** 4  # noqa: E731
    state, _ = run(gauss_newton(dim=2), saddle, KEY, jnp.array([1.0, 0.1]), 60)
    np.testing.assert_allclose(state.best.loss, -0.25, atol=1e-5)


def test_where_the_model_is_wrong_the_damping_grows_and_nothing_else_is_spent():
    wall = lambda x: jnp.where(x[0] > 1.9, sphere(x), jnp.nan)  # noqa: E731
    state, trace = run(gauss_newton(dim=1, damping=0.1), wall, KEY, jnp.array([2.0]), 9)
    spent = np.diff(trace.evaluations)
    assert set(spent.tolist()) == {1, 3} and spent[0] == 1
    assert 1.9 < state.best.point[0] < 2.0 and not np.any(np.isnan(trace.best_loss))


def test_it_ends_where_the_model_promises_too_little():
    start = jnp.array([3.0, -4.0])
    state, _ = run(gauss_newton(dim=2, tolerance=1e-3), sphere, KEY, start, 30)
    assert state.stop == StopReason.TOLFUN and state.evaluations < 20
    assert sphere(state.best.point) < 1e-3
    state, _ = run(gauss_newton(dim=2), sphere, KEY, start, 30)
    assert state.stop == StopReason.RUNNING


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"dim": 0}, "dim is 0; give a whole number, 1 or more"),
        ({"damping": 0.0}, "damping is 0.0; give a number above 0"),
        ({"tolerance": -1.0}, "tolerance is -1.0; give a number, 0 or more"),
    ],
)
def test_bad_settings_say_what_to_do(settings, message):
    with pytest.raises(ValueError, match=message):
        gauss_newton(**{"dim": 3} | settings)
