"""`jaxshape bench` as strangers use it, from folders outside the package."""

import sys
from pathlib import Path

import pytest

from jaxshape.bench.entries import faults, read_entry

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"

pytestmark = pytest.mark.usefixtures("compile_quickly", "tiny_benchmark", "unchecked_types")
QUICK = ("--objects", 1, "--frames", 4, "--budget", 64)


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """A folder with the search of docs/examples, where the user stands."""
    (tmp_path / "own_search.py").write_text((EXAMPLES / "own_search.py").read_text())
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    yield tmp_path
    sys.modules.pop("own_search", None)


def test_a_search_of_ones_own_enters_and_is_checked(run, elsewhere, two):
    pytest.importorskip("cma")
    arguments = ("--methods", "own_search:build,pycma", "--output", "board", *QUICK)
    status, out, _ = run("bench", *arguments)
    assert status == 0 and "own_search:build" in out and "pycma" in out
    assert (elsewhere / "board/board.html").is_file() and (elsewhere / "board/board.png").is_file()
    entry = read_entry(elsewhere / "board/own_search_build.json")
    assert faults(entry, two) == []
    # A gradient and eight candidates in each step: 11 calls, and what is left of the budget.
    assert {row["calls"] for row in entry.rows.values()} == {64}
    status, out, _ = run("bench", "--check", "--output", "board")
    assert status == 0 and out.count("valid, 2 of 6 problems") == 2

    file = elsewhere / "board/pycma.json"
    file.write_text(file.read_text().replace('"budget": 64', '"budget": 8'))
    status, out, err = run("bench", "--check", "--output", "board")
    assert status == 2 and "64 decoder calls of 8" in out and "1 of 2 entries" in err


def test_a_loop_of_ones_own_enters(run, elsewhere, two, monkeypatch):
    code = (EXAMPLES / "own_entry.py").read_text()
    for said, done in {"512": "24", '"objects": 8': '"objects": 1'}.items():
        assert said in code
        code = code.replace(said, done)
    monkeypatch.setattr(sys, "argv", ["own_entry.py", "board"])
    exec(compile(code, "own_entry.py", "exec"), {"__name__": "__main__"})
    entry = read_entry(elsewhere / "board/bold_descent.json")
    assert faults(entry, two) == [] and len(entry.rows) == 2
    assert {row["calls"] for row in entry.rows.values()} == {24}
    assert run("bench", "--methods", "", "--output", "board")[0] == 0


@pytest.mark.parametrize(
    "options, told",
    [
        (("--part", "5/4"), "--part is '5/4'; give I/N"),
        (("--part", "8/9"), "No problem is left for this part"),
        (("--frames", "2"), "frames among 1, 4, 8"),
        (("--methods", "nothing"), "There is no method 'nothing'"),
        (("--methods", "nevergrad:No"), "nevergrad"),
        (("--methods", ""), "There are no results"),
        (("--budget", "4000"), "--budget is 4000; give a number from 8 to 2048."),
    ],
)
def test_bad_options_end_in_a_sentence(run, elsewhere, options, told):
    status, _, err = run("bench", *options, "--output", "board")
    assert status == 2 and told in err
