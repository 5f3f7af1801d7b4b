"""Comparison of entries: shares of targets reached, and the table of a board. [host]"""

import re
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxshape.bench.config import BUDGETS, GAINS, LADDER, LEFT, SECONDS
from jaxshape.bench.entries import Entry
from jaxshape.bench.scoring import Row

NEAR = next(i for i, left in enumerate(LEFT) if left < 0.0502)
"""Index of the target that leaves a twentieth of the gap."""


class Standing(NamedTuple):
    """An entry, restricted to the problems that all entries have.

    Attributes:
        entry: The entry, with these problems alone.
        calls: Decoder calls at which each target by objective was reached `[problem target]`; +inf
            if it was not reached.
        seconds: Seconds at which each target was reached `[problem target]`; +inf if it was not
            reached.
        gap: Remaining share of the gap between the first and the lowest known objective, at each
            step of `LADDER` `[problem rung]`.
        iou: IoU of the best code so far, at each step of `LADDER` `[problem rung]`.
    """

    entry: Entry
    calls: Float[np.ndarray, "problem target"]
    seconds: Float[np.ndarray, "problem target"]
    gap: Float[np.ndarray, "problem rung"]
    iou: Float[np.ndarray, "problem rung"]

    @property
    def name(self) -> str:
        """Name of the entry."""
        return self.entry.about["name"]

    @property
    def budget(self) -> int:
        """Decoder calls that the entry's searches could spend on each problem."""
        return self.entry.about["budget"]

    def share(self, calls: int | float = np.inf, seconds: int | float = np.inf) -> float:
        """Share of the targets by objective that were reached within a budget.

        Args:
            calls: Decoder calls of each problem.
            seconds: Seconds of each problem.
        """
        reached = np.isfinite(self.calls) & (self.calls <= calls) & (self.seconds <= seconds)
        return float(reached.mean())

    def gains(self, calls: int | float) -> float:
        """Share of the targets by IoU that were reached within some decoder calls.

        Args:
            calls: Decoder calls of each problem.
        """
        within = self.iou[:, np.array(LADDER) <= calls]
        most = (within - self.iou[:, :1]).max(axis=1)
        return float((most[:, None] >= np.array(GAINS)).mean())

    def area(self, calls: int) -> float:
        """Mean share of the targets reached, over the logarithm of decoder calls.

        Args:
            calls: Largest number of decoder calls to include.
        """
        return float(np.mean([self.share(rung) for rung in LADDER[1:] if rung <= calls]))


def shared_problems(entries: Sequence[Entry]) -> list[str]:
    """The problems for which all entries have results."""
    names = set.intersection(*(set(entry.rows) for entry in entries)) if entries else set()
    return [name for name in entries[0].rows if name in names] if entries else []


def standings(entries: Sequence[Entry], best: dict[str, float]) -> list[Standing]:
    """Compare entries on their common problems; the best within the smallest budget comes first.

    Args:
        entries: The entries.
        best: The lowest known objective of each problem.

    Raises:
        ValueError: No problem is common to all.
    """
    names = [name for name in shared_problems(entries) if name in best]
    if not names:
        raise ValueError(
            "No problem has results of all entries, so they cannot be compared; run the"
            " methods on the same problems, or give a folder with fewer entries."
        )
    lowest = np.array([best[name] for name in names])[:, None]
    found = []
    for entry in entries:
        rows = [entry.rows[name] for name in names]
        objective = np.array([row["objective"] for row in rows])
        found.append(
            Standing(
                entry=entry._replace(rows=dict(zip(names, rows, strict=True))),
                calls=_reached(rows, 0),
                seconds=_reached(rows, 1),
                gap=(objective - lowest) / (objective[:, :1] - lowest),
                iou=np.array([row["iou"] for row in rows]),
            )
        )
    least = min(one.budget for one in found)
    return sorted(found, key=lambda one: -one.area(least))


def _reached(rows: Sequence[Row], column: int) -> Float[np.ndarray, "problem target"]:
    """Calls or seconds at each target; +inf where it was not reached."""
    found = np.full((len(rows), len(LEFT)), np.inf)
    for i, row in enumerate(rows):
        found[i, : len(row["reached"])] = [pair[column] for pair in row["reached"]]
    return found


# ------------------------------------------------------------------ the table

COLUMNS = (
    "method",
    *(f"in {calls} calls" for calls in BUDGETS),
    f"in {SECONDS:g} s",
    "calls to 95 %",
    "s to 95 %",
    "IoU",
    "gained",
    "IoU targets",
    "stopped by",
)

ABOUT = (
    f'The columns "in ... calls" and "in {SECONDS:g} s" give the share of targets by objective that'
    " were reached within that many decoder calls, or seconds, on each problem. The targets by"
    f" objective leave {LEFT[0]:.0%} to {LEFT[-1]:.0%} of the gap between the objective of the"
    ' first code and the lowest known one. "Calls to 95 %" and "s to 95 %" are medians over the'
    " problems; a dash means that fewer than half of the problems got so near. IoU is that of the"
    ' best code at the end, and "gained" is its gain over the first code. "IoU targets" is the'
    f" share of the gains of {', '.join(f'{gain:g}' for gain in GAINS)} that were reached at any"
    " time. One gradient counts as three decoder calls."
)


def headings(line_break: str) -> list[str]:
    """The columns with their names on two lines.

    Args:
        line_break: Text between two lines.
    """
    return [re.sub(" (calls|to|targets)", rf"{line_break}\1", column) for column in COLUMNS]


def table(found: Sequence[Standing]) -> list[list[str]]:
    """The cells of a board, a row for each entry."""
    return [_cells(one) for one in found]


def _cells(one: Standing) -> list[str]:
    last = one.iou[:, -1]
    stops = Counter(row["stop"] for row in one.entry.rows.values())
    return [
        one.name,
        *(f"{one.share(calls):.2f}" if calls <= one.budget else "–" for calls in BUDGETS),
        f"{one.share(seconds=SECONDS):.2f}",
        _median(one.calls[:, NEAR], ".0f"),
        _median(one.seconds[:, NEAR], ".2g"),
        f"{last.mean():.3f}",
        f"{(last - one.iou[:, 0]).mean():+.3f}",
        f"{one.gains(LADDER[-1]):.2f}",
        ", ".join(f"{stop} {count}" for stop, count in stops.most_common(3)),
    ]


def _median(values: Float[np.ndarray, " problem"], form: str) -> str:
    middle = np.median(values)
    return f"{middle:{form}}" if np.isfinite(middle) else "–"


def markdown(found: Sequence[Standing]) -> str:
    """The table, as Markdown."""
    rows = [list(COLUMNS), ["---", *["---:"] * (len(COLUMNS) - 2), "---"], *table(found)]
    cells = [[cell.replace("|", "\\|") for cell in row] for row in rows]
    return "\n".join(f"| {' | '.join(row)} |" for row in cells)


def conditions(found: Sequence[Standing]) -> list[str]:
    """Sentences on the machines that made the results, and on the reliability of the seconds."""
    machines = {k: machine for one in found for k, machine in one.entry.machines.items()}
    rows = [row for one in found for row in one.entry.rows.values()]
    loads = [row["load"] for row in rows if row.get("load") is not None]
    said = [
        f"{m['processor']}, {m['cores']} core{'s' * (m['cores'] > 1)}, device {m['device']}, "
        f"Python {m['python']}, "
        + ", ".join(f"{name} {version}" for name, version in m["packages"].items() if version)
        + "."
        for m in machines.values()
    ]
    if len(machines) > 1:
        said.append("Results are from several machines: compare decoder calls, not seconds.")
    if loads and max(loads) > 1.2:
        said.append(
            f"The machine was busy with other work: {np.median(loads):.1f} processes for each core,"
            f" up to {max(loads):.1f}. Seconds are too long, and not to be compared; decoder calls"
            " are exact."
        )
    return said
