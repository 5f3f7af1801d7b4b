"""Allow one writer for each output, and check before the work that it can be written. [host]"""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from jaxshape.files import TEMPORARY, OutputError, unwritable
from jaxshape.limits import FREE_BYTES, MIB

try:
    import fcntl
except ImportError:  # on Windows
    fcntl = None


class Output(NamedTuple):
    """The output of a command.

    Attributes:
        path: Folder or file of the output.
        is_file: Whether it is one file.
        goes_on: Whether the same command, given again, resumes where it was stopped.
        needs: Free bytes that the disk must have at the start.
        reads: Folder that the command reads, into which it does not write; None for none.
    """

    path: Path
    is_file: bool = False
    goes_on: bool = False
    needs: int = FREE_BYTES
    reads: Path | None = None

    @property
    def folder(self) -> Path:
        """The folder that is written to."""
        return self.path.parent if self.is_file else self.path

    @property
    def kept(self) -> str:
        """The files left by a stopped command, as a sentence."""
        if self.goes_on:
            return "Finished parts are kept; give the same command again to resume."
        return "Give the same command again to start over."


@contextmanager
def claimed(output: Output) -> Iterator[None]:
    """Lock an output for the block that writes it.

    The folder is made if it is missing, and removed again if nothing was written to it. Unfinished
    files of a killed writer are removed.

    Args:
        output: The output to claim.

    Raises:
        OutputError: The output cannot be written, is what the command reads, its disk has too
            little space, or another process is writing it.
    """
    _check_kind(output)
    made = [one for one in (output.folder, *output.folder.parents) if not one.exists()]
    try:
        try:
            output.folder.mkdir(parents=True, exist_ok=True)
            _check_space(output)
            lock = _locked(output)
        except OSError as problem:
            raise unwritable(output.folder, problem) or problem from problem
        try:
            _remove_halves(output)
            yield
        finally:
            _release(output, lock)
    finally:
        for folder in made:
            with suppress(OSError):  # it holds something
                folder.rmdir()


def _check_kind(output: Output) -> None:
    if output.is_file and output.path.is_dir():
        raise OutputError(f"{str(output.path)!r} is a folder; give the name of a file in it.")
    if not output.is_file and output.path.exists() and not output.path.is_dir():
        raise OutputError(f"{str(output.path)!r} is a file; give a folder as --output.")
    if output.reads is not None and output.path.resolve() == output.reads.resolve():
        raise OutputError(
            f"{str(output.path)!r} is the recording itself, whose files could be overwritten; give "
            "another folder as --output."
        )


def _check_space(output: Output) -> None:
    free = shutil.disk_usage(output.folder).free
    if free < output.needs:
        raise OutputError(
            f"{str(output.folder)!r} has room for {free / MIB:.0f} MB, and "
            f"{output.needs / MIB:.0f} MB are needed; make room, or give another --output."
        )


def _remove_halves(output: Output) -> None:
    patterns = (f"{TEMPORARY}{output.path.stem[:100]}-*",) if output.is_file else (
        f"{TEMPORARY}*",
        f"*/{TEMPORARY}*",
    )  # fmt: skip
    for pattern in patterns:
        for half in output.folder.glob(pattern):
            half.unlink(missing_ok=True)


# Locks -----------------------------------------------------------------------------------------


def _lock_file(output: Output) -> Path:
    return output.folder / (f".{output.path.name}.lock" if output.is_file else ".lock")


def _locked(output: Output) -> int:
    """Open and lock the lock file until this process ends; the file holds the process number."""
    path = _lock_file(output)
    while True:
        lock = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            if fcntl is not None:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.samestat(os.fstat(lock), os.stat(path)):  # not just removed by another
                os.truncate(lock, 0)
                os.write(lock, f"{os.getpid()}\n".encode())
                return lock
        except BlockingIOError:
            who = os.read(lock, 20).decode(errors="replace").strip()
            os.close(lock)
            raise OutputError(
                f"{str(output.path)!r} is being written by another command (process {who}); wait "
                "for it, or give another --output."
            ) from None
        except FileNotFoundError:
            pass
        except OSError:  # a disk without locks
            return lock
        os.close(lock)


def _release(output: Output, lock: int) -> None:
    with suppress(OSError):
        _lock_file(output).unlink()
    os.close(lock)
