"""The results and errors of all readers of mesh files."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxshape.limits import MESH_FACES

MAX_FACES = MESH_FACES
"""Largest number of triangles of one mesh, counted over all its instances in a scene."""


LETTERS = 100
"""Letters that are kept of each name that a file gives to its parts."""


class Part(NamedTuple):
    """Some of the triangles of a file, with the names that the file gives them.

    Attributes:
        name: Names of the nodes, the object or the group, joined by `/`; empty where there is none.
        vertices: Corners, in the frame and the unit of the file.
        faces: Indices into `vertices`, three for each triangle.
    """

    name: str
    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]


class Unreadable(ValueError):
    """A file breaks the rules of its format, or is not whole."""


class NotSupported(ValueError):
    """A file uses a feature of its format that is not read here."""


class TooManyFaces(ValueError):
    """A file holds more than `MAX_FACES` triangles."""


@contextmanager
def damaged_at(place: str) -> Iterator[None]:
    """Refuse a file in one sentence where a block finds a value of a wrong kind in its header.

    Args:
        place: Where the header is then damaged, such as `nodes[3]`.

    Raises:
        Unreadable: The block ended in an error that is not one of a reader.
    """
    try:
        yield
    except (Unreadable, NotSupported, TooManyFaces):
        raise
    except (TypeError, ValueError, AttributeError, LookupError, ArithmeticError) as problem:
        raise Unreadable(f"The header of the file is damaged at {place}.") from problem


def check_faces(count: int) -> None:
    """Refuse a mesh that would take too much memory.

    Args:
        count: Number of its triangles.

    Raises:
        TooManyFaces: There are more than `MAX_FACES`.
    """
    if count > MAX_FACES:
        raise TooManyFaces(f"The mesh has {count} faces, more than {MAX_FACES}.")


def text_of(content: bytes) -> str:
    """A text of any usual encoding, with lines that end in a newline alone.

    Args:
        content: UTF-8, or UTF-16 with a byte order mark; bytes that are neither become U+FFFD.
    """
    wide = content[:2] in (b"\xff\xfe", b"\xfe\xff")
    text = content.decode("utf-16" if wide else "utf-8-sig", errors="replace")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def without_comments(text: str) -> str:
    """The text without its comments, up to the end of their lines.

    A comment begins at a `#` that begins a word: Windows writes `1.#QNAN` for a number that is not
    finite.

    Args:
        text: Text with lines that end in a newline.
    """
    return re.sub(r"#(?<!\S#).*", "", text)


def positions(rows: list[list[str]]) -> Float[np.ndarray, "v 3"]:
    """Coordinates of vertices; all words after the third are ignored.

    Args:
        rows: Words of each vertex.

    Raises:
        Unreadable: A vertex is not three numbers.
    """
    try:
        return np.array([row[:3] for row in rows], np.float64).reshape(len(rows), 3)
    except ValueError as problem:
        raise Unreadable(f"A vertex is not three numbers: {problem}.") from problem


def checked(part: Part) -> Part:
    """The part with the vertices that its faces refer to, after a check that these exist.

    The parts of a file may share a list of vertices, which must not be copied for each of them.

    Args:
        part: Faces and vertices as they were read.

    Raises:
        Unreadable: A face refers to a vertex that the file does not hold.
    """
    used, faces = np.unique(part.faces, return_inverse=True)
    if len(used) and not 0 <= used[0] <= used[-1] < len(part.vertices):
        raise Unreadable("A face refers to a vertex that the file does not hold.")
    return Part(part.name, part.vertices[used], faces.reshape(-1, 3))
