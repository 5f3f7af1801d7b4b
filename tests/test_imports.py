"""Imports run one way, from package to package and from room to room of mapping.

Files are parsed, not imported, so that imports inside functions count too.
"""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import jaxshape

ROOT = Path(jaxshape.__file__).parent

ALONE = ("limits",)
"""Modules that import nothing of jaxshape."""

BELOW_ALL = (*ALONE, "checks", "reading", "files", "process", "claim")

PACKAGES = ("geometry", "data", "model", "search", "mapping", "results", "report", "bench", "cli")
MODULES = (*BELOW_ALL, *PACKAGES, "__main__")
ROOMS = ("config", "segmentation", "tracking", "placement", "map", "scene", "views")
"""Each imports from itself and from those before it."""

FILES = sorted(path for path in ROOT.rglob("*.py") if path != ROOT / "__init__.py")


def module_of(path: Path) -> str:
    parts = path.relative_to(ROOT.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported(source: str, package: str) -> Iterator[str]:
    """Dotted names of all that a module of `package` imports, wherever in it."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1]
            base = [*above, node.module or ""] if node.level else [node.module or ""]
            yield from (".".join([*filter(None, base), alias.name]) for alias in node.names)


def place(name: str, prefix: str, order: tuple[str, ...]) -> int | None:
    """Where in an order a dotted name stands; None where it is of something else."""
    if name != prefix and not name.startswith(prefix + "."):
        return None
    part = name.removeprefix(prefix).split(".")[1:2]
    assert part and part[0] in order, f"{name} stands nowhere in {prefix}: {', '.join(order)}"
    return order.index(part[0])


def against_the_way(source: str, module: str, package: str) -> list[str]:
    """What a module imports that stands later than itself."""
    names, wrong = list(imported(source, package)), []
    for prefix, order in (("jaxshape", MODULES), ("jaxshape.mapping", ROOMS)):
        own = place(module, prefix, order) if module != prefix else None
        if own is not None:
            wrong += [name for name in names if (place(name, prefix, order) or 0) > own]
    if module.removeprefix("jaxshape.") in ALONE:
        wrong += [name for name in names if name.split(".")[0] == "jaxshape"]
    return wrong


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_run_one_way(path):
    module = module_of(path)
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    assert against_the_way(path.read_text(), module, package) == []


@pytest.mark.parametrize(
    ("module", "source", "wrong"),
    [
        ("jaxshape.data.render", "from jaxshape.model import weights", True),
        ("jaxshape.data.render", "def f():\n    import jaxshape.search.run", True),
        ("jaxshape.data.render", "from ..results.metrics import iou", True),
        ("jaxshape.data.render", "from jaxshape import cli", True),
        ("jaxshape.files", "from jaxshape import process", True),
        ("jaxshape.mapping.tracking.icp", "from jaxshape.mapping.map.state import added", True),
        ("jaxshape.mapping.segmentation.planes", "from ..tracking import icp", True),
        ("jaxshape.mapping.map.state", "from jaxshape.mapping.tracking import icp", False),
        ("jaxshape.results.card", "from jaxshape import checks\nimport numpy", False),
        ("jaxshape.data.render", "from . import meshes\nfrom jaxshape.geometry import grid", False),
    ],
)
def test_an_import_against_the_way_is_found(module, source, wrong):
    assert bool(against_the_way(source, module, module.rpartition(".")[0])) == wrong


@pytest.mark.parametrize("source", ["import jaxshape", "from jaxshape import build_mapper"])
def test_the_package_does_not_import_its_own_public_names(source):
    with pytest.raises(AssertionError, match="stands nowhere"):
        against_the_way(source, "jaxshape.cli.rebuild", "jaxshape.cli")
