"""The comparison on COCO: what is recorded, and what is made of it."""

import json

import jax
import numpy as np
import pytest

pytest.importorskip("cocoex")
pytest.importorskip("cma")

from benchmarks import coco  # noqa: E402

BUDGET = 150


class Listed:
    """A problem whose values are given, and that keeps the points it was asked."""

    def __init__(self, problem, values=None):
        self.problem, self.values, self.points = problem, values, []

    def __call__(self, point):
        self.points.append(tuple(point))
        return self.problem(point) if self.values is None else self.values[len(self.points) - 1]

    def __getattr__(self, name):
        return getattr(self.problem, name)


@pytest.fixture(scope="module", autouse=True)
def float64():
    # For all threads, as those of callbacks do not see the context manager.
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", False)


@pytest.fixture(scope="module")
def options(tmp_path_factory):
    work = tmp_path_factory.mktemp("coco")
    return coco.Options(dimensions="2", functions="1,8", budget=BUDGET, work=work)


@pytest.fixture(scope="module")
def recorders():
    """Of both algorithms in turns, for one function after the other."""
    return []


@pytest.fixture(scope="module")
def results(options, recorders):
    plain = coco.instances

    def listed(*which):
        recorders.append(plain(*which))
        for recorder in recorders[-1]:
            recorder.problem = Listed(recorder.problem)
        return recorders[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(coco, "instances", listed)
        return coco.run(options)


def test_runtimes_are_monotone_and_within_the_budget(results):
    assert set(results["2"]) == {"budget", *coco.ALGORITHMS}
    for algorithm in coco.ALGORITHMS:
        assert set(results["2"][algorithm]) == {"1", "8"}
        for instances in results["2"][algorithm].values():
            assert len(instances) == coco.INSTANCES
            for reached in instances:
                assert 0 < len(reached) <= len(coco.TARGETS)
                assert reached == sorted(reached) and 1 <= reached[0]
                assert reached[-1] <= 2 * BUDGET


def test_both_search_the_sphere_equally_well(results):
    spent = {
        a: coco.expected_evaluations(coco.runtimes(results, a, ["2"], [1]), BUDGET)
        for a in coco.ALGORITHMS
    }
    shared = np.isfinite(spent["ours"]) & np.isfinite(spent["pycma"])
    assert shared[:30].all()
    assert 0.7 < np.exp(np.mean(np.log(spent["ours"] / spent["pycma"])[:30])) < 1.4


def test_a_second_run_measures_nothing(options, results, monkeypatch):
    monkeypatch.setattr(coco, "_measure", None)
    assert coco.run(options) == results


def test_areas_lie_between_0_and_1(results):
    for algorithm in coco.ALGORITHMS:
        assert 0 < coco.ecdf_area(coco.runtimes(results, algorithm, ["2"], [1, 8]), BUDGET) < 1
    assert coco.ecdf_area(np.full((3, 51), np.inf), BUDGET) == 0
    assert coco.ecdf_area(np.full((3, 51), 0.5), BUDGET) == 1


def test_area_is_that_under_the_curve(results):
    times = coco.runtimes(results, "ours", ["2"], [1, 8])
    x = np.linspace(0, np.log10(BUDGET), 20_001)
    curve = np.array([(times <= limit).mean() for limit in 10 ** x[::10]])
    assert coco.ecdf_area(times, BUDGET) == pytest.approx(curve.mean(), abs=1e-3)


def test_stored_results_keep_other_dimensions(results, tmp_path):
    coco.store(results, tmp_path, "coco")
    both = coco.store({"3": results["2"]}, tmp_path, "coco")
    assert list(both) == ["2", "3"]
    assert json.loads((tmp_path / "coco.json").read_text()) == both
    assert "| f8 |" in (tmp_path / "coco.md").read_text()
    assert {file.suffix for file in tmp_path.iterdir()} == {".json", ".md", ".png", ".svg"}


def test_recorder_notes_the_first_evaluation_at_each_target():
    recorder = coco.instances(1, 2, budget=4)[0]
    values = [500, 0.5, 3, 2e-3, 2e-2, 2e-9, 0, 0]
    recorder.problem = Listed(recorder.problem, recorder.lowest + np.array(values))
    with pytest.raises(coco.Finished):
        for _ in values:
            recorder(np.zeros(2))
    found = values[:6]  # solved by the sixth
    slow = [next(i for i, v in enumerate(found, 1) if v <= t) for t in coco.TARGETS]
    assert recorder.runtimes == slow
    assert recorder.solved and recorder.evaluations == 6


def test_every_candidate_is_evaluated_once_and_the_start_is_shared(results, recorders):
    for ours, theirs in (recorders[:2], recorders[2:]):
        for pair in zip(ours, theirs, strict=True):
            for recorder in pair:
                assert recorder.solved or recorder.evaluations == 2 * BUDGET
                assert len(set(recorder.problem.points)) == recorder.evaluations
            means = [np.mean(recorder.problem.points[:6], axis=0) for recorder in pair]
            assert np.linalg.norm(means[0] - means[1]) < 5 * coco.SIGMA0 * np.sqrt(2 / 6)


def test_violations_are_functions_solved_a_third_less():
    def solved(counts):
        whole, none = list(range(1, 52)), []
        return {str(f): [whole] * n + [none] * (15 - n) for f, n in counts.items()}

    results = {
        "2": {
            "budget": 100,
            "ours": solved({1: 10, 2: 11, 3: 0, 4: 0}),
            "pycma": solved({1: 15, 2: 15, 3: 1, 4: 0}),
        }
    }
    assert [line.split()[0] for line in coco.violations(results)] == ["f1", "f3"]
