"""Pictures of experiments and benchmarks, which lie outside docs/, on the pages that show them."""

import re
from pathlib import Path

from mkdocs.structure.files import File

ROOT = Path(__file__).parents[1]
OUTSIDE = re.compile(r"\.\./((?:experiments|benchmarks)/(?:results|board)/[\w-]+\.(?:png|gif))")


def on_files(files, config):
    """Add every picture that some page shows."""
    shown = {
        name
        for page in files.documentation_pages()
        for name in OUTSIDE.findall(Path(page.abs_src_path).read_text())
    }
    for name in sorted(shown):
        files.append(File.generated(config, name, abs_src_path=str(ROOT / name)))
    return files


def on_page_markdown(markdown, **_):
    """Point at the copies inside the site."""
    return OUTSIDE.sub(r"\1", markdown)
