"""Parts that all commands share: the console, progress bars, and the refusal of bad input."""

from collections.abc import Iterable, Sequence
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

console = Console(stderr=True)
"""Console for progress, warnings and errors; the results of a command go to standard output."""


class BadInput(ValueError):
    """An option cannot be used."""


def require(condition: bool, sentence: str) -> None:
    if not condition:
        raise BadInput(sentence)


def warn(sentence: str) -> None:
    """Print a warning."""
    console.print(f"[yellow]warning[/] {escape(sentence)}", highlight=False, soft_wrap=True)


def progress_bar(unit: str) -> Progress:
    """A progress bar with counts, the time left, and a note."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn(unit),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
        console=console,
    )


NAMED = 3
"""Number of meshes that are named for each reason."""


def report_skipped(skipped: Iterable[Any]) -> None:
    """Print the number of meshes (`Skipped`) left out for each reason, with the first names."""
    reasons: dict[str, list[Any]] = {}
    for one in skipped:
        reasons.setdefault(one.reason, []).append(one)
    for reason, those in sorted(reasons.items(), key=lambda entry: -len(entry[1])):
        _report("skipped", f"{len(those)} {reason}", [one.name for one in those], those[0].detail)


def report_notes(notes: Iterable[tuple[str, str]]) -> None:
    """Print notes on parts of files that are not the object, from pairs of mesh name and note."""
    kinds: dict[str, list[tuple[str, str]]] = {}
    for name, note in notes:
        kinds.setdefault(note.partition(" left out")[0], []).append((name, note))
    for kind, those in kinds.items():
        of = f"{kind} of {len(those)} meshes"
        _report("left out", of, [name for name, _ in those], those[0][1])


def named(names: Sequence[str]) -> str:
    """The first of some names, and how many more there are."""
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + more


def _report(what: str, which: str, names: list[str], example: str) -> None:
    first = f"{names[0]}: " if len(names) > 1 else ""
    text = escape(f"{which}: {named(names)}. {first}{example}")
    console.print(f"[yellow]{what}[/] {text}", highlight=False, soft_wrap=True)
