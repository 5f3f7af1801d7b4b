"""STL, binary and as text."""

import re

import numpy as np

from jaxshape.data.formats.parts import Part, Unreadable, check_faces, positions, text_of

_HEADER, _FACE = 84, 50
"""Bytes before the first triangle of a binary file, and of each triangle."""

_NAME = re.compile(r"^(\s*(?:end)?solid\b).*?(?=\bfacet\s+normal\b|$)", re.MULTILINE)
"""The name of a solid, which may be made of any words, after the word that it follows."""


def read_stl(content: bytes) -> list[Part]:
    """The triangles of an STL file.

    Args:
        content: Content of the file.

    Raises:
        Unreadable: The file is damaged, or does not hold as many triangles as it says.
        TooManyFaces: There are too many triangles.
    """
    count = int.from_bytes(content[80:_HEADER], "little")
    if len(content) == _HEADER + count * _FACE:
        return [_binary(content, count)]
    is_text = re.match(rb"(?i)(\xef\xbb\xbf)?\s*solid\b", content)  # binary files may begin so, too
    if is_text and re.search(rb"(?i)facet", content):
        return [_text(text_of(content))]
    size = len(content)
    raise Unreadable(f"The header says {count} triangles, which does not fit {size} bytes.")


def _binary(content: bytes, count: int) -> Part:
    check_faces(count)
    rows = np.frombuffer(content, np.uint8, offset=_HEADER).reshape(count, _FACE)
    corners = np.ascontiguousarray(rows[:, 12:48]).view("<f4")  # behind the normal
    return _part(corners.reshape(-1, 3).astype(np.float64))


def _text(text: str) -> Part:
    text = _NAME.sub(r"\1 ", text.lower())
    words = text.split()
    corners = [words[i + 1 : i + 4] for i, word in enumerate(words) if word == "vertex"]
    facets, ends = len(re.findall(r"\bfacet\s+normal\b", text)), words.count("endfacet")
    if not len(corners) == 3 * facets == 3 * ends or "endsolid" not in words[-20:]:
        raise Unreadable(
            f"{facets} triangles begin, {ends} end, and there are {len(corners)} corners: "
            "the file is not whole."
        )
    check_faces(facets)
    return _part(positions(corners))


def _part(corners: np.ndarray) -> Part:
    return Part("", corners, np.arange(len(corners)).reshape(-1, 3))
