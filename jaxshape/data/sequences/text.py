"""Numbers in text files as people write them, with comments, commas and brackets."""

import re

import numpy as np

_COMMENT = re.compile(r"(?:^|\s)(?:#|//|%).*")  # not inside a word: Windows writes -1.#IND for NaN


def words_of(text: str) -> list[tuple[int, list[str]]]:
    """The number of each line, from 1, and its words; lines without any are left out.

    Comments behind `#`, `//` or `%` are dropped; commas, semicolons and brackets count as spaces.
    """
    plain = (re.sub(r"[,;\[\](){}]", " ", _COMMENT.sub("", line)) for line in text.splitlines())
    return [(i, words) for i, line in enumerate(plain, 1) if (words := line.split())]


def number(word: str) -> float:
    """A number from a text file, Windows' spellings of NaN and infinity, `-1.#IND`, among them."""
    return np.nan if "#" in word else float(word)
