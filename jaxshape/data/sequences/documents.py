"""Text files of a recording, with limits, and the files that they name inside the recording."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxshape import limits, reading
from jaxshape.data.sequences.errors import SequenceError
from jaxshape.data.sequences.text import number, words_of


def read_document(path: Path) -> str:
    """Read a text like `reading.read_text`; `SequenceError` if that fails."""
    try:
        return reading.read_text(path)
    except (OSError, ValueError) as error:
        raise SequenceError(
            f"{path} cannot be read ({error}); expected a text file: copy it again from its source."
        ) from error


def read_json_object(path: Path) -> dict[str, Any]:
    """Read a JSON file that holds one object; `SequenceError` if it holds other values."""
    try:
        return reading.read_json_object(path)
    except (OSError, ValueError) as error:
        raise SequenceError(
            f"{path} cannot be read as JSON ({error}); expected a whole JSON file with one object: "
            "copy it again from its source."
        ) from error


def matrix_of(
    value: Any, shape: tuple[int, ...], source: object, name: str
) -> Float[np.ndarray, "..."]:
    """Numbers from a JSON file as an array of a shape; `SequenceError` if they do not fill it."""
    try:
        return reading.numbers_of(value, shape)
    except ValueError as error:
        wanted = " x ".join("n" if size < 0 else str(size) for size in shape) or "1"
        raise SequenceError(
            f"{source} gives no usable {name} ({error}); expected {wanted} numbers: write it again."
        ) from error


def shape_of(height: Any, width: Any, source: object) -> tuple[int, int]:
    """Height and width of images from a JSON file; `SequenceError` if no image has them."""
    sides = matrix_of([height, width], (2,), source, "height and width")
    if not ((sides >= 1) & (sides <= limits.IMAGE_SIDE) & (np.trunc(sides) == sides)).all():
        raise SequenceError(
            f"{source} is of images of {sides[1]:g} x {sides[0]:g} pixels; expected whole numbers "
            f"from 1 to {limits.IMAGE_SIDE}: write their width and height."
        )
    return int(sides[0]), int(sides[1])


def rows_of(path: Path, columns: Iterable[int]) -> list[list[float]]:
    """Rows of numbers of a text file; the length of each row must be in `columns`.

    Comments, and commas and brackets between the numbers, are ignored.
    """
    wanted = tuple(columns)
    rows = []
    for line, words in words_of(read_document(path)):
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
    """The file that a text names, which must be below the folder of the recording.

    Links are resolved first, so that a recording cannot make the reader open files outside it.
    Backslashes, which programs on Windows write, count as slashes.
    """
    if not isinstance(name, str) or "\0" in name or len(name) > limits.PATH_LENGTH:
        raise SequenceError(
            f"{source} names the file {str(name)[:60]!r}; expected a path, relative to it."
        )
    path = folder / name.replace("\\", "/")
    try:
        is_below = path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError):  # a name that is too long, or links in a circle
        is_below = False
    if not is_below:
        raise SequenceError(
            f"{source} names the file {name!r}, which lies outside of {folder}; expected a file "
            "below it: copy it there."
        )
    return path
