"""Wavefront OBJ: polygons of all objects and groups; lines, points and pictures are left out."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from jaxshape.data.formats.parts import (
    LETTERS,
    NotSupported,
    Part,
    Unreadable,
    checked,
    positions,
    text_of,
    without_comments,
)
from jaxshape.data.formats.polygons import triangulate

NOT_POLYGONS = {
    "curv": "curves", "curv2": "curves", "surf": "free-form surfaces", "call": "other files",
    "bzp": "Bezier patches", "bsp": "B-spline patches", "cdp": "Cardinal patches", "res": "patches",
}  # fmt: skip
"""Statements of surfaces that are not supported."""


class _Face(NamedTuple):
    """A face as written in the file.

    Attributes:
        corners: Words of its corners, such as `3/1/2`.
        before: Number of vertices before it.
    """

    corners: list[str]
    before: int


def read_obj(content: bytes) -> list[Part]:
    """The polygons of an OBJ file as triangles, one part for each object and group.

    Args:
        content: Content of the file.

    Raises:
        Unreadable: The file is damaged.
        NotSupported: It holds surfaces that are not polygons.
        TooManyFaces: There are too many triangles.
    """
    vertices, groups, names = [], {"": []}, {"o": "", "g": ""}
    current = groups[""]
    for words in _statements(text_of(content)):
        key = words[0]
        if key == "v":
            vertices.append(words[1:])
        elif key in ("f", "fo"):
            current.append(_Face(words[1:], len(vertices)))
        elif key in names:
            names[key] = " ".join(words[1:])[:LETTERS]
            current = groups.setdefault("/".join(filter(None, names.values())), [])
        elif key in NOT_POLYGONS:
            raise NotSupported(f"The file holds {NOT_POLYGONS[key]} ({key}); export polygons.")
    points = positions(vertices)
    return [_part(name, points, faces) for name, faces in groups.items() if faces]


def _statements(text: str) -> Iterator[list[str]]:
    """Words of each line; a backslash continues a line, unless it ends a comment."""
    for line in without_comments(text).replace("\\\n", " ").split("\n"):
        if words := line.split():
            yield words


def _part(name: str, points: np.ndarray, faces: list[_Face]) -> Part:
    counts = np.array([len(face.corners) for face in faces])
    try:
        given = [int(corner.partition("/")[0]) for face in faces for corner in face.corners]
        indices = np.array(given, np.int64)
    except (ValueError, OverflowError) as problem:
        raise Unreadable(f"A face is not a list of numbers: {problem}.") from problem
    if (indices == 0).any():
        raise Unreadable("A face refers to vertex 0, but an OBJ file counts from 1.")
    before = np.repeat([face.before for face in faces], counts)
    # Numbers below 0 count backwards from the last vertex before the face.
    indices = np.where(indices < 0, indices + before, indices - 1)
    return checked(Part(name, points, triangulate(points, indices, counts)))
