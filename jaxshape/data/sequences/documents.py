"""Text that comes with a recording, and the files it names: bounded, and inside the recording."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxshape.data.sequences.errors import SequenceError
from jaxshape.data.sequences.text import number, read_text, words_of

MAX_BYTES = 256 * 2**20
"""Size up to which a text file is read; an hour of poses takes a tenth of it."""


def read_bounded(path: Path) -> str:
    """Read a text, as `read_text`; `SequenceError` if it is no regular file, large, or binary."""
    try:
        if not path.is_file():
            raise ValueError("it is missing, or not a regular file")
        if (size := path.stat().st_size) > MAX_BYTES:
            raise ValueError(f"it has {size / 2**20:.0f} MB, more than {MAX_BYTES / 2**20:.0f}")
        return read_text(path)
    except (OSError, ValueError) as error:
        raise SequenceError(
            f"{path} cannot be read ({error}); expected a text file: copy it again from its source."
        ) from error


def read_json_object(path: Path) -> dict[str, Any]:
    """Read a JSON file that holds one object; `SequenceError` if it holds anything else."""
    text = read_bounded(path)
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise SequenceError(
            f"{path} is not JSON ({error}); expected a whole JSON file: copy it again from its "
            "source."
        ) from error
    if not isinstance(content, dict):
        raise SequenceError(f"{path} holds a JSON {type(content).__name__}; expected an object.")
    return content


def matrix_of(
    value: Any, shape: tuple[int, ...], source: object, name: str
) -> Float[np.ndarray, "..."]:
    """Numbers from a JSON file as an array of a shape; `SequenceError` if they do not fill it."""
    try:
        if any(one is None for one in np.array(value, dtype=object).ravel()):
            raise ValueError("it is missing")
        return np.array(value, dtype=np.float64).reshape(shape)
    except (ValueError, TypeError, OverflowError) as error:
        wanted = " x ".join(map(str, shape))
        raise SequenceError(
            f"{source} gives no usable {name} ({error}); expected {wanted} numbers: write it again."
        ) from error


def rows_of(path: Path, columns: Iterable[int]) -> list[list[float]]:
    """Rows of numbers of a text file, each with one of the numbers of `columns`.

    Comments, and commas and brackets between the numbers, are passed over.
    """
    wanted = tuple(columns)
    rows = []
    for line, words in words_of(read_bounded(path)):
        try:
            row = [number(word) for word in words]
        except ValueError as error:
            raise SequenceError(
                f"{path}, line {line}: {error}; expected numbers alone: write it again."
            ) from error
        if len(row) not in wanted:
            raise SequenceError(
                f"{path}, line {line} holds {len(row)} numbers; expected "
                f"{' or '.join(map(str, wanted))}: write it again."
            )
        rows.append(row)
    return rows


def below(folder: Path, name: Any, source: Path) -> Path:
    """The file that a text names, which has to lie below the folder of the recording.

    Links are followed first, so that a recording cannot have a file read that is not its own.
    """
    if not isinstance(name, str) or "\0" in name:
        raise SequenceError(f"{source} names the file {name!r}; expected a path, relative to it.")
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        raise SequenceError(
            f"{source} names the file {name!r}, which lies outside of {folder}; expected a file "
            "below it: copy it there."
        )
    return path
