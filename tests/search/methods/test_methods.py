"""Searches by name, and a new one from the recipe in docs/extending.md."""

import re
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from marks import slow
from problems import run_batch, sphere

from jaxshape.search.config import RefineConfig
from jaxshape.search.methods import build_refiner
from jaxshape.search.names import families
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
    "name",
    [
        slow("cma:ipop"),
        slow("cma:bipop"),
        "gradient:adam",
        "evosax:Sep_CMA_ES",
        "evosax:xNES",
    ],
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
        (
            "sgd",
            "no method 'sgd'; choose from cma, evosax, gauss-newton, gradient, hybrid, or 'enc",
        ),
        ("", "no method ''; choose from"),
        ("encoder", "'encoder' keeps the first code, but a search is needed here; choose from cma"),
        ("cma:nbipop", "choose cma, cma:ipop or cma:bipop"),
        ("gradient:adamm", "no optimiser 'adamm'"),
        ("hybrid:adamm", "no optimiser 'adamm'"),
        ("gauss-newton:all", "no method 'gauss-newton:all'; give a number .* gauss-newton:3"),
        ("gauss-newton:0", "directions is 0; give a whole number, 1 or more"),
        ("evosax", "choose one of .*SNES"),
        ("evosax:Nelder", "no evosax strategy 'Nelder'; choose one of .*SNES"),
        ("methods.cma", "no method 'methods.cma'"),
    ],
)
def test_unknown_names_say_what_there_is(name, message):
    with pytest.raises(ValueError, match=message):
        build_refiner(name, 3, CONFIG)


# --- searches of other packages -----------------------------------------------------------------

SEARCHES = """
from jaxshape import gradient

def build(variant, dim, config):
    if variant not in (None, "short"):
        raise ValueError(f"There is no {variant}.")
    return gradient(0.05 if variant else 0.25)

def nothing(variant, dim, config):
    return None

def short(dim):
    return None

number = 3
"""


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package of somebody else that can be imported."""
    folder = tmp_path / "their_package"
    folder.mkdir()
    (folder / "searches.py").write_text(SEARCHES)
    (tmp_path / "their_module.py").write_text(SEARCHES)
    (folder / "broken.py").write_text("import nowhere")
    (folder / "unfinished.py").write_text("def build(:")
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    for name in [name for name in sys.modules if name.startswith("their_")]:
        del sys.modules[name]


@pytest.mark.parametrize("module", ["their_package.searches", "their_module"])
@pytest.mark.parametrize("variant, left", [("", 0.5), ("@short", 0.9)])
def test_a_function_goes_by_its_import_path(package, module, variant, left):
    refiner = build_refiner(f"{module}:build{variant}", 3, CONFIG)
    state, _ = refiner.init(KEY, POINTS[0], sphere(POINTS[0]))
    np.testing.assert_allclose(refiner.step(KEY, state, sphere)[0].mean, left * POINTS[0])


def test_an_entry_point_goes_by_its_name_like_a_family(package):
    installed = package / "their_package-1.0.dist-info"
    installed.mkdir()
    (installed / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: their_package\nVersion: 1.0\n"
    )
    (installed / "entry_points.txt").write_text(
        "[jaxshape.methods]\ntheirs = their_package.searches:build\n"
    )
    assert families() == ["cma", "evosax", "gauss-newton", "gradient", "hybrid", "theirs"]
    for name, left in {"theirs": 0.5, "theirs:short": 0.9}.items():
        refiner = build_refiner(name, 3, CONFIG)
        state, _ = refiner.init(KEY, POINTS[0], sphere(POINTS[0]))
        np.testing.assert_allclose(refiner.step(KEY, state, sphere)[0].mean, left * POINTS[0])
    with pytest.raises(ValueError, match="There is no long."):
        build_refiner("theirs:long", 3, CONFIG)


@pytest.mark.parametrize(
    "name, message",
    [
        ("their_package.missing:build", "imported: ModuleNotFoundError: No module .*missing"),
        ("no_package.searches:build", "imported: ModuleNotFoundError: No module .*no_package"),
        ("their_package.broken:build", "imported: ModuleNotFoundError: No module .*nowhere"),
        ("their_package.unfinished:build", "imported: SyntaxError"),
        ("their_package.searches:bild", "their_package.searches has no function 'bild'"),
        ("their_package.searches:number", "their_package.searches has no function 'number'"),
        ("their_package.searches:nothing", "returned NoneType; it must return a jaxshape.Refiner"),
        ("their_package.searches:build@long", "There is no long."),
        ("their_package.searches:short", "short takes other arguments than .variant, dim, config"),
        ("their_package.searches", "no method 'their_package.searches'.* package.module:function"),
    ],
)
def test_what_cannot_be_imported_is_one_sentence(package, name, message):
    with pytest.raises(ValueError, match=message):
        build_refiner(name, 3, CONFIG)


# --- docs/extending.md --------------------------------------------------------------------------


@pytest.fixture
def recipe(package):
    """The example, put where it says it belongs."""
    text = (Path(__file__).parents[3] / "docs" / "extending.md").read_text()
    section = text.split("## A search")[1].split("\n## ")[0]
    (path,) = re.findall(r"`(\w+/\w+\.py)`", section)
    (name,) = re.findall(r"--method\s+([\w.:]+)", section)
    (code,) = re.findall(r"```python\n(.*?)```", section, re.DOTALL)
    file = package / path
    file.parent.mkdir()
    file.write_text(code)
    return name


def test_the_recipe_of_the_page_is_one_file_and_works(recipe):
    states, traces = search(recipe, RefineConfig(population=6, sigma0=0.5))
    assert np.all(states.best.loss < 0.2 * jax.vmap(sphere)(POINTS))
    assert np.all(np.diff(traces.best_loss, axis=1) <= 0)
    assert np.all(traces.evaluations[:, -1] == 1 + 6 * ITERATIONS)
    with pytest.raises(ValueError, match="no variant 'fast'"):
        build_refiner(f"{recipe}@fast", 3, CONFIG)
