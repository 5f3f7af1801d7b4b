"""Write files so that a reader never finds a half-written one."""

import errno
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

TEMPORARY = ".writing-"
"""Prefix of the names of files that are being written."""

_REASONS = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the quota of its disk is used up",
    errno.EFBIG: "a file of this size is not allowed there",
    errno.EROFS: "its disk is read-only",
    errno.EACCES: "you have no permission to write there",
    errno.EPERM: "you have no permission to write there",
    errno.ENOENT: "it was removed meanwhile",
    errno.ENOTDIR: "a part of the path is a file",
    errno.EEXIST: "a part of the path is a file",
}


class OutputError(OSError):
    """A file cannot be written; the message names the folder and the reason."""


def unwritable(folder: Path, problem: Exception) -> OutputError | None:
    """The error that explains why nothing can be written to a folder.

    Args:
        folder: The folder.
        problem: The error of a write.

    Returns:
        The error; None if the problem is of another kind.
    """
    if isinstance(problem, OutputError):
        return problem
    is_full = folder.is_dir() and shutil.disk_usage(folder).free < 2**20
    if isinstance(problem, OSError) and problem.errno in _REASONS:
        reason = _REASONS[problem.errno]
    elif is_full or "requested and" in str(problem):  # NumPy's message
        reason = _REASONS[errno.ENOSPC]
    elif isinstance(problem, OSError):
        reason = problem.strerror or str(problem)
    else:
        return None
    return OutputError(f"{str(folder)!r} cannot be written: {reason}.")


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path to write to, which replaces `path` when the block ends well.

    The temporary file lies in the folder of `path`, which is made if missing, and has its suffix,
    so that libraries that choose a format by suffix choose the right one. If the block raises, the
    temporary file is removed and whatever was at `path` before is still there, unchanged.

    Raises:
        OutputError: The file cannot be written, as on a full disk.
    """
    target = Path(path)
    try:
        temporary = _temporary(target)
        try:
            yield temporary
            temporary.chmod(_mode_of(target))
            _flush_to_disk(temporary)
            os.replace(temporary, target)
        finally:
            temporary.unlink(missing_ok=True)
    except Exception as problem:
        if (error := unwritable(target.parent, problem)) is None:
            raise
        raise error from problem


def _temporary(target: Path) -> Path:
    """A new empty file beside the one that is to be written."""
    target.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(
        prefix=f"{TEMPORARY}{target.stem[:100]}-", suffix=target.suffix[:20], dir=target.parent
    )
    os.close(handle)
    return Path(name)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a text as UTF-8, atomically.

    Args:
        path: The file; its folder is made if missing.
        text: Content of the file.
    """
    with atomic_path(path) as temporary:
        # A file name that is not UTF-8 has characters that cannot be encoded in UTF-8.
        temporary.write_text(text, encoding="utf-8", errors="replace")


def write_json(path: str | os.PathLike[str], content: Any) -> None:
    """Write JSON, indented, atomically.

    Args:
        path: The file; its folder is made if missing.
        content: Dictionaries, lists, strings, numbers, booleans and None.

    Raises:
        TypeError: `content` holds something else, such as an array; nothing is written.
    """
    write_text(path, json.dumps(content, indent=1) + "\n")


def _mode_of(target: Path) -> int:
    """The permissions of `target`, or those that a new file would get."""
    if target.exists():
        return target.stat().st_mode & 0o777
    umask = os.umask(0)  # the only way to read it is to set it
    os.umask(umask)
    return 0o666 & ~umask


def _flush_to_disk(path: Path) -> None:
    with open(path, "rb+") as file:
        os.fsync(file.fileno())
