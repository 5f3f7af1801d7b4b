"""Every code block and command of the documentation runs, in small.

What is smaller than it says stands in the tables below; what is not run, with its reason.
"""

import json
import re
import shlex
import sys
from pathlib import Path

import pytest
import trimesh
import tyro
from orbit_recording import depth_path, write_recording

from jaxshape import cli
from jaxshape.cli.options import refusing
from jaxshape.data.boxes import read_box

ROOT = Path(__file__).parents[2]
PAGES = sorted(str(path.relative_to(ROOT)) for path in (ROOT / "docs").glob("*.md"))
DOCUMENTS = ("README.md", "CONTRIBUTING.md", *PAGES)

INSTEAD = {
    "js.load_prior()": 'js.load_prior("known.safetensors")',
    '"chair-autoencoder"': '"known.safetensors"',
    "iterations=100": "iterations=2",
    "range(1_000_001, 1_000_005)": "range(1_000_001, 1_000_003)",
    "out/mug/mug.safetensors": "known.safetensors",
    "click=(240, 150)": "click=(64, 70)",
    "--click 240 150": "--click 64 70",
    "--object 2": "--click 64 70",
    'js.open_sequence("room/")': 'js.open_sequence("scan")',
}
"""Of code and of commands, by what runs in its place; images of the test are 128 pixels wide."""

MORE = {
    "demo": "--frames 2 --iterations 2 --weights known.safetensors",
    "inspect": "",
    "reconstruct": "--iterations 2 --keyframe-iterations 1 --weights known.safetensors",
    "plot": "",
    "complete": "--iterations 2 --weights known.safetensors",
    "evaluate": "--frames 1 --iterations 2 --weights known.safetensors",
    "dataset": "--count 12 --frames 1 2 --cameras paper --workers 1",
    "train": "--steps 2 --batch 2 --code 10",
}
"""Options that a command gets besides its own; of two that differ, the last counts."""

NOT_RUN = {
    "make demo": "installs; the test of `jaxshape demo` runs what it runs",
    "make test": "runs this",
    "make lint": "runs other programs",
    "make fuzz": "takes twenty minutes",
    "make kills": "takes an hour",
    "make soak": "takes two hours",
    "make test-slow": "runs this",
    "git clone <this repository> && cd jaxshape": "fetches",
    "pip install jaxshape": "installs",
    "jaxshape view out/reconstruct": "serves until it is stopped; tests/report/test_viewer.py",
    "jaxshape view out/scene": "serves until it is stopped",
    "jaxshape next": "needs a result; tests/report/test_next_views.py runs it",
    "jaxshape scene": "tests/mapping/scene rebuilds a scene",
    "jaxshape bench": "tests/bench runs it",
    "srun --ntasks-per-node=1 jaxshape evaluate": "needs a cluster",
    "jaxshape evaluate --coordinator": "needs two machines; tests/test_hosts.py runs it on one",
    "python experiments/mugs.py --output data/mugs": "tests/experiments/test_mugs.py runs it",
}
"""How commands begin, by the reason."""

TEXT = ("mesh or frames -> F", '[project.entry-points."jaxshape.methods"]')
"""How blocks begin that are neither code nor commands."""


def text_of(document: str) -> str:
    return (ROOT / document).read_text()


def fenced(document: str) -> list[tuple[str, str]]:
    """Language and content of the blocks between fences."""
    return re.findall(r"^```(\w*)\n(.*?)^```$", text_of(document), re.DOTALL | re.MULTILINE)


def indented(document: str) -> list[str]:
    """The blocks that are set off by four spaces."""
    rest = re.sub(r"^```.*?^```$", "", text_of(document), flags=re.DOTALL | re.MULTILINE)
    return [re.sub("^    ", "", block, flags=re.MULTILINE)
            for block in re.findall(r"(?<=\n\n)((?: {4}.*\n+)+)", rest)]  # fmt: skip


def commands(document: str) -> list[str]:
    """The lines of blocks of commands, and those in the first column of a table, each once."""
    blocks = [block for block in indented(document) if not block.startswith(TEXT)]
    lines = "".join(blocks).replace("\\\n", " ").splitlines()
    lines = [" ".join(re.sub("  #.*", "", line).split()) for line in lines]
    in_tables = re.findall(r"^\| `(jaxshape .*?)` \|", text_of(document), re.MULTILINE)
    return list(dict.fromkeys(line for line in in_tables + lines if line))


def smaller(text: str) -> str:
    for said, done in INSTEAD.items():
        text = text.replace(said, done)
    return text


COMMANDS = [(document, line) for document in DOCUMENTS for line in commands(document)]
RUN = [(document, line) for document, line in COMMANDS if not line.startswith(tuple(NOT_RUN))]


def test_nothing_is_overlooked():
    """Every block is of a kind that is run; what the tables name stands in the documents."""
    assert len(PAGES) > 5
    languages = {language for document in DOCUMENTS for language, _ in fenced(document)}
    assert languages == {"python", "json"}
    assert all(line.startswith("jaxshape ") for _, line in RUN), RUN
    everything = "".join(map(text_of, DOCUMENTS))
    assert [said for said in (*INSTEAD, *TEXT) if said not in everything] == []
    assert [start for start in NOT_RUN if not any(x.startswith(start) for _, x in COMMANDS)] == []
    assert set(MORE) == {line.split()[1] for _, line in RUN}


@pytest.mark.parametrize("line", sorted({line for _, line in COMMANDS if "jaxshape " in line[:9]}))
def test_the_command_line_takes_it_as_it_stands(line):
    arguments = shlex.split(line)[1:]
    table = cli.commands(arguments)
    assert tyro.cli(table, prog="jaxshape", args=arguments, registry=refusing())


@pytest.fixture
def place(tmp_path, walk, known_weights, monkeypatch):
    """A folder with all that a document takes for granted, to work in."""
    place = tmp_path
    monkeypatch.chdir(place)
    monkeypatch.setattr(sys, "path", list(sys.path))
    (place / "known.safetensors").write_bytes(known_weights.read_bytes())
    for scan in ("scan", "kitchen/frames"):
        folder = write_recording(place / scan, walk)
        for number in range(4, len(walk.depth)):
            depth_path(folder, number).unlink()
        (place / "box.json").write_text((folder / "box.json").read_text())
    cloud = trimesh.creation.box((0.5, 0.9, 0.5)).sample(2000)
    trimesh.PointCloud(cloud).export(place / "scan.ply")
    for kind in ("chairs", "mugs", "data/mugs", "unseen_mugs", "more_mugs"):
        (place / kind).mkdir(parents=True)
        for i in range(12 if kind in ("mugs", "data/mugs") else 2):
            trimesh.creation.box((1, 2, 1 + i / 10)).export(place / kind / f"{i}.ply")
    return place


LONG = ("docs/recordings.md", "docs/scenes.md", "docs/searches.md", "docs/uncertainty.md")
"""Documents whose code rebuilds or compiles much: it runs with -m slow."""


@pytest.mark.parametrize(
    "document",
    [pytest.param(one, marks=[pytest.mark.slow] * (one in LONG)) for one in DOCUMENTS],
)
def test_code_runs(document, place, unchecked_types):
    """The blocks of a document one after another: later ones use the names of earlier ones."""
    names: dict = {}
    for language, code in fenced(document):
        if language == "python":
            exec(compile(smaller(code), document, "exec"), names)


def test_the_box_of_the_page_is_one(tmp_path):
    (box,) = [code for language, code in fenced("docs/recordings.md") if language == "json"]
    (tmp_path / "box.json").write_text(box)
    assert read_box(tmp_path / "box.json").size.tolist() == json.loads(box)["size"]


def run_all(run, lines: list[str]) -> None:
    for line in lines:
        _, name, *options = shlex.split(smaller(line))
        status, _, err = run(name, *options, *shlex.split(MORE[name]))
        assert status == 0, f"{line}\n{err}"


SLOW = tuple(
    f"jaxshape {name}"
    for name in ("complete", "dataset", "demo", "evaluate", "plot", "reconstruct", "train")
)
"""Commands that tests/test_cli.py and tests/test_complete.py run: those of documents are slow."""


def is_slow(line: str) -> bool:
    return line.startswith(SLOW)


@pytest.mark.parametrize("document", DOCUMENTS)
def test_commands_run(document, place, run, unchecked_types):
    run_all(run, [line for of, line in RUN if of == document and not is_slow(line)])


@pytest.mark.slow
@pytest.mark.parametrize("document", DOCUMENTS)
def test_slow_commands_run(document, place, run, unchecked_types):
    run_all(run, [line for of, line in RUN if of == document and is_slow(line)])


@pytest.mark.slow
def test_the_quickstart_prints_what_it_says(tmp_path, monkeypatch, capsys, unchecked_types):
    """With the weights of the package, as it stands: what each network is good for."""
    monkeypatch.chdir(tmp_path)
    code = fenced("README.md")[0][1]
    exec(compile(code, "README.md", "exec"), {})
    printed = [float(x) for x in capsys.readouterr().out.split()]
    comments = re.findall(r"^ *print.*# (.*)$", code, re.MULTILINE)
    said = [float(x) for comment in comments for x in re.findall(r"\d\.\d+", comment)]
    assert printed == pytest.approx(said, abs=0.003) and len(said) == 5
    measured, composed, first, searched, _ = printed
    assert measured < composed and first < searched < composed
