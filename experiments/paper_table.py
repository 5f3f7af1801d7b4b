r"""The table of the paper's claims in docs/paper.md, written from the results files alone.

    python experiments/paper_table.py

Every script of `SCRIPTS` writes its claims, with the figures found here, to its results file. This
script puts them into docs/paper.md, between the two comments that name it. `--check` only compares
the page with the files.
"""

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from jaxshape.files import write_text

ROOT = Path(__file__).parents[1]
BEGIN, END = "<!-- paper_table.py writes this -->\n", "<!-- until here -->\n"
SCRIPTS = (
    "convergence",
    "step_size",
    "iou_by_frames",
    "voluminous",
    "gallery",
    "gradient_failures",
    "real_chair",
    "equal_budget",
    "objective",
)


@dataclass(frozen=True)
class Config:
    """Settings of the table."""

    results: Path = ROOT / "experiments" / "results"
    page: Path = ROOT / "docs" / "paper.md"
    check: bool = False
    """Change nothing; exit with 1 if the page differs from the files."""


def main(config: Config) -> None:
    text = config.page.read_text()
    if BEGIN not in text or END not in text:
        sys.exit(f"{config.page} has no lines {BEGIN.strip()!r} and {END.strip()!r} to fill.")
    before, rest = text.split(BEGIN)
    _, after = rest.split(END)
    written = before + BEGIN + table(config.results) + END + after
    if config.check:
        sys.exit(written != text and "The table of the page is not that of the results files.")
    write_text(config.page, written)


def table(results: Path) -> str:
    """A row for each claim: the paper's claim, our finding, the command and its time."""
    lines = [
        "| figure | claim (`beyond`: ours) | holds? | found here | script, time |",
        "|---|---|---|---|---|",
    ]
    for name in SCRIPTS:
        path = results / f"{name}.json"
        if path.is_file():
            found = json.loads(path.read_text())
            lines += [_row(name, found, claim) for claim in found["claims"]]
    return "\n".join(lines) + "\n"


def _row(name: str, found: dict[str, Any], claim: dict[str, str]) -> str:
    chairs = sum("group" in row for row in found["rows"].values())
    cost = [f"{chairs} chairs"] * (chairs > 0) + [f"{max(1, round(found['seconds'] / 60))} min"]
    command = ", ".join([f"`{name}.py`", *cost])
    cells = (claim["figure"], claim["claim"], claim["holds"], claim["ours"], command)
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


if __name__ == "__main__":
    main(tyro.cli(Config))
