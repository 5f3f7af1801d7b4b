"""Pages made by the site: notebooks as text, and pictures of experiments from outside docs/."""

import re
from pathlib import Path

from mkdocs.structure.files import File

ROOT = Path(__file__).parents[1]
OUTSIDE = re.compile(r"\.\./((?:experiments|benchmarks)/(?:results|board)/[\w-]+\.(?:png|gif))")
NOTEBOOK = re.compile(r"(notebooks/\w+)\.py")


def as_markdown(script):
    """The page of a notebook: its text, and its code in blocks.

    Args:
        script: A notebook in jupytext's percent format.
    """
    cells = re.split(r"^# %%", script, flags=re.MULTILINE)[1:]
    return "\n\n".join(map(_as_markdown, cells)) + "\n"


def _as_markdown(cell):
    kind, _, body = cell.partition("\n")
    if "[markdown]" in kind:
        return re.sub(r"^# ?", "", body.strip(), flags=re.MULTILINE)
    return f"```python\n{body.strip()}\n```"


def on_files(files, config):
    """Add every notebook, and every picture that some page shows."""
    shown = {
        name
        for page in files.documentation_pages()
        for name in OUTSIDE.findall(Path(page.abs_src_path).read_text())
    }
    for name in sorted(shown):
        files.append(File.generated(config, name, abs_src_path=str(ROOT / name)))
    for path in sorted((ROOT / "docs" / "notebooks").glob("*.py")):
        page = f"notebooks/{path.stem}.md"
        files.append(File.generated(config, page, content=as_markdown(path.read_text())))
    return files


def on_page_markdown(markdown, **_):
    """Point at the copies and pages inside the site."""
    return NOTEBOOK.sub(r"\1.md", OUTSIDE.sub(r"\1", markdown))
