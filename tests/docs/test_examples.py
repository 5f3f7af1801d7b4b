"""The examples of docs/examples, in small: each is short and does what it says."""

import ast
import re
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"

INSTEAD = {
    "own_decoder.py": {"CHAIRS, STEPS = 48, 600": "CHAIRS, STEPS = 12, 200"},
    "own_entry.py": {},  # tests/bench runs it
    "own_residual.py": {"1_000_005": "1_000_003", "iterations=60": "iterations=20"},
    "sweep.py": {", 8), 8": ", 8), 2"},
    "own_search.py": {"1_000_005": "1_000_003", ", 24)": ", 6)", "8 * CALLS": "2 * CALLS"},
}
"""Of each example, by what runs in its place."""

NAMES = sorted(INSTEAD)


def source(name: str) -> str:
    return (EXAMPLES / name).read_text()


@pytest.fixture
def answer(tmp_path, monkeypatch, capsys, unchecked_types):
    """Run an example in small, in its folder; returns the numbers that it prints."""

    def answer(name: str, more: dict[str, str] | None = None) -> list[float]:
        code = source(name)
        for said, done in (INSTEAD[name] | (more or {})).items():
            assert said in code, f"{name} no longer says {said!r}"
            code = code.replace(said, done)
        (tmp_path / name).write_text(code)
        monkeypatch.chdir(tmp_path)
        monkeypatch.syspath_prepend(tmp_path)
        exec(compile(code, name, "exec"), {"__name__": "__main__"})
        return [float(x) for x in re.findall(r"\d\.\d+", capsys.readouterr().out)]

    yield answer
    sys.modules.pop("own_search", None)


def test_no_example_is_overlooked():
    assert sorted(path.name for path in EXAMPLES.glob("*.py")) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_an_example_is_short_and_uses_public_names(name):
    text = source(name)
    assert len(text.splitlines()) < 60
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            assert all(not alias.name.startswith("jaxshape.") for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert not (node.module or "").startswith("jaxshape")
        elif isinstance(node, ast.Attribute):
            assert not node.attr.startswith("_")
    assert f"python docs/examples/{name}" in (ast.get_docstring(ast.parse(text)) or "")


@pytest.mark.slow
def test_the_decoder_fits_chairs_that_it_never_saw(answer):
    first, last = answer("own_decoder.py")
    assert 0 < first < last - 0.03


def quick(weights: Path) -> dict[str, str]:
    """Weights that compile at once, in place of the package's."""
    return {"js.load_prior()": f"js.load_prior({str(weights)!r})"}


@pytest.mark.slow
def test_outlines_reach_the_search(answer, linear_weights):
    """With a prior that compiles at once, and knows no chairs: the shapes differ."""
    alone, outlined = answer("own_residual.py", quick(linear_weights) | {":.2f": ":.5f"})
    assert alone != outlined


@pytest.mark.slow
def test_outlines_make_shapes_better(answer):
    alone, outlined = answer("own_residual.py")
    assert outlined > alone


@pytest.mark.slow
def test_a_sweep_finds_settings_that_matter(answer):
    worst, best, *_ = answer("sweep.py")
    assert 0 < worst < best <= 1


def test_a_search_of_ones_own_searches(answer, linear_weights):
    """With a prior that compiles at once, and knows no chairs."""
    own_objective, _, adam_objective, _ = answer("own_search.py", quick(linear_weights))
    assert 0 < own_objective < 3 * adam_objective


@pytest.mark.slow
def test_the_search_goes_as_low_as_adam_does(answer):
    own_objective, own_iou, adam_objective, _ = answer("own_search.py")
    assert own_objective < 1.1 * adam_objective and own_iou > 0.5
