"""A journal gives back its rows, under the same settings only, whatever killed the run."""

import json

import pytest

from jaxshape.results.journal import Journal

SETTINGS = {"frames": (1, 4), "iterations": 60}


def test_rows_are_found_again_under_the_same_settings_only(tmp_path):
    path = tmp_path / "results" / "study.json"
    first = Journal(path, SETTINGS)
    assert first.rows == {} and first.seconds == 0
    first.add({"a": {"iou": 0.5}}, 2.0)
    first.add({"b": {"iou": 0.25}}, 1.5)

    again = Journal(path, SETTINGS)
    assert again.rows == {"a": {"iou": 0.5}, "b": {"iou": 0.25}} and again.seconds == 3.5
    assert Journal(path, SETTINGS | {"iterations": 61}).rows == {}


def test_findings_stand_before_the_rows_and_do_not_cost_them(tmp_path):
    journal = Journal(tmp_path / "study.json", SETTINGS)
    journal.add({"ä": {"curve": [1, 2]}, "b": {}}, 1.0)
    journal.write({"claims": ["x"]})
    content = json.loads(journal.path.read_text())
    assert list(content) == ["settings", "seconds", "claims", "rows"]
    assert content["claims"] == ["x"] and content["settings"]["frames"] == [1, 4]
    assert Journal(journal.path, SETTINGS).rows == journal.rows
    assert sum('"curve"' in line for line in journal.path.read_text().splitlines()) == 1


def test_a_journal_without_rows_can_be_read(tmp_path):
    Journal(tmp_path / "study.json", SETTINGS).write({})
    assert Journal(tmp_path / "study.json", SETTINGS).rows == {}


def test_many_short_rows_take_time_too_and_a_removed_journal_is_empty(tmp_path):
    journal = Journal(tmp_path / "study.json", SETTINGS)
    for i in range(10):
        journal.add({str(i): {}}, 0.04)
    again = Journal(journal.path, SETTINGS)
    assert len(again.rows) == 10 and again.seconds == 0.4
    again.remove()
    again.remove()
    assert Journal(journal.path, SETTINGS).rows == {} and not list(tmp_path.iterdir())


@pytest.mark.parametrize("row", ["5", "null", "[]"])
def test_a_damaged_row_is_told(tmp_path, row):
    path = tmp_path / "study.json"
    path.write_text(f'{{"settings": {{}}, "seconds": 1, "rows": {{"a": {row}}}}}')
    with pytest.raises(ValueError, match="study.json' cannot be resumed .one of its rows"):
        Journal(path, {})
