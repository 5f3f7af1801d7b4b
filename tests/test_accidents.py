"""Accidents of a command line: each ends in one sentence and the right exit status."""

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from jaxshape import claim
from jaxshape.claim import Output, claimed
from jaxshape.cli import benchmarking, completing, learning, rebuild, recording, scoring
from jaxshape.files import write_text

COMMANDS = {
    "demo": (rebuild.Demo, ()),
    "reconstruct": (recording.Reconstruct, ("scan",)),
    "complete": (completing.Complete, ("scan.ply",)),
    "dataset": (learning.BuildDataset, ()),
    "train": (learning.Train, ("--dataset", "data")),
    "evaluate": (scoring.Evaluate, ("--count", "1")),
    "bench": (benchmarking.Bench, ()),
    "plot": (scoring.Plot, ("out",)),
}
FILES = ("evaluate", "plot")
"""Commands whose output is one file."""

GO_ON = ("reconstruct", "dataset", "train", "evaluate", "bench")
"""Commands that go on where they were stopped."""


@pytest.fixture(params=COMMANDS)
def started(request, run, monkeypatch):
    """Start a command whose work is another; returns its name and the function that starts it."""

    def start(output, work):
        command, given = COMMANDS[request.param]
        monkeypatch.setattr(command, "run", lambda self: work(Path(output)))
        return run(request.param, *given, "--output", output)

    return request.param, start


def never(output):
    pytest.fail("the work has begun")


def test_an_output_of_the_wrong_kind_is_refused_before_the_work(started, tmp_path):
    name, start = started
    output = tmp_path / "there"
    output.mkdir() if name in FILES else output.write_text("mine")
    status, out, err = start(output, never)
    assert status == 2 and not out and "there" in err and "give" in err
    assert output.is_dir() or output.read_text() == "mine"
    (tmp_path / "file").write_text("mine")
    status, _, err = start(tmp_path / "file" / "out", never)
    assert status == 2 and "a part of the path is a file" in err


def test_a_full_disk_is_refused_before_the_work(started, tmp_path, monkeypatch):
    _, start = started
    free = shutil.disk_usage(tmp_path)._replace(free=10**6)
    monkeypatch.setattr(claim.shutil, "disk_usage", lambda _: free)
    status, _, err = start(tmp_path / "new" / "out", never)
    assert status == 2 and "room for 1 MB, and " in err and "MB are needed; make room" in err
    assert not os.listdir(tmp_path)


def test_a_dataset_says_how_much_room_it_needs(run, tmp_path, monkeypatch):
    """Of which what is there already is not needed again."""
    free = shutil.disk_usage(tmp_path)._replace(free=10**9)
    monkeypatch.setattr(claim.shutil, "disk_usage", lambda _: free)
    monkeypatch.setattr(learning.BuildDataset, "run", never)
    make = ("dataset", "--output", tmp_path / "data", "--frames", 1, 2, "--count", 20_000)
    status, _, err = run(*make)
    assert status == 2 and "room for 954 MB, and 1328 MB are needed" in err
    (tmp_path / "data").mkdir()
    with open(tmp_path / "data" / "shard-00000.measured.npy", "wb") as file:
        file.truncate(5 * 10**8)
    monkeypatch.setattr(learning.BuildDataset, "run", lambda _: None)
    assert run(*make)[0] == 0


def test_two_runs_into_one_output_do_not_meet(started, tmp_path):
    name, start = started
    with claimed(Output(tmp_path / "out", is_file=name in FILES)):
        status, _, err = start(tmp_path / "out", never)
    assert status == 2 and f"being written by another command (process {os.getpid()})" in err


def test_a_disk_that_fills_leaves_what_was_there_and_says_whether_to_go_on(
    started, tmp_path, monkeypatch
):
    name, start = started

    def fills(output):
        folder = output.parent if name in FILES else output
        write_text(folder / "first.txt", "kept")
        monkeypatch.setattr(os, "replace", full)
        write_text(folder / "second.txt", "lost")

    def full(*_):
        raise OSError(28, "No space left on device")

    status, _, err = start(tmp_path / "out", fills)
    assert status == 2 and "cannot be written: the disk is full." in err
    assert ("give the same command again to resume" in err) == (name in GO_ON)
    assert [path.name for path in tmp_path.rglob("*.*")] == ["first.txt"]


@pytest.mark.parametrize("problem, said", [
    (MemoryError(), "This machine does not have enough memory for this command."),
    (FileNotFoundError(2, "No such file or directory", "gone.png"), "'gone.png' cannot be read"),
    (OSError("[/red] is no markup."), "[/red] is no markup."),
])  # fmt: skip
def test_what_goes_wrong_is_one_sentence(run, monkeypatch, tmp_path, problem, said):
    def fails(self):
        raise problem

    monkeypatch.setattr(rebuild.Demo, "run", fails)
    status, out, err = run("demo", "--output", tmp_path / "out")
    assert status == 2 and not out and said in err and "Traceback" not in err
    assert not os.listdir(tmp_path)


# Signals and surroundings ----------------------------------------------------------------------

PROGRAM = """
import signal, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # the suite may run in the background
from jaxshape import cli
from jaxshape.cli.recording import Reconstruct
from jaxshape.files import write_text

def work(self):
    write_text(self.output / "first.txt", "kept")
    print("begun", flush=True)
    time.sleep(60)

Reconstruct.run = work
cli.main()
"""


@pytest.mark.parametrize("number, status", [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_signal_ends_a_command_in_order(tmp_path, number, status):
    argv = [sys.executable, "-c", PROGRAM, "reconstruct", "scan", "--output", tmp_path / "out"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(list(map(str, argv)), text=True, **pipes) as process:
        assert process.stdout.readline() == "begun\n"
        process.send_signal(number)
        _, err = process.communicate(timeout=60)
    assert process.returncode == status
    assert err.strip() == (
        "stopped. Finished parts are kept; give the same command again to resume."
    )
    assert os.listdir(tmp_path / "out") == ["first.txt"]


@pytest.fixture
def odd(tmp_path):
    """A recording in a folder whose name is no UTF-8, with brackets in the names of its files."""
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/sc\xff\xc3\xa4n"))
    try:
        (folder / "depth").mkdir(parents=True)
    except OSError:
        pytest.skip("this disk knows UTF-8 names only")
    for index in range(3):
        path = folder / "depth" / f"[red]{index}.png"
        Image.fromarray(np.full((48, 64), 1000 + index, np.uint16)).save(path)
    (folder / "depth" / "[red]1.png").write_bytes(b"damaged")
    np.savetxt(folder / "cam_K.txt", [[60, 0, 32], [0, 60, 24], [0, 0, 1]])
    return folder


def bare(tmp_path, **more):
    """An environment without a home, a language or a place for compiled programs."""
    (tmp_path / "file").write_text("")
    kept = {name: os.environ[name] for name in ("PATH", "PYTHONPATH", "LD_LIBRARY_PATH")
            if name in os.environ}  # fmt: skip
    cache = {"XDG_CACHE_HOME": str(tmp_path / "file"), "HOME": str(tmp_path / "file")}
    return kept | cache | {"LANG": "C", "LC_ALL": "C", "COLUMNS": "20", "TERM": "dumb"} | more


@pytest.mark.parametrize("encoding", ["utf-8", "ascii"])
def test_names_of_any_letters_in_a_bare_environment(tmp_path, odd, encoding):
    argv = [sys.executable, "-m", "jaxshape", "inspect", odd]
    environment = bare(tmp_path, PYTHONIOENCODING=encoding)
    done = subprocess.run(argv, env=environment, capture_output=True)
    assert done.returncode == 0, done.stderr.decode(errors="replace")
    assert b"[red]1.png cannot be read as an image" in done.stdout and not done.stderr


def test_a_reader_that_has_enough_ends_the_command_quietly(tmp_path, odd):
    argv = [sys.executable, "-m", "jaxshape", "inspect", odd, "--json"]
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run(argv, env=bare(tmp_path), stdout=write, stderr=subprocess.PIPE)
    os.close(write)
    assert (done.returncode, done.stderr) == (141, b"")
