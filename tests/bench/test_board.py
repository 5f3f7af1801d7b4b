"""The board says what the entries hold, and escapes what others wrote into them."""

import numpy as np
import pytest

from jaxshape.bench.board import write_board
from jaxshape.bench.config import GAINS, LEFT
from jaxshape.bench.entries import new_entry, with_rows
from jaxshape.bench.standings import conditions, markdown, standings, table

EVIL = "<script>alert(1)</script> | https://example.com"


@pytest.fixture
def found(rows, tiny_set):
    """Three searches that close all, most and none of the gap, listed from the worst."""
    made = {"idle": (0.0, 3), EVIL: (0.9, 300), "swift": (1.0, 3)}
    entries = [with_rows(new_entry(name), rows(*how)) for name, how in made.items()]
    return standings(entries, tiny_set.best)


def test_who_reaches_more_targets_earlier_stands_higher(found):
    assert [one.name for one in found] == ["swift", EVIL, "idle"]
    swift, slow, idle = found
    assert swift.share(calls=128) == 1 and idle.share() == 0
    assert slow.share(calls=128) == 0
    assert slow.share(calls=512) == slow.share() == sum(left >= 0.1 - 1e-9 for left in LEFT) / 20
    assert slow.share(seconds=0.4) == 0
    assert swift.gains(8) == sum(gain <= 0.1 + 1e-9 for gain in GAINS) / len(GAINS)
    np.testing.assert_allclose(slow.gap[:, -1], 0.1, rtol=1e-6)


def test_the_table_says_so(found):
    cells = {row[0]: row[1:] for row in table(found)}
    assert cells["swift"][:5] == ["1.00", "1.00", "1.00", "1.00", "3"]
    assert cells["idle"][4] == cells["idle"][5] == "–"
    assert cells["swift"][6:8] == ["0.600", "+0.100"]
    lines = markdown(found).splitlines()
    assert len({line.count("|") - line.count("\\|") for line in lines}) == 1


def test_problems_that_some_have_not_searched_are_left_out(rows, tiny_set):
    some = dict(list(rows(1.0).items())[:1])
    entries = [with_rows(new_entry("all"), rows(1.0)), with_rows(new_entry("some"), some)]
    assert [len(one.calls) for one in standings(entries, tiny_set.best)] == [1, 1]
    unknown = new_entry("other")._replace(rows={"nothing/4/clean": {}})
    with pytest.raises(ValueError, match="No problem has results of all"):
        standings([unknown], tiny_set.best)
    with pytest.raises(ValueError, match="No problem has results of all"):
        standings([*entries, new_entry("none")], tiny_set.best)


def test_the_page_needs_no_network_and_escapes_names(found, tiny_set, tmp_path):
    write_board(tmp_path, found, tiny_set)
    page = (tmp_path / "board.html").read_text()
    assert "<script>alert" not in page and "&lt;script&gt;alert" in page
    assert 'src="http' not in page and "href=" not in page and "url(" not in page
    assert (tmp_path / "board.png").read_bytes().startswith(b"\x89PNG")
    assert "2 of 6 problems" in page and "2 of 6 problems" in (tmp_path / "board.md").read_text()


def test_a_busy_machine_is_told(found):
    for one in found:
        for row in one.entry.rows.values():
            row["load"] = 7.5
    assert any("up to 7.5" in sentence for sentence in conditions(found))
