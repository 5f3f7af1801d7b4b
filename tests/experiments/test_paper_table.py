"""The page on the paper says what the results files say."""

import json

import pytest

from paper_table import BEGIN, END, Config, main, table

CLAIM = {"figure": "Fig. 1", "claim": "a | b", "ours": "1", "holds": "yes"}


def test_the_page_holds_the_table_of_the_results():
    config = Config()
    assert BEGIN + table(config.results) + END in config.page.read_text()


@pytest.fixture
def config(tmp_path):
    content = {"seconds": 100.0, "claims": [CLAIM], "rows": {"x": {"group": "CAD"}, "y": {}}}
    (tmp_path / "step_size.json").write_text(json.dumps(content))
    (tmp_path / "paper.md").write_text(f"before\n{BEGIN}stale\n{END}after\n")
    return Config(results=tmp_path, page=tmp_path / "paper.md")


def test_only_the_table_is_replaced(config):
    main(config)
    text = config.page.read_text()
    assert text.startswith("before\n" + BEGIN) and text.endswith(END + "after\n")
    assert "stale" not in text and r"a \| b" in text and "1 chairs, 2 min" in text
    main(config)
    assert config.page.read_text() == text


def test_a_table_that_is_not_that_of_the_files_is_reported(config):
    check = Config(config.results, config.page, check=True)
    with pytest.raises(SystemExit, match="not that of the results files"):
        main(check)
    main(config)
    with pytest.raises(SystemExit) as ended:
        main(check)
    assert not ended.value.code


def test_a_page_without_the_two_lines_is_refused(config):
    config.page.write_text("nothing")
    with pytest.raises(SystemExit, match="has no lines"):
        main(config)
