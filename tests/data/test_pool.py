"""Items are worked on whatever becomes of the processes: each result once, the dead by name."""

import os
import signal
import subprocess
import sys
import time

import pytest

from jaxshape.data import pool
from jaxshape.data.pool import Died, WorkersDied, in_processes


def work(item):
    """Twice the item; some items end their process, some fail."""
    folder, number = item
    mark = f"{folder}/{number}"
    if number == 1 and not os.path.exists(mark):  # only the first time, as where memory is short
        open(mark, "w").close()
        os.kill(os.getpid(), signal.SIGKILL)
    if number == 2:
        os._exit(3)
    if number == 7:
        raise OSError(f"{number} is wrong.")
    return 2 * number


def test_processes_that_die_are_replaced_and_their_items_named(tmp_path):
    items = [(str(tmp_path), number) for number in range(6)]
    results = dict(in_processes(work, items, 2))
    assert results == {0: 0, 1: 2, 2: Died(3), 3: 6, 4: 8, 5: 10}
    assert "exit status 3, twice" in str(results[2])


def test_what_an_item_raises_is_raised_here(tmp_path):
    items = [(str(tmp_path), number) for number in (0, 7)]
    with pytest.raises(OSError, match="7 is wrong"):
        list(in_processes(work, items, 2))


def test_processes_that_cannot_begin_end_in_a_sentence(monkeypatch):
    monkeypatch.setattr(pool, "_serve", sys.exit)  # which is called with the function
    with pytest.raises(WorkersDied, match="before it began; give the same command again"):
        list(in_processes(print, [1, 2, 3], 2))


SCRIPT = """
import os, sys, time
from jaxshape.data.pool import in_processes

def hold(item):
    open(f"{sys.argv[1]}/{os.getpid()}", "w").close()
    time.sleep(600)

if __name__ == "__main__":
    list(in_processes(hold, [1, 2, 3], 2))
"""


def test_processes_die_with_their_parent(tmp_path):
    """The parent is killed while both of its processes are at work."""
    (tmp_path / "holding.py").write_text(SCRIPT)
    marks = tmp_path / "marks"
    marks.mkdir()
    command = [sys.executable, str(tmp_path / "holding.py"), str(marks)]
    parent = subprocess.Popen(command, env=os.environ | {"PYTHONPATH": os.getcwd()})
    try:
        wait_for(lambda: len(os.listdir(marks)) == 2)
    finally:
        parent.kill()
        parent.wait()
    wait_for(lambda: not any(alive(int(name)) for name in os.listdir(marks)))


def alive(process):
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    with open(f"/proc/{process}/stat") as file:
        return file.read().rpartition(")")[2].split()[0] != "Z"


def wait_for(condition):
    for _ in range(600):
        if condition():
            return
        time.sleep(0.1)
    raise AssertionError("It did not happen.")
