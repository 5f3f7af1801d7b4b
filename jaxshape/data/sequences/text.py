"""Numbers in hand-written text files, with comments, commas and brackets."""

import re

import numpy as np

_COMMENT = re.compile(r"(?:^|\s)(?:#|//|%).*")  # not inside a word: Windows writes -1.#IND for NaN


def words_of(text: str) -> list[tuple[int, list[str]]]:
    """The number of each line, from 1, and its words; lines without words are left out.

    Comments after `#`, `//` or `%` are dropped; commas, semicolons and brackets count as spaces.
    """
    plain = (re.sub(r"[,;\[\](){}]", " ", _COMMENT.sub("", line)) for line in text.splitlines())
    return [(i, words) for i, line in enumerate(plain, 1) if (words := line.split())]


def number(word: str) -> float:
    """Parse a number from a text file, also Windows' spellings of NaN and infinity, `-1.#IND`."""
    return np.nan if "#" in word else float(word)
