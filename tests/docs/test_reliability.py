"""What docs/reliability.md says stands in the code: its limits and its tests."""

import re
from pathlib import Path

from jaxshape import limits

TESTS = Path(__file__).parents[1]
PAGE = (TESTS.parent / "docs" / "reliability.md").read_text()


def test_every_limit_is_in_the_table():
    names = {name for name in vars(limits) if name.isupper()} - {"MIB", "GIB"}
    assert {name for name in re.findall(r"`([A-Z_]+)`", PAGE) if name != "LANG"} == names


def test_every_test_that_is_named_is_there():
    there = set(
        re.findall(r"def (test_\w+)", "".join(map(Path.read_text, TESTS.rglob("test_*.py"))))
    )
    named = set(re.findall(r"`(test_\w+)`", PAGE))
    assert len(named) > 20 and named <= there
