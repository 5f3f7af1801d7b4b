import json
import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks import NAMES, gate
from benchmarks.harness import Metric

POSITIVE = st.floats(1e-3, 1e3)


def verdict(metric, baseline):
    (only,) = gate.judge([metric], baseline)
    return only


@given(POSITIVE, st.floats(0.01, 1), st.sampled_from(["lower", "higher"]))
def test_worse_beyond_the_tolerance_fails_and_anything_better_passes(before, tolerance, direction):
    metric = Metric("a", before, "x", direction, tolerance)
    worse = 1 / (1 + tolerance) if direction == "higher" else 1 + tolerance
    for factor, status in {1: "same", worse * 1.01: "same", worse**1.1: "worse"}.items():
        factor = min(factor, worse**0.99) if status == "same" and worse > 1 else factor
        found = verdict(replace(metric, value=before * factor), {"a": before})
        assert found.failed == (status == "worse"), factor
    assert verdict(replace(metric, value=before / worse**1.1), {"a": before}).status == "better"


def test_a_metric_beyond_its_limit_fails_whatever_the_baseline():
    metric = Metric("error", 2e-3, "", "lower", limit=1e-3)
    assert verdict(metric, {}).failed and verdict(metric, {"error": 5e-3}).failed
    assert not verdict(replace(metric, value=1e-4), {"error": 1e-9}).failed


@pytest.mark.parametrize("direction", ["lower", "higher"])
def test_a_metric_that_is_not_a_number_fails(direction):
    assert verdict(Metric("a", math.nan, "x", direction), {"a": 1.0}).failed


def test_what_is_missing_or_new_is_reported_and_passes():
    ours = Metric("ours", 1.0, "x", "higher")
    verdicts = {v.name: v for v in gate.judge([ours], {"rival": 2.0})}
    assert verdicts["rival"].status == "not measured" and verdicts["ours"].status == "new"
    assert not any(v.failed for v in verdicts.values())


def test_figures_for_the_reader_are_not_gated():
    assert gate.judge([Metric("time", 5.0, "s")], {}) == []


def test_an_update_replaces_what_was_measured_and_keeps_the_rest(tmp_path):
    path, here = tmp_path / "baseline.json", {"device": "cpu", "python": "3.12.1"}
    there = here | {"device": "a gpu"}
    a, b = Metric("a", 1.0, "x", "higher"), Metric("b", 2.0, "x", "lower")
    gate.update(here, [a, b, Metric("time", 3.0, "s")], path)
    gate.update(there, [a], path)
    gate.update(here, [replace(a, value=4.0)], path)
    assert gate.read(gate.kind_of(here), path)["metrics"] == {"a": 4.0, "b": 2.0}
    assert gate.read(gate.kind_of(there), path)["metrics"] == {"a": 1.0}
    assert gate.read("cpu, Python 2.7", path) == {"machine": None, "metrics": {}}


def test_the_committed_baseline_holds_numbers_of_benchmarks_that_exist():
    for stored in json.loads(gate.BASELINE.read_text()).values():
        assert stored["machine"]["processor"]
        for name, value in stored["metrics"].items():
            assert name.split("/")[0] in NAMES and math.isfinite(value)
