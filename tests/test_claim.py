"""An output has one writer, and is found to be writable before the work."""

import os
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from jaxshape import claim
from jaxshape.claim import Output, claimed
from jaxshape.files import OutputError, atomic_path, write_text

HOLDER = """
import sys, time
from pathlib import Path
from jaxshape.claim import Output, claimed
with claimed(Output(Path(sys.argv[1]))):
    print("here", flush=True)
    time.sleep(60)
"""


def test_a_folder_is_made_and_removed_again_if_nothing_came_into_it(tmp_path):
    with pytest.raises(RuntimeError), claimed(Output(tmp_path / "a" / "b")):
        assert (tmp_path / "a" / "b").is_dir()
        raise RuntimeError
    assert not os.listdir(tmp_path)
    with claimed(Output(tmp_path / "a" / "b")):
        write_text(tmp_path / "a" / "b" / "c", "text")
    assert os.listdir(tmp_path / "a" / "b") == ["c"]


def test_a_second_writer_is_told_who_is_first_until_that_is_killed(tmp_path):
    folder = tmp_path / "result"
    command = [sys.executable, "-c", HOLDER, str(folder)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as first:
        assert first.stdout is not None and first.stdout.readline() == "here\n"
        with pytest.raises(OutputError, match=rf"another command \(process {first.pid}\)"):
            with claimed(Output(folder)):
                pass
        first.kill()
    with claimed(Output(folder)):  # the lock that it left is no lock
        pass
    assert not (folder / ".lock").exists()


def test_two_files_of_one_folder_have_a_writer_each(tmp_path):
    a, b = (Output(tmp_path / name, is_file=True) for name in ("a.json", "b.json"))
    with claimed(a), claimed(b):
        with pytest.raises(OutputError, match="being written"), claimed(a):
            pass
    assert not os.listdir(tmp_path)


def test_what_is_of_another_kind_is_refused(tmp_path):
    (tmp_path / "file").write_text("mine")
    for output, said in (
        (Output(tmp_path / "file"), "is a file; give a folder"),
        (Output(tmp_path, is_file=True), "is a folder; give the name of a file"),
        (Output(tmp_path / "file" / "below"), "a part of the path is a file"),
    ):
        with pytest.raises(OutputError, match=said), claimed(output):
            pass
    assert (tmp_path / "file").read_text() == "mine"


def test_a_disk_that_is_nearly_full_is_refused_before_the_work(tmp_path, monkeypatch):
    free = claim.shutil.disk_usage(tmp_path)._replace(free=5 * 2**20)
    monkeypatch.setattr(claim.shutil, "disk_usage", lambda _: free)
    with pytest.raises(OutputError, match="room for 5 MB, and 64 MB are needed"):
        with claimed(Output(tmp_path / "new")):
            pass
    assert not os.listdir(tmp_path)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_of_someone_else_is_refused(tmp_path):
    tmp_path.chmod(0o555)
    with pytest.raises(OutputError, match="permission"), claimed(Output(tmp_path / "new")):
        pass


def test_halves_of_a_killed_writer_are_removed(tmp_path):
    (tmp_path / "keyframes").mkdir()
    halves = [tmp_path / ".writing-mesh-x.glb", tmp_path / "keyframes" / ".writing-0-y.png"]
    for path in (*halves, tmp_path / "mesh.glb"):
        path.write_text("")
    with claimed(Output(tmp_path)):
        assert not any(path.exists() for path in halves)
    assert sorted(os.listdir(tmp_path)) == ["keyframes", "mesh.glb"]


@pytest.mark.parametrize("write", [lambda p: p.write_bytes(bytes(10**6)),
                                   lambda p: np.save(p, np.zeros(10**6))])  # fmt: skip
def test_a_write_that_fails_names_the_folder_and_leaves_the_former_file(tmp_path, write):
    """The system refuses to make a file larger than a limit, as it would on a full disk."""
    target, limit = tmp_path / "a.npy", resource.getrlimit(resource.RLIMIT_FSIZE)
    target.write_text("former")
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limit[1]))
    try:
        with pytest.raises(OutputError, match=str(tmp_path)), atomic_path(target) as temporary:
            write(temporary)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert target.read_text() == "former" and os.listdir(tmp_path) == ["a.npy"]


def test_a_full_disk_is_called_full(tmp_path):
    with pytest.raises(OutputError, match="the disk is full"), atomic_path(tmp_path / "a"):
        raise OSError("786432 requested and 249728 written")
    with pytest.raises(OutputError, match="the disk is full"), atomic_path(tmp_path / "a"):
        Path("/dev/full").write_bytes(b"x")


def test_other_errors_stay_what_they_are(tmp_path):
    with pytest.raises(KeyError), atomic_path(tmp_path / "a"):
        raise KeyError
    assert not os.listdir(tmp_path)
