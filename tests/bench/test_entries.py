"""Valid entries pass, and each way to be invalid is found; a killed run goes on."""

import copy
from pathlib import Path

import pytest

from jaxshape.bench import entries
from jaxshape.bench.config import BenchConfig
from jaxshape.bench.entries import faults, file_name, read_entries, read_entry, write_entry
from jaxshape.bench.own_loop import Watch, enter_benchmark
from jaxshape.bench.problems import problems
from jaxshape.bench.run import run
from jaxshape.bench.watching import GRADIENT

BOARD = Path(__file__).parents[2] / "benchmarks" / "board"

pytestmark = pytest.mark.usefixtures("compile_quickly")
CONFIG = BenchConfig(budget=64, at_a_time=1)


@pytest.fixture(scope="module")
def ran(two, tmp_path_factory):
    """The folder of a whole run."""
    folder = tmp_path_factory.mktemp("board")
    list(run(["gradient:adam"], two, CONFIG, folder))
    return folder


@pytest.fixture(scope="module")
def entry(ran):
    return read_entry(ran / "gradient_adam.json")


def test_a_run_is_valid_and_says_how_it_was_made(entry, two):
    assert faults(entry, two) == []
    assert entry.about["settings"]["population"] == CONFIG.population
    (machine,) = entry.machines.values()
    assert machine["packages"]["jax"] and {row["together"] for row in entry.rows.values()} == {1}


@pytest.mark.slow
@pytest.mark.parametrize("path", sorted(BOARD.glob("*.json")), ids=lambda path: path.stem)
def test_the_results_on_the_board_are_valid(path):
    entry, known = read_entry(path), problems()
    assert faults(entry, known) == [] and len(entry.rows) == len(known)


def test_the_last_evaluation_may_go_beyond_the_budget(entry, two):
    """It counts as a whole, and its result does not count."""
    one = two[0]

    def said(calls):
        rows = {one.name: entry.rows[one.name] | {"calls": calls}}
        return faults(entry._replace(rows=rows), [one])

    matrix = GRADIENT * (1 + one.prior.code_size)
    assert said(CONFIG.budget + matrix - 1) == []
    assert "decoder calls of 64" in said(CONFIG.budget + matrix)[0]


def test_a_search_that_reached_no_target_is_valid(entry, two):
    one = two[0]
    rows = {one.name: entry.rows[one.name] | {"reached": []}}
    lower = one._replace(best_objective=float(one.first_objective) - 100)  # far below all found
    assert faults(entry._replace(rows=rows), [lower]) == []


def cheated(**changes):
    return lambda row: row.update({k: f(copy.deepcopy(row[k])) for k, f in changes.items()})


@pytest.mark.parametrize(
    "cheat, told",
    [
        (cheated(objective=lambda x: [*x[:-1], x[-1] * 0.9]), "another objective"),
        (cheated(objective=lambda x: [*x[:3], x[0] * 2, *x[4:]]), "rises"),
        (cheated(objective=lambda x: [y * 0.5 for y in x]), "start from the first code"),
        (cheated(objective=lambda x: x[:5]), "are not given at the 10 numbers"),
        (cheated(iou=lambda x: [*x[:-1], 0.9]), "another IoU"),
        (cheated(calls=lambda x: 500), "500 decoder calls of 64"),
        (cheated(reached=lambda x: [[1, 0.0]] * 20), "contradict the objective"),
        (cheated(reached=lambda x: [[70, 0.0]] * 20), "after the budget"),
        (lambda row: row.pop("code"), "is missing"),
    ],
)
def test_every_cheat_is_found(entry, two, cheat, told):
    rows = copy.deepcopy(entry.rows)
    cheat(rows[two[0].name])
    (said,) = faults(entry._replace(rows=rows), two)
    assert two[0].name in said and told in said


def test_results_of_another_set_are_told(entry, two):
    other = entry._replace(about=entry.about | {"sha256": "0" * 64})
    assert "another set" in faults(other, two)[0]
    unknown = entry._replace(rows={"nothing/4/clean": {}})
    assert faults(unknown, two) == ["There is no problem 'nothing/4/clean'."]


def test_a_killed_run_loses_one_batch_and_goes_on(entry, ran, two, tmp_path, monkeypatch):
    begun = run(["gradient:adam"], two, CONFIG, tmp_path)
    assert [next(begun).done, next(begun).done] == [0, 1]
    begun.close()  # killed after the first batch
    searched, with_rows = [], entries.with_rows
    monkeypatch.setattr(
        "jaxshape.bench.run.with_rows", lambda e, r: searched.extend(r) or with_rows(e, r)
    )
    assert [now.done for now in run(["gradient:adam"], two, CONFIG, tmp_path)] == [1, 2]
    assert searched == [two[1].name]
    again = read_entry(tmp_path / "gradient_adam.json")
    for name, row in entry.rows.items():
        assert row["objective"] == again.rows[name]["objective"]


def test_parts_come_to_the_whole(entry, two, tmp_path):
    for i in (0, 1):
        list(run(["gradient:adam"], two[i::2], CONFIG, tmp_path, part=f"{i + 1}/2"))
    files = sorted(path.name for path in tmp_path.glob("*.json"))
    assert files == ["gradient_adam.part-1-of-2.json", "gradient_adam.part-2-of-2.json"]
    (whole,) = read_entries(tmp_path.glob("*.json"))
    assert whole.about == entry.about and set(whole.rows) == set(entry.rows)
    # A whole run in that folder has nothing left to do.
    assert [now.done for now in run(["gradient:adam"], two, CONFIG, tmp_path)] == [2]


def test_results_of_one_name_that_differ_are_refused(entry, ran, two, tmp_path):
    write_entry(tmp_path / "a.json", entry)
    write_entry(tmp_path / "b.json", entry._replace(about=entry.about | {"seed": 1}))
    with pytest.raises(ValueError, match="differ in seed"):
        read_entries(tmp_path.glob("*.json"))
    with pytest.raises(ValueError, match="another budget, seed or"):
        next(run(["gradient:adam"], two, BenchConfig(budget=32), ran))


def test_a_file_that_is_no_entry_is_told(tmp_path):
    for text in ("{}", "[]", "no JSON", '{"format": "jaxshape-bench-entry-1"}'):
        (tmp_path / "x.json").write_text(text)
        with pytest.raises(ValueError, match="is not an entry"):
            read_entry(tmp_path / "x.json")


@pytest.mark.parametrize(
    "damage, told",
    [
        (lambda e: e.about.pop("set"), "set"),
        (lambda e: e.about.update(budget="64"), "budget is '64'"),
        (lambda e: e.machines.update(here={}), "processor"),
        (lambda e: e.rows.update(one=None), "row one"),
        (lambda e: e.rows.update(one=e.rows[next(iter(e.rows))] | {"iou": [None] * 10}), "number"),
        (lambda e: e.rows.update(one=e.rows[next(iter(e.rows))] | {"reached": [[]]}), "pairs"),
    ],
)
def test_a_damaged_entry_is_told(entry, tmp_path, damage, told):
    """Entries come from others, and are drawn before they are checked."""
    damaged = copy.deepcopy(entry)
    damage(damaged)
    write_entry(tmp_path / "x.json", damaged)
    with pytest.raises(ValueError, match=f"x.json' is a damaged entry.*{told}"):
        read_entry(tmp_path / "x.json")


def test_a_file_of_another_method_is_not_written_to(entry, two, tmp_path):
    """Different names may become the same file."""
    other = entry._replace(about=entry.about | {"name": "gradient/adam"})
    write_entry(tmp_path / "gradient_adam.json", other)
    with pytest.raises(ValueError, match="holds results of 'gradient/adam'; rename this file"):
        list(run(["gradient:adam"], two, CONFIG, tmp_path))


def test_names_become_safe_files():
    assert file_name("evosax:Open_ES@18 sigma0=0.2") == "evosax_Open_ES@18_sigma0=0.2.json"
    assert file_name("../../x", "2/3") == "x.part-2-of-3.json"
    assert file_name("///") == "entry.json"


def test_rows_that_contradict_their_budget_are_refused(two, tmp_path):
    """They would appear on the board as the result of a budget that was never spent."""
    watch = Watch(two, 64)
    for rows, said in (({}, "There are no rows"), (watch.rows(), "0 decoder calls, but budget is")):
        with pytest.raises(ValueError, match=said):
            enter_benchmark(tmp_path, "own", rows)
    rows = watch.rows("converged")
    incomplete = {name: {"calls": 3} for name in rows}
    for given, settings, said in (
        (incomplete, {}, "not those of a watch"),
        (rows, {"a": {1}}, "JSON"),
    ):
        with pytest.raises(ValueError, match=said):
            enter_benchmark(tmp_path, "own", given, settings=settings, budget=64)
    path = enter_benchmark(tmp_path, "own", rows, budget=64)
    assert set(read_entry(path).rows) == {one.name for one in two}
