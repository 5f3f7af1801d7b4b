"""PLY as text and binary: polygons and triangle strips, of any number of corners."""

import re
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxshape.data.formats.parts import NotSupported, Part, Unreadable
from jaxshape.data.formats.polygons import triangulate

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
    "int64": "i8", "uint64": "u8", "float16": "f2",
}  # fmt: skip

_CORNERS = ("vertex_indices", "vertex_index")

_END = re.compile(rb"[\r\n]end_header[ \t]*(\r\n|\r|\n)")


class _Property(NamedTuple):
    """A property of an element.

    Attributes:
        name: Its name.
        type: NumPy's name of the type of its numbers.
        count: NumPy's name of the type of a list's length; None for a single number.
    """

    name: str
    type: str
    count: str | None


class _Element(NamedTuple):
    """An element of the file: a table.

    Attributes:
        name: Its name, such as `vertex`.
        length: Number of its rows.
        properties: Its columns.
    """

    name: str
    length: int
    properties: list[_Property]


class PlyFile(NamedTuple):
    """The content of a PLY file.

    Attributes:
        vertices: Positions of the vertices.
        faces: Its polygons and strips as triangles: indices into `vertices`.
        columns: All properties of the vertices, by name: numbers `[v]`; a list has its numbers and
            their number for each vertex.
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    columns: dict[str, Any]


def read_ply(content: bytes) -> list[Part]:
    """The polygons of a PLY file as triangles; raises as `parse_ply` does.

    Args:
        content: Content of the file.
    """
    file = parse_ply(content)
    return [Part("", file.vertices, file.faces)]


def parse_ply(content: bytes) -> PlyFile:
    """The vertices of a PLY file with all their properties, and its polygons as triangles.

    Args:
        content: Content of the file.

    Raises:
        Unreadable: The file is damaged, or does not hold as much as its header says.
        NotSupported: The surface is in elements that are not read.
        TooManyFaces: There are too many triangles.
    """
    encoding, elements, data = _header(content)
    order = {"binary_big_endian": ">", "binary_little_endian": "<"}.get(encoding)
    if order is None:  # numbers in text are converted to binary ones of eight bytes
        elements, data, order = _from_text(elements, data)
    columns, offset = {}, 0
    for element in elements:
        columns[element.name], offset = _read(element, data, offset, order)
    if data[offset:].strip(b"\0 \t\r\n"):
        raise Unreadable(f"{len(data) - offset} bytes follow that the header does not mention.")
    try:
        vertices = np.stack([columns["vertex"][axis] for axis in "xyz"], axis=1)
    except KeyError as problem:
        raise Unreadable(f"The file has no {problem}.") from problem
    vertices = vertices.astype(np.float64)
    faces = triangulate(vertices, *_polygons(elements, columns))
    return PlyFile(vertices, faces, columns["vertex"])


def _header(content: bytes) -> tuple[str, list[_Element], bytes]:
    """Encoding and elements of the file, and the bytes after its header."""
    end = _END.search(content)
    head = content[: end.start()] if end else b""
    lines = [line.split() for line in head.decode("latin-1").splitlines()]
    if not end or not lines or lines[0] != ["ply"]:
        raise Unreadable("The file has no header of a PLY file.")
    encoding, elements = "", []
    try:
        for words in filter(None, lines[1:]):
            if words[0] == "format":
                encoding = words[1]
            elif words[0] == "element":
                elements.append(_Element(words[1], int(words[2]), []))
            elif words[:2] == ["property", "list"]:
                count, kind, name = _TYPES[words[2]], _TYPES[words[3]], words[4]
                elements[-1].properties.append(_Property(name, kind, count))
            elif words[0] == "property":
                elements[-1].properties.append(_Property(words[2], _TYPES[words[1]], None))
    except (KeyError, IndexError, ValueError) as problem:
        raise Unreadable(f"The header has a line that is not understood: {words}.") from problem
    if encoding not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise Unreadable(f"The file is of the unknown format {encoding!r}.")
    if any(element.length < 0 for element in elements):
        raise Unreadable("The header gives a number of elements below 0.")
    if len({element.name for element in elements}) < len(elements):
        raise Unreadable("The header has two elements of one name.")
    return encoding, elements, content[end.end() :]


def _from_text(elements: list[_Element], data: bytes) -> tuple[list[_Element], bytes, str]:
    def wide(one: _Property) -> _Property:
        return _Property(one.name, "f8", one.count and "f8")

    try:
        numbers = np.array(data.split(), np.float64).astype("<f8").tobytes()
    except ValueError as problem:
        raise Unreadable(f"The file holds a word that is not a number: {problem}.") from problem
    wider = [e._replace(properties=[wide(one) for one in e.properties]) for e in elements]
    return wider, numbers, "<"


def _read(element: _Element, data: bytes, offset: int, order: str) -> tuple[dict[str, Any], int]:
    """Columns of an element (for lists: numbers and lengths), and the offset of its end."""
    if element.length == 0:
        return {}, offset
    if not element.properties:
        raise Unreadable(f"The element {element.name!r} has no properties.")
    kind = _row_type(element, data, offset, order)
    end = offset + element.length * kind.itemsize
    if end <= len(data):
        rows = np.frombuffer(data, kind, element.length, offset)
        lists = [one.name for one in element.properties if one.count]
        if all((rows[f"{name} count"] == rows[name].shape[-1]).all() for name in lists):
            return {one.name: _column(rows, one) for one in element.properties}, end
    return _read_rows(element, data, offset, order)


def _column(rows: np.ndarray, one: _Property) -> Any:
    if one.count is None:
        return rows[one.name]
    return rows[one.name].ravel(), rows[f"{one.name} count"].astype(np.int64)


def _row_type(element: _Element, data: bytes, offset: int, order: str) -> np.dtype:
    """Type of a row of an element, if all rows have lists as long as the first row."""
    fields: list[Any] = []
    for one in element.properties:
        if one.count:
            at = offset + np.dtype(fields).itemsize if fields else offset
            length = _length(data, at, order + one.count)
            fields.append((f"{one.name} count", order + one.count))
            fields.append((one.name, order + one.type, (length,)))
        else:
            fields.append((one.name, order + one.type))
    return np.dtype(fields)


def _length(data: bytes, offset: int, kind: str) -> int:
    size = np.dtype(kind).itemsize
    if offset + size > len(data):
        raise Unreadable("The file holds less than its header says.")
    length = int(np.frombuffer(data, kind, 1, offset)[0])
    if not 0 <= length <= len(data):
        raise Unreadable(f"A list of the file says that it has {length} entries.")
    return length


def _read_rows(
    element: _Element, data: bytes, offset: int, order: str
) -> tuple[dict[str, Any], int]:
    """The columns of an element with lists of different lengths, read row by row."""
    found: dict[str, list[Any]] = {one.name: [] for one in element.properties}
    for _ in range(element.length):
        for one in element.properties:
            length = 1
            if one.count:
                length = _length(data, offset, order + one.count)
                offset += np.dtype(one.count).itemsize
            size = length * np.dtype(one.type).itemsize
            if offset + size > len(data):
                raise Unreadable(f"The file ends before all {element.length} of {element.name!r}.")
            found[one.name].append(np.frombuffer(data, order + one.type, length, offset))
            offset += size
    return {
        one.name: (
            np.concatenate(found[one.name]),
            np.array([len(row) for row in found[one.name]], np.int64),
        )
        if one.count
        else np.concatenate(found[one.name])
        for one in element.properties
    }, offset


def _polygons(
    elements: list[_Element], columns: dict[str, dict[str, Any]]
) -> tuple[np.ndarray, np.ndarray]:
    """Corners of all polygons of the file, and their number in each."""
    indices, counts = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for element in elements:
        if element.length == 0:
            continue
        names = [one.name for one in element.properties if one.count and one.name in _CORNERS]
        corners = [columns[element.name][name] for name in names]
        has_faces = element.name in ("face", "tristrips")
        if not has_faces and all(lengths.max() < 3 for _, lengths in corners):
            continue  # a range scan lists the vertex of each cell of its grid
        if not has_faces or not corners:
            raise NotSupported(f"The surface is in {element.name!r}; export faces with corners.")
        flat, lengths = corners[0]
        flat = flat.astype(np.int64)
        if element.name == "tristrips":
            flat = _strips(flat, lengths)
            lengths = np.full(len(flat) // 3, 3)
        indices.append(flat)
        counts.append(lengths)
    return np.concatenate(indices), np.concatenate(counts)


def _strips(flat: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Corners of the triangles of strips; -1 ends a strip."""
    triangles = [np.zeros(0, np.int64)]
    for row in np.split(flat, np.cumsum(lengths)[:-1]):
        for strip in np.split(row, np.flatnonzero(row < 0)):
            triangles.append(strip_triangles(strip[strip >= 0]).ravel())
    return np.concatenate(triangles)


def strip_triangles(strip: np.ndarray) -> np.ndarray:
    """Triangles `[f 3]` of a strip, all oriented like the first.

    Args:
        strip: Corners `[n]`; every three neighbours form a triangle.
    """
    i = np.arange(max(len(strip) - 2, 0))
    return strip[np.stack([i, i + 1 + i % 2, i + 2 - i % 2], axis=1)]
