"""Searches by name, and a new one from the recipe in CONTRIBUTING.md."""

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import run_batch, sphere

from jaxshape.search import methods
from jaxshape.search.config import RefineConfig
from jaxshape.search.methods import build_refiner, families
from jaxshape.search.refiner import StopReason

KEY = jax.random.key(0)
POINTS = jnp.stack([jnp.full(3, 2.0), jnp.linspace(-1, 1, 3)])
ITERATIONS = 15
CONFIG = RefineConfig(iterations=ITERATIONS, population=6, sigma0=0.5)

pytestmark = pytest.mark.usefixtures("compile_quickly")


def search(name, config=CONFIG):
    refiner = build_refiner(name, 3, config)
    return jax.jit(lambda: run_batch(refiner, lambda: sphere, KEY, POINTS, ITERATIONS))()


@pytest.mark.parametrize(
    "name", ["cma:ipop", "cma:bipop", "gradient:adam", "evosax:Sep_CMA_ES", "evosax:xNES"]
)  # the other names are those of `test_run.py`
def test_every_name_gives_a_search_that_lowers_the_loss(name):
    states, traces = search(name)
    assert np.all(states.best.loss < 0.6 * jax.vmap(sphere)(POINTS))
    np.testing.assert_array_equal(states.best.loss, traces.best_loss[:, -1])
    assert states.mean.shape == POINTS.shape and set(np.asarray(states.stop)) <= set(StopReason)
    if name != "gradient:adam":  # `population` candidates, `sigma0` apart
        np.testing.assert_array_equal(traces.evaluations[:, 0], 7)
        np.testing.assert_allclose(traces.spread[:, 0], 0.5, rtol=0.5)


@pytest.mark.parametrize(
    "name, message",
    [
        ("sgd", "no method 'sgd'; choose from cma, evosax, gradient, hybrid, or 'encoder'"),
        ("", "no method ''; choose from"),
        ("cma:nbipop", "choose cma, cma:ipop or cma:bipop"),
        ("gradient:adamm", "no optimiser 'adamm'"),
        ("hybrid:adamm", "no optimiser 'adamm'"),
        ("evosax", "choose one of .*SNES"),
        ("evosax:Nelder", "no evosax strategy 'Nelder'; choose one of .*SNES"),
        ("methods.cma", "no method 'methods.cma'"),
    ],
)
def test_unknown_names_say_what_there_is(name, message):
    with pytest.raises(ValueError, match=message):
        build_refiner(name, 3, CONFIG)


# --- CONTRIBUTING.md ----------------------------------------------------------------------------


@pytest.fixture
def recipe(tmp_path, monkeypatch):
    """The example put where it says it belongs, next to the searches of the package."""
    text = (Path(__file__).parents[3] / "CONTRIBUTING.md").read_text()
    section = text.split("## How to add a refiner")[1].split("\n## ")[0]
    (name,) = re.findall(r"jaxshape/search/methods/(\w+)\.py", section)
    (code,) = re.findall(r"```python\n(.*?)```", section, re.DOTALL)
    (tmp_path / f"{name}.py").write_text(code)
    monkeypatch.setattr(methods, "__path__", [*methods.__path__, str(tmp_path)])
    return name


def test_the_recipe_of_contributing_is_one_file_and_works(recipe):
    assert recipe in families()
    states, traces = search(recipe, RefineConfig(population=6, sigma0=0.5))
    assert np.all(states.best.loss < 0.2 * jax.vmap(sphere)(POINTS))
    assert np.all(np.diff(traces.best_loss, axis=1) <= 0)
    assert np.all(traces.evaluations[:, -1] == 1 + 6 * ITERATIONS)
    with pytest.raises(ValueError, match=f"choose {recipe}"):
        build_refiner(f"{recipe}:fast", 3, CONFIG)
