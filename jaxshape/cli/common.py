"""Parts that all commands share: the console, progress, and the refusal of bad input."""

from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

console = Console(stderr=True)
"""Progress, warnings and errors; what a command answers goes to standard output."""


class BadInput(ValueError):
    """An option cannot be used."""


def require(condition: bool, sentence: str) -> None:
    if not condition:
        raise BadInput(sentence)


def warn(sentence: str) -> None:
    """Print a warning."""
    console.print(f"[yellow]warning[/] {escape(sentence)}", highlight=False, soft_wrap=True)


def progress_bar(unit: str) -> Progress:
    """A bar with counts, the time left, and a free text."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn(unit),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
        console=console,
    )


def report_skipped(skipped: Any) -> None:
    """Say which meshes (`Skipped`) are left out, and why."""
    for one in skipped:
        console.print(f"[yellow]skipped[/] {escape(one.name)}: {one.reason}. {escape(one.detail)}")
