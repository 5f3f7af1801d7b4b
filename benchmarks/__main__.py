"""The command line: runs benchmarks, draws their tables, compares with the baseline."""

import importlib
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import tyro
from rich.console import Console
from rich.table import Table

from benchmarks import NAMES, gate
from benchmarks.harness import Metric, machine
from jaxshape.files import write_json


@dataclass(frozen=True)
class Options:
    """Measure jaxshape against its rivals."""

    quick: bool = False
    """Fewer sizes and repeats: a few minutes in all."""
    gate: bool = False
    """Exit with status 1 where a metric is worse than its baseline by more than its tolerance."""
    only: tuple[Literal[NAMES], ...] = NAMES  # type: ignore[valid-type]
    """Benchmarks to run."""
    output: Path | None = None
    """Write the results here, as JSON."""
    update_baseline: bool = False
    """Make what was measured the baseline of this kind of machine."""


def main(options: Options, console: Console) -> int:
    """Run the benchmarks; the exit status."""
    here = machine()
    console.print(_describe(here))
    metrics: list[Metric] = []
    for name in options.only:
        start = time.perf_counter()
        found = importlib.import_module(f"benchmarks.{name}").run(options.quick)
        console.print(_results_table(name, found, time.perf_counter() - start))
        metrics += found
    if options.output:
        results = {"machine": here, "quick": options.quick, "metrics": list(map(asdict, metrics))}
        write_json(options.output, results)
    status = _gate(metrics, here, options, console) if options.gate else 0
    if options.update_baseline:
        gate.update(here, metrics)
    return status


def _gate(metrics: list[Metric], here: dict, options: Options, console: Console) -> int:
    baseline = gate.read(gate.kind_of(here))
    then = baseline["machine"]
    if then is None:
        console.print(f"No baseline for {gate.kind_of(here)}; make one with --update-baseline.")
    elif then != here:
        console.print("The baseline is from another machine or other versions:", _describe(then))
    asked = {n: v for n, v in baseline["metrics"].items() if n.split("/")[0] in options.only}
    verdicts = gate.judge(metrics, asked)
    console.print(_gate_table(verdicts))
    failed = sum(v.failed for v in verdicts)
    console.print(f"{failed} of {len(verdicts)} gated metrics are worse than they may be.")
    return int(failed > 0)


def _describe(machine: dict) -> str:
    versions = ", ".join(f"{n} {v}" for n, v in machine["packages"].items() if v)
    return (
        f"{machine['processor']}, {machine['cores']} cores ({', '.join(machine['features'])}); "
        f"device {machine['device']}; Python {machine['python']}; {versions}"
    )


def _results_table(name: str, metrics: list[Metric], seconds: float) -> Table:
    table = Table("metric", "value", "unit", "target", "note", title=f"{name} ({seconds:.0f} s)")
    for column in table.columns[1:4]:
        column.justify, column.no_wrap = "right", True
    for metric in metrics:
        sign = {"higher": "≥", "lower": "≤", "info": ""}[metric.direction]
        target = "" if metric.target is None else f"{sign} {metric.target:g}"
        style = {None: None, True: "green", False: "yellow"}[metric.reached]
        label = metric.name.removeprefix(f"{name}/")
        table.add_row(label, f"{metric.value:.4g}", metric.unit, target, metric.note, style=style)
    return table


def _gate_table(verdicts: list[gate.Verdict]) -> Table:
    table = Table("gated metric", "baseline", "now", "verdict", title="gate")
    styles = {"worse": "bold red", "better": "green", "not measured": "dim", "new": "cyan"}
    for name, value, baseline, status in verdicts:
        show = ["" if x is None else f"{x:.4g}" for x in (baseline, value)]
        table.add_row(name, *show, status, style=styles.get(status))
    return table


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options, prog="python -m benchmarks"), Console()))
