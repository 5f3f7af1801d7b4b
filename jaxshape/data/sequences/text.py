"""Numbers in text files as people write them: byte order marks, UTF-16, comments, commas."""

import codecs
import re
from pathlib import Path

import numpy as np

_COMMENT = re.compile(r"(?:^|\s)(?:#|//|%).*")  # not inside a word: Windows writes -1.#IND for NaN


def read_text(path: Path) -> str:
    """The text of a file in UTF-8 or UTF-16, with or without a byte order mark.

    Args:
        path: The file.

    Raises:
        OSError: It cannot be read.
        ValueError: It is neither.
    """
    content = path.read_bytes()
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return content.decode("utf-16")
    if b"\0" in content[:2]:  # ASCII in two bytes each
        return content.decode("utf-16-be" if content[0] == 0 else "utf-16-le")
    return content.decode("utf-8-sig")


def words_of(text: str) -> list[tuple[int, list[str]]]:
    """The number of each line, from 1, and its words; lines without any are left out.

    Comments behind `#`, `//` or `%` are dropped; commas, semicolons and brackets count as spaces.
    """
    plain = (re.sub(r"[,;\[\](){}]", " ", _COMMENT.sub("", line)) for line in text.splitlines())
    return [(i, words) for i, line in enumerate(plain, 1) if (words := line.split())]


def number(word: str) -> float:
    """A number from a text file, Windows' spellings of NaN and infinity, `-1.#IND`, among them."""
    return np.nan if "#" in word else float(word)
