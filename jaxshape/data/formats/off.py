"""OFF, the format of ModelNet."""

import re

import numpy as np

from jaxshape.data.formats.parts import (
    NotSupported,
    Part,
    Unreadable,
    positions,
    text_of,
    without_comments,
)
from jaxshape.data.formats.polygons import triangulate


def read_off(content: bytes) -> list[Part]:
    """The polygons of an OFF file as triangles.

    Args:
        content: Content of the file.

    Raises:
        Unreadable: The file is damaged, or does not hold as much as its header says.
        NotSupported: It is binary, or of another dimension than three.
        TooManyFaces: There are too many triangles.
    """
    text = without_comments(text_of(content)).strip()
    kind = re.match(r"(ST)?C?N?(4)?(n)?OFF", text)
    if kind is None:
        raise Unreadable("The file does not begin with OFF.")
    if kind[2] or kind[3] or re.match(r"\s*BINARY", text[kind.end() :]):
        raise NotSupported(f"The file is of the kind {text.split(chr(10))[0][:20]!r}; export OFF.")
    # Many ModelNet files have no space between header and counts: "OFF490926 518 0".
    counts, *rows = [line.split() for line in text[kind.end() :].split("\n") if line.strip()] or [
        []
    ]
    try:
        vertex_count, face_count = (int(word) for word in counts[:2])
    except ValueError as problem:
        raise Unreadable("The numbers of vertices and faces are missing.") from problem
    expected = vertex_count + face_count
    if min(vertex_count, face_count) < 0 or len(rows) != expected:
        raise Unreadable(
            f"The header says {vertex_count} vertices and {face_count} faces, so {expected} lines, "
            f"but {len(rows)} follow."
        )
    vertices, faces = positions(rows[:vertex_count]), _faces(rows[vertex_count:])
    return [Part("", vertices, triangulate(vertices, *faces))]


def _faces(rows: list[list[str]]) -> tuple[np.ndarray, np.ndarray]:
    """Indices of all faces, and their number in each; colours after them are left out."""
    try:
        counts = [int(row[0]) for row in rows]
        indices = [
            int(word) for row, n in zip(rows, counts, strict=True) for word in row[1 : n + 1]
        ]
        flat, lengths = np.array(indices, np.int64), np.array(counts, np.int64)
    except (ValueError, OverflowError) as problem:
        raise Unreadable(f"A face is not a list of numbers: {problem}.") from problem
    if (lengths < 0).any() or lengths.sum() != len(flat):
        raise Unreadable("A face has fewer corners than it says.")
    return flat, lengths
