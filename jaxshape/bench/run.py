"""Run methods on all problems, a batch at a time; a killed run loses at most one batch. [host]"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from jaxshape.bench.config import BenchConfig
from jaxshape.bench.contest import Contestant, contestant
from jaxshape.bench.entries import (
    Entry,
    file_name,
    new_entry,
    read_entries,
    read_entry,
    with_rows,
    write_entry,
)
from jaxshape.bench.problems import Problem
from jaxshape.bench.scoring import Row, rows_of


class BenchProgress(NamedTuple):
    """Progress of a run.

    Attributes:
        name: Name of the entry that is being made.
        done: Requested problems with results.
        total: Problems that were asked for.
    """

    name: str
    done: int
    total: int


def run(
    methods: Sequence[str],
    problems: Sequence[Problem],
    config: BenchConfig,
    folder: Path,
    *,
    part: str = "",
) -> Iterator[BenchProgress]:
    """Run methods on problems, and write an entry for each.

    Problems with results in any part in the folder are not searched again.

    Args:
        methods: Names of the searches.
        problems: The problems.
        config: Settings of the searches.
        folder: Folder of the entries.
        part: Which part of all problems these are, `i/n`, for the names of the files; empty for
            all.

    Yields:
        The progress, for each method at its start and after each batch.

    Raises:
        ValueError: There is no problem, the method is unknown, or the folder holds results of the
            same method with other settings, or of another method in the file of this one.
    """
    if not problems:
        raise ValueError(
            "No problem is left for this part; choose more problems, or divide them into fewer"
            " parts."
        )
    settings = config.search()
    searches = {one: contestant(one, problems[0], settings, config.budget) for one in methods}
    for method, (search, alone) in searches.items():
        name = config.name_of(method)
        entry = new_entry(
            name,
            method=method,
            settings=config.of_search(),
            budget=config.budget,
            seed=config.seed,
        )
        path = folder / file_name(name, part)
        done = _rows_in(folder, entry)
        before = read_entry(path) if path.exists() else entry
        if before.about != entry.about:
            raise ValueError(
                f"{str(path)!r} holds results of {before.about['name']!r}; rename this file to add"
                f" those of {name!r}."
            )
        entry = before
        left = [one for one in problems if one.name not in done]
        yield BenchProgress(name, len(problems) - len(left), len(problems))
        size = 1 if alone else min(config.at_a_time, max(1, len(left)))
        for start in range(0, len(left), size):
            batch = left[start : start + size]
            filled = [batch[i % len(batch)] for i in range(size)]  # one size, one compiled program
            entry = with_rows(entry, _searched(search, filled, config))
            write_entry(path, entry)
            done |= {one.name for one in batch}
            yield BenchProgress(name, sum(one.name in done for one in problems), len(problems))


def _searched(search: Contestant, batch: Sequence[Problem], config: BenchConfig) -> dict[str, Row]:
    """The rows of problems that are searched together."""
    found = search(batch, config.seed)
    rows = rows_of(batch, found.observer, found.stops)
    more = {"together": len(batch), "compiling": float(f"{found.compiling:.3g}")}
    return {name: row | more for name, row in rows.items()}


def _rows_in(folder: Path, entry: Entry) -> set[str]:
    """Problems for which a folder has results, in all parts of an entry."""
    name = entry.about["name"]
    found = [x for x in read_entries(folder.glob("*.json")) if x.about["name"] == name]
    if found and found[0].about != entry.about:
        raise ValueError(
            f"{str(folder)!r} holds results of {name!r} with another budget, seed or"
            " set of problems; give another folder."
        )
    return set(found[0].rows) if found else set()
