"""Common code of all experiments: settings, choice of objects, and rows that are made once."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from jaxshape.data.meshes import MeshSource, list_meshes
from jaxshape.results.journal import Journal

RESULTS = Path(__file__).parent / "results"
TABLES = Path(__file__).parent / "weights" / "table.safetensors"
"""Weights for tables."""


@dataclass(frozen=True)
class Config:
    """Settings that all experiments share."""

    results: Path = RESULTS
    """Folder of the results."""
    smoke: bool = False
    """A test run with few objects and iterations."""

    def reduced(self, **few: Any) -> Self:
        """The settings of the run: with these small settings in a test run."""
        return replace(self, **few) if self.smoke else self

    def journal(self, name: str, **settings: Any) -> Journal:
        """The rows that earlier runs with the same settings have left in a results file."""
        return Journal(self.results / f"{name}.json", settings)


@dataclass(frozen=True)
class SeatsConfig(Config):
    """Settings of experiments on CAD seats."""

    meshes: Path = Path("cad_chairs")
    """Folder of the CAD seats, as experiments/cad_seats.py writes it."""
    seats: int = 78
    """Number of seats, spread over all seats."""

    def chosen(self) -> list[MeshSource]:
        """The seats."""
        sources = list_meshes(self.meshes)
        return [sources[i] for i in spread(len(sources), self.seats)]


def spread(available: int, count: int) -> list[int]:
    """Indices of `count` objects, spread over all available ones; all if there are not more."""
    return np.linspace(0, available - 1, min(count, available)).round().astype(int).tolist()


def complete(
    journal: Journal,
    tasks: Mapping[str, Callable[[], Any]],
    findings: Callable[[dict[str, Any]], dict[str, Any]],
    describe: Callable[[Any], str] = str,
) -> None:
    """Make the rows that are missing, one by one, and write each with the findings so far.

    Args:
        journal: The rows of this run and of earlier ones.
        tasks: A function for each row, by name.
        findings: What to write before the rows, from all rows.
        describe: The line that is printed for a row.
    """
    for name, task in tasks.items():
        if name not in journal.rows:
            began = time.perf_counter()
            journal.add({name: task()}, time.perf_counter() - began)
            print(name, describe(journal.rows[name]), flush=True)
    journal.write(findings(journal.rows))
