"""An entry: the file that holds the results of one method, and its validation. [host]

    {"format", "set", "sha256", "name", "method", "settings", "budget", "seed",   what was run
     "machines": {key: ...},                                                       where
     "rows": {problem: ...}}                                                       with what result

A row holds the figures of `scoring`, the machine and its load, the number of problems searched
`together`, and the seconds spent `compiling`.
"""

import hashlib
import json
import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxshape import reading
from jaxshape.bench.config import LADDER, LEFT
from jaxshape.bench.machine import describe_machine, load
from jaxshape.bench.problem_set import NAME, SHA256
from jaxshape.bench.problems import Problem, problem_objective
from jaxshape.bench.scoring import Row, targets, unpacked_code
from jaxshape.bench.watching import GRADIENT
from jaxshape.files import write_text
from jaxshape.geometry.overlap import iou
from jaxshape.model.shapes import decode

FORMAT = "jaxshape-bench-entry-1"

PACKAGES = ("jaxshape", "jax", "jaxlib", "numpy", "optax", "evosax", "cma", "nevergrad")

CLOSE = 1e-4
"""Relative difference that is allowed between objectives from different machines."""


_KINDS: dict[str, dict[str, Any]] = {
    "about": {"set": str, "sha256": str, "name": str, "settings": dict, "budget": int, "seed": int},
    "machine": {"processor": str, "cores": int, "device": str, "python": str, "packages": dict},
    "row": {"calls": int, "seconds": (int, float), "stop": str, "code": str},
}
"""Types of what every entry must have; the rows have lists of numbers, too."""


class Entry(NamedTuple):
    """The results of one method, or a part of them.

    Attributes:
        about: The search and its problems: `format`, `set` and `sha256` of the problem set, `name`,
            `method`, `settings`, `budget` in decoder calls, `seed`.
        machines: The machines that rows refer to, by key.
        rows: Results by problem.
    """

    about: dict[str, Any]
    machines: dict[str, dict[str, Any]]
    rows: dict[str, Row]


def new_entry(
    name: str,
    *,
    method: str | None = None,
    settings: dict[str, Any] | None = None,
    budget: int = LADDER[-1],
    seed: int = 0,
) -> Entry:
    """An entry without any rows.

    Args:
        name: Name of the method on the board.
        method: Name by which the search can be built; None for a loop of your own.
        settings: Everything that a reader needs to repeat the search, in types of JSON.
        budget: Decoder calls that each problem could spend.
        seed: Seed of the searches.
    """
    about = {
        "format": FORMAT,
        "set": NAME,
        "sha256": SHA256,
        "name": name,
        "method": method,
        "settings": settings or {},
        "budget": budget,
        "seed": seed,
    }
    return Entry(json.loads(json.dumps(about)), {}, {})


def with_rows(entry: Entry, rows: dict[str, Row]) -> Entry:
    """Add rows that this machine has just made to an entry.

    Args:
        entry: The entry so far.
        rows: Results of problems that were searched together.
    """
    here = describe_machine(PACKAGES)
    key = hashlib.sha256(json.dumps(here, sort_keys=True).encode()).hexdigest()[:8]
    more = {name: row | {"machine": key, "load": load()} for name, row in rows.items()}
    return entry._replace(machines=entry.machines | {key: here}, rows=entry.rows | more)


def write_entry(path: Path, entry: Entry) -> None:
    """Write an entry, with a line for each problem.

    Args:
        path: The file, `.json`.
        entry: The entry.
    """
    head = json.dumps(entry.about | {"machines": entry.machines}, indent=1)[:-2]
    rows = ",\n".join(f"  {json.dumps(k)}: {json.dumps(v)}" for k, v in entry.rows.items())
    write_text(path, f'{head},\n "rows": {{\n{rows}\n }}\n}}\n')


def read_entry(path: Path) -> Entry:
    """Read an entry.

    Args:
        path: The file.

    Raises:
        ValueError: The file is not an entry, or a part of it is missing or of another type.
    """
    try:
        content = reading.read_json_object(path)
        machines, rows = content.pop("machines"), content.pop("rows")
        is_entry = content["format"] == FORMAT
    except (ValueError, KeyError):
        is_entry = False
    if not is_entry:
        raise ValueError(f"{str(path)!r} is not an entry of the benchmark ({FORMAT}).")
    try:
        _require("about", content)
        for machine in machines.values():
            _require("machine", machine)
        require_rows(rows)
    except (ValueError, KeyError, TypeError, AttributeError) as problem:
        raise ValueError(
            f"{str(path)!r} is a damaged entry of the benchmark: a part of it is missing or"
            f" malformed ({problem})."
        ) from problem
    return Entry(content, machines, rows)


def require_rows(rows: dict[str, Row]) -> None:
    """Refuse rows of which a figure is missing, or of another type or shape.

    Args:
        rows: Results by the names of the problems.

    Raises:
        ValueError: A row is none, or lacks a figure.
    """
    for name, row in rows.items():
        try:
            _require_figures(row)
        except (ValueError, KeyError, TypeError, AttributeError) as problem:
            raise ValueError(f"row {name}: {problem}") from problem


def _require_figures(row: Row) -> None:
    _require("row", row)
    for name in ("objective", "iou"):
        reading.numbers_of(row[name], (len(LADDER),))
    reached = reading.numbers_of(row["reached"], (-1, 2))
    if not len(row["reached"]) == len(reached) <= len(LEFT):
        raise ValueError(f"reached is not of pairs, for {len(LEFT)} targets at most")
    if row.get("load") is not None:
        reading.numbers_of(row["load"], ())


def _require(part: str, content: dict[str, Any]) -> None:
    if wrong := reading.wrong_kinds(content, _KINDS[part]):
        raise ValueError(f"{wrong[0]} is {content[wrong[0]]!r:.60}")


def read_entries(paths: Iterable[Path]) -> list[Entry]:
    """Read entries, and merge parts of the same name; parts must agree in everything except rows.

    Args:
        paths: The files.

    Raises:
        ValueError: A file is not an entry, or two files of one name differ in the search, its
            budget or its seed.
    """
    found: dict[str, Entry] = {}
    for path in sorted(paths):
        entry = read_entry(path)
        before = found.get(entry.about["name"], entry)
        if before.about != entry.about:
            differ = [key for key, value in entry.about.items() if before.about.get(key) != value]
            raise ValueError(
                f"{str(path)!r} and another file have results of {entry.about['name']!r}, but"
                f" differ in {', '.join(differ)}; keep them in different folders."
            )
        found[entry.about["name"]] = Entry(
            entry.about, before.machines | entry.machines, entry.rows | before.rows
        )
    return list(found.values())


def file_name(name: str, part: str = "") -> str:
    """The name of the file of an entry, or of its part `i/n`."""
    stem = re.sub(r"[^A-Za-z0-9@=.]+", "_", name).strip("_.") or "entry"
    return f"{stem}{'.part-' + part.replace('/', '-of-') if part else ''}.json"


# ------------------------------------------------------------------ validation


def faults(entry: Entry, problems: Sequence[Problem]) -> list[str]:
    """The faults of an entry, in sentences; empty for a valid entry.

    Objectives and overlaps are computed again from the codes that the entry holds.

    Args:
        entry: The entry.
        problems: The problems of the set.
    """
    about = entry.about
    if (about["set"], about["sha256"]) != (NAME, SHA256):
        return [f"It was made on {about['set']} ({about['sha256'][:8]}), another set of problems."]
    if not (isinstance(about["budget"], int) and 1 <= about["budget"] <= LADDER[-1]):
        return [
            f"Its budget is {about['budget']!r}; 1 to {LADDER[-1]} decoder calls can be compared."
        ]
    known = {one.name: one for one in problems}
    found = [f"There is no problem {name!r}." for name in entry.rows if name not in known]
    for name, row in entry.rows.items():
        if name in known:
            try:
                fault = _fault(row, known[name], about["budget"])
            except (KeyError, TypeError, ValueError, IndexError) as problem:
                fault = f"a figure is missing or malformed ({problem})"
            found += [f"{name}: {fault}."] if fault else []
    return found


def _fault(row: Row, problem: Problem, budget: int) -> str | None:
    """The fault of a row; None for a valid row."""
    objective, ious = np.array(row["objective"], float), np.array(row["iou"], float)
    # The reshape also gives zero pairs for a row that reached no target.
    reached, goals = np.array(row["reached"], float).reshape(-1, 2), np.array(targets(problem))
    if objective.shape != (len(LADDER),) or ious.shape != (len(LADDER),):
        return f"objectives and IoU are not given at the {len(LADDER)} numbers of decoder calls"
    if not (np.isfinite(objective).all() and np.diff(objective).max() <= 0):
        return "the objective of the best code so far rises"
    if not _close(objective[0], float(problem.first_objective)):
        return "it does not start from the first code"
    # The last evaluation may go beyond the budget, though its result does not count: at most a full
    # Gauss-Newton matrix, whose products are counted together.
    if not 0 <= row["calls"] < budget + GRADIENT * (1 + problem.prior.code_size):
        return f"it spent {row['calls']} decoder calls of {budget}"
    calls = reached[:, 0]
    if len(calls) > len(LEFT) or np.diff(reached, axis=0).min(initial=0) < 0:
        return "targets are not reached in the order of their difficulty"
    if calls.max(initial=0) > budget:
        return "a target is reached after the budget was spent"
    at_rungs = np.array([sum(calls <= rung) for rung in LADDER])
    fewest, most = ((objective[:, None] <= goals * (1 + s * CLOSE)).sum(1) for s in (-1, 1))
    if (at_rungs < fewest).any() or (at_rungs > most).any():
        return "the reached targets contradict the objective"
    code = unpacked_code(row["code"])
    again, overlap = _again(problem.decoder, problem.target, jnp.asarray(problem.surface), code)
    if not _close(float(again), objective[-1]):
        return f"its last code has another objective than {objective[-1]:g}"
    if abs(float(overlap) - ious[-1]) > 0.01:
        return f"its last code has another IoU than {ious[-1]:g}"
    return None


@jax.jit
def _again(decoder, target, surface, code):
    """Objective and IoU of a code, computed again."""
    loss = problem_objective(decoder, target)(code)
    return loss, iou(decode(decoder, code) > 0, surface)


def _close(a: float, b: float) -> bool:
    return math.isclose(a, b, rel_tol=CLOSE)
