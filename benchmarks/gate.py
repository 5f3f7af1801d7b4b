"""Has anything become worse? Metrics against the committed `baseline.json`.

The file holds one baseline per kind of machine, `cpu, Python 3.12` and its like, because rivals
stand differently against us on each.
"""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal, NamedTuple

from benchmarks.harness import Metric, within
from jaxshape.files import write_json

BASELINE = Path(__file__).with_name("baseline.json")


class Verdict(NamedTuple):
    """What became of one metric."""

    name: str
    value: float | None
    baseline: float | None
    status: Literal["worse", "same", "better", "new", "not measured"]

    @property
    def failed(self) -> bool:
        return self.status == "worse"


def judge(metrics: Iterable[Metric], baseline: dict[str, float]) -> list[Verdict]:
    """One verdict for each gated metric, measured now or in the baseline.

    A metric fails when it is worse than the baseline by more than its tolerance, or beyond its
    limit. One that is in the baseline but was not measured, for want of a rival, is reported only.
    """
    gated = {m.name: m for m in metrics if m.direction != "info"}
    verdicts = [
        Verdict(n, m.value, baseline.get(n), _status(m, baseline)) for n, m in gated.items()
    ]
    absent = (name for name in baseline if name not in gated)
    return verdicts + [Verdict(name, None, baseline[name], "not measured") for name in absent]


def _status(metric: Metric, baseline: dict[str, float]):
    if metric.limit is not None and not within(metric, metric.limit):
        return "worse"
    if metric.name not in baseline:
        return "new"
    if metric.limit is not None:
        return "same"
    # A factor, not a difference, so that a ratio and its inverse have the same room.
    room, before = 1 + metric.tolerance, baseline[metric.name]
    loosest, tightest = (
        (before / room, before * room) if metric.direction == "higher" else
        (before * room, before / room)
    )  # fmt: skip
    if not within(metric, loosest):
        return "worse"
    return "better" if within(metric, tightest) else "same"


def kind_of(machine: dict[str, Any]) -> str:
    """The machines that share a baseline."""
    return f"{machine['device']}, Python {'.'.join(machine['python'].split('.')[:2])}"


def read(kind: str, path: Path = BASELINE) -> dict[str, Any]:
    """The baseline of a kind of machine, its `machine` and `metrics`; empty where there is none."""
    stored = json.loads(path.read_text()) if path.exists() else {}
    return stored.get(kind, {"machine": None, "metrics": {}})


def update(machine: dict[str, Any], metrics: Iterable[Metric], path: Path = BASELINE) -> None:
    """Replace what was measured now in the baseline of this kind of machine; keep the rest."""
    stored = json.loads(path.read_text()) if path.exists() else {}
    old = stored.get(kind_of(machine), {}).get("metrics", {})
    new = {m.name: float(f"{m.value:.4g}") for m in metrics if m.direction != "info"}
    stored[kind_of(machine)] = {"machine": machine, "metrics": old | new}
    write_json(path, stored)
