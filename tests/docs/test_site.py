"""The documentation site knows every public name and every page."""

import re
from pathlib import Path

import jaxshape as js

DOCS = Path(__file__).parents[2] / "docs"


def test_the_reference_holds_every_public_name_once():
    pages = "".join(path.read_text() for path in (DOCS / "api").glob("*.md"))
    names = [path.rsplit(".", 1)[1] for path in re.findall(r"^::: (\S+)$", pages, re.MULTILINE)]
    assert sorted(names) == sorted(js.__all__)


def test_every_page_is_in_the_navigation():
    navigation = (DOCS.parent / "mkdocs.yml").read_text().split("\nnav:")[1]
    pages = {str(path.relative_to(DOCS)) for path in DOCS.rglob("*.md")}
    pages |= {f"notebooks/{path.stem}.md" for path in (DOCS / "notebooks").glob("*.py")}
    assert set(re.findall(r"[\w/]+\.md", navigation)) == pages
