"""Writing files so that a reader never finds half of one."""

import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path to write to, which replaces `path` when the block ends well.

    The temporary file lies in the folder of `path`, which is made if missing, and has its suffix,
    so that libraries that choose a format by suffix choose the right one. If the block raises, the
    temporary file is removed and whatever was at `path` before is still there, unchanged.
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(
        prefix=f".{target.stem}-", suffix=target.suffix, dir=target.parent
    )
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(_mode_of(target))
        _flush_to_disk(temporary)
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a text as UTF-8, atomically.

    Args:
        path: The file; its folder is made if missing.
        text: All that the file will hold.
    """
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: str | os.PathLike[str], content: Any) -> None:
    """Write JSON, indented, atomically.

    Args:
        path: The file; its folder is made if missing.
        content: Dictionaries, lists, strings, numbers, booleans and None.

    Raises:
        TypeError: Where `content` holds something else, such as an array; nothing is written.
    """
    write_text(path, json.dumps(content, indent=1) + "\n")


def _mode_of(target: Path) -> int:
    """Return the permissions `target` has, or those a file opened anew would get."""
    if target.exists():
        return target.stat().st_mode & 0o777
    umask = os.umask(0)  # the only way to read it is to set it
    os.umask(umask)
    return 0o666 & ~umask


def _flush_to_disk(path: Path) -> None:
    with open(path, "rb+") as file:
        os.fsync(file.fileno())
