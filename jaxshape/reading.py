"""Read files from other sources within limits: regular files, JSON, arrays. [host]

Messages of refusals are a few words, for the end of a sentence that names the file.
"""

import codecs
import json
import os
import re
import stat
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Float

from jaxshape import limits


@contextmanager
def opened(path: str | os.PathLike[str], most: int) -> Iterator[BinaryIO]:
    """Open a file for the block that reads it.

    It neither waits for pipes nor reads devices, since a recording or a result may come from
    anyone.

    Args:
        path: The file, or a link to it.
        most: Largest size, in bytes.

    Raises:
        OSError: It cannot be opened.
        ValueError: It is not a regular file, or is larger than `most`.
    """
    with open(path, "rb", opener=_at_once) as file:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode):
            raise ValueError("it is not a regular file")
        if status.st_size > most:
            raise ValueError(f"it has {_size(status.st_size)}, more than {_size(most)}")
        yield file


def _at_once(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0))


def _size(count: int) -> str:
    return f"{count / limits.GIB:.1f} GB" if count >= limits.GIB else f"{count / limits.MIB:.0f} MB"


def read_bytes(path: str | os.PathLike[str], most: int) -> bytes:
    """The content of a regular file; raises as `opened` does.

    Args:
        path: The file.
        most: Largest size, in bytes.
    """
    with opened(path, most) as file:
        content = file.read(most + 1)  # the file may have grown
    if len(content) > most:
        raise ValueError(f"it has more than {_size(most)}")
    return content


def read_text(path: str | os.PathLike[str], most: int = limits.TEXT_BYTES) -> str:
    """The text of a file in UTF-8 or UTF-16, with or without a byte order mark.

    Args:
        path: The file.
        most: Largest size, in bytes.

    Raises:
        OSError: It cannot be opened.
        ValueError: It is not in UTF-8 or UTF-16, not a regular file, or larger than `most`.
    """
    content = read_bytes(path, most)
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return content.decode("utf-16")
    if b"\0" in content[:2]:  # ASCII in two bytes each
        return content.decode("utf-16-be" if content[0] == 0 else "utf-16-le")
    return content.decode("utf-8-sig")


# JSON ------------------------------------------------------------------------------------------

_TEXT = re.compile(r'"(?:[^"\\]|\\.)*+"?', re.DOTALL)
_BRACKETS = str.maketrans("{[}]", "(())")


def read_json(path: str | os.PathLike[str]) -> Any:
    """The content of a JSON file; raises as `read_text` and `parse_json` do.

    Args:
        path: The file.
    """
    return parse_json(read_text(path, limits.JSON_BYTES))


def read_json_object(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The object in a JSON file; raises as `read_text` and `parse_json_object` do.

    Args:
        path: The file.
    """
    return parse_json_object(read_text(path, limits.JSON_BYTES))


def parse_json(text: str) -> Any:
    """The value of a JSON text; whole numbers beyond 18 digits become floats.

    Args:
        text: The text.

    Raises:
        ValueError: It is not JSON, holds too many values, or is nested too deeply.
    """
    if text.count(",") + text.count(":") > limits.JSON_VALUES:
        raise ValueError(f"it holds more than {limits.JSON_VALUES:,} values")
    if _nesting(text) > limits.JSON_NESTING:
        raise ValueError(f"its brackets are nested more than {limits.JSON_NESTING} deep")
    try:
        return json.loads(text, parse_int=_whole)
    except ValueError as error:
        raise ValueError(f"it is not JSON: {error}") from None


def parse_json_object(text: str) -> dict[str, Any]:
    """The object in a JSON text; raises as `parse_json` does, and `ValueError` for other content.

    Args:
        text: The text.
    """
    content = parse_json(text)
    if not isinstance(content, dict):
        raise ValueError(f"it holds a JSON {type(content).__name__}, not an object")
    return content


def wrong_kinds(
    content: dict[str, Any], kinds: dict[str, type | tuple[type, ...]]
) -> tuple[str, ...]:
    """Names of the entries of a JSON object that are of another type; booleans are no numbers.

    Args:
        content: The object.
        kinds: Type of each entry that it must have.

    Raises:
        KeyError: The object lacks an entry.
    """
    return tuple(
        name
        for name, kind in kinds.items()
        if isinstance(content[name], bool) or not isinstance(content[name], kind)
    )


def _nesting(text: str) -> int:
    """Depth of nesting of the brackets outside quotes."""
    if text.count("[") + text.count("{") <= limits.JSON_NESTING:
        return 0
    outside = _TEXT.sub("", text).translate(_BRACKETS)
    brackets = np.frombuffer(re.sub("[^()]+", "", outside).encode(), np.uint8)
    steps = np.where(brackets == ord("("), 1, -1)
    return int(np.cumsum(steps).max(initial=0))


def _whole(digits: str) -> int | float:
    return int(digits) if len(digits) < 19 else float(digits)


def numbers_of(value: Any, shape: tuple[int, ...]) -> Float[np.ndarray, "..."]:
    """Numbers from a JSON file as an array.

    Args:
        value: Numbers in lists; numbers in strings, booleans and null are refused.
        shape: Shape to give them; -1 for any length.

    Raises:
        ValueError: They are not numbers, or do not fill the shape.
    """
    leaves = np.array(value, dtype=object)
    for one in leaves.flat:
        if isinstance(one, bool) or not isinstance(one, int | float):
            raise ValueError(f"{one!r:.60} is not a number")
    return leaves.astype(np.float64).reshape(shape)


# Arrays ----------------------------------------------------------------------------------------


def read_arrays(
    path: str | os.PathLike[str], names: Iterable[str] | None = None
) -> dict[str, np.ndarray]:
    """Read arrays of an .npz file; pickled objects are not loaded.

    Args:
        path: The file.
        names: Names of the arrays to read, of which missing ones are left out; None for all.

    Raises:
        OSError: The file cannot be opened.
        ValueError: It is damaged, or its arrays are too large.
    """
    wanted = None if names is None else set(names)
    with opened(path, limits.ARRAY_BYTES) as file:
        try:
            sizes = _sizes(file)
            chosen = [name for name in sizes if wanted is None or name in wanted]
            _check_sizes(sum(sizes[name] for name in chosen), os.fstat(file.fileno()).st_size)
            file.seek(0)
            with np.load(file, allow_pickle=False) as arrays:
                return {name: arrays[name] for name in chosen}
        except (MemoryError, KeyboardInterrupt):
            raise
        except Exception as error:  # zipfile, decompressors and NumPy raise many kinds
            raise ValueError(str(error) or type(error).__name__) from error


def array_names(path: str | os.PathLike[str]) -> frozenset[str]:
    """Names of the arrays of an .npz file; raises as `read_arrays` does.

    Args:
        path: The file.
    """
    with opened(path, limits.ARRAY_BYTES) as file:
        try:
            return frozenset(_sizes(file))
        except Exception as error:
            raise ValueError(str(error) or type(error).__name__) from error


def _sizes(file: BinaryIO) -> dict[str, int]:
    """The size in bytes that the header of each array of an .npz file states."""
    with zipfile.ZipFile(file) as archive:
        members = archive.infolist()
        if len(members) > limits.ARRAY_ENTRIES:
            raise ValueError(f"it holds more than {limits.ARRAY_ENTRIES:,} arrays")
        return {
            one.filename.removesuffix(".npy"): _size_of(archive, one)
            for one in members
            if one.filename.endswith(".npy")
        }


def _size_of(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> int:
    with archive.open(member) as stream:
        version = np.lib.format.read_magic(stream)
        read = np.lib.format.read_array_header_1_0
        if version != (1, 0):
            read = np.lib.format.read_array_header_2_0
        shape, _, dtype = read(stream)
    size = int(np.prod(shape, dtype=object)) * dtype.itemsize
    if not 0 <= size <= member.file_size:
        raise ValueError(f"{member.filename} promises {size} bytes and holds fewer")
    return size


def _check_sizes(total: int, packed: int) -> None:
    if total > limits.ARRAY_BYTES:
        raise ValueError(f"its arrays have {_size(total)}, more than {_size(limits.ARRAY_BYTES)}")
    if total > max(limits.ARRAY_FREE, limits.ARRAY_RATIO * packed):
        raise ValueError(f"its {packed} bytes unpack to {_size(total)}")
