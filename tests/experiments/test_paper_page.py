"""The figures in the table of docs/paper.md are those of the results files."""

import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ROWS = [
    [cell.strip() for cell in line.strip("| ").split(" | ")]
    for line in (ROOT / "docs/paper.md").read_text().splitlines()
    if line.startswith("| ") and ".py`" in line
]
FIGURE = re.compile(r"(?<![\w.])[+-]?(\d+\.\d+|\d+)(%?)(?![\w.]*\d)")


def numbers(found):
    """All numbers in a results file, rows of single chairs excepted."""
    if isinstance(found, dict):
        return {x for key, value in found.items() if key != "rows" for x in numbers(value)}
    if isinstance(found, list):
        return {x for value in found for x in numbers(value)}
    return {abs(found)} if isinstance(found, int | float) else set()


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[1][:40])
def test_every_share_and_every_decimal_is_in_the_results_of_its_script(row):
    """Whole numbers, which may be settings, and figures of the claim itself are left out."""
    name = "voluminous" if "oluminous" in row[1] else row[4].split(".py")[0].strip("`")
    known = numbers(json.loads((ROOT / f"experiments/results/{name}.json").read_text()))
    for figure, percent in FIGURE.findall(row[3]):
        if figure in row[1] or ("." not in figure and not percent):
            continue
        digits = len(figure.partition(".")[2])
        values = [100 * x for x in known] if percent else known
        near = 0.51 * 10**-digits
        assert any(abs(x - float(figure)) <= near for x in values), (figure + percent, row[3])
