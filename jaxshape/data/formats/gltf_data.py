"""The numbers of a glTF file: its chunks, buffers, accessors and Draco meshes."""

import base64
import re
import urllib.parse
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxshape import reading
from jaxshape.data.formats.parts import NotSupported, Unreadable, damaged_at
from jaxshape.limits import MESH_BYTES

_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}

_JSON, _BINARY = 0x4E4F534A, 0x004E4942


class GltfFile(NamedTuple):
    """A glTF file whose buffers have been read.

    Attributes:
        header: The JSON header.
        buffers: Content of each of its buffers; None if only an extension can fill it.
    """

    header: dict[str, Any]
    buffers: list[bytes | None]

    def list(self, name: str) -> list[Any]:
        """An array of the header, such as its `nodes`; empty where it is missing."""
        entries = self.header.get(name, [])
        if not isinstance(entries, list):
            raise Unreadable(f"The header of the file is damaged at {name}, which is no list.")
        return entries

    def entry(self, name: str, index: Any) -> Any:
        """The entry of an array of the header that has an index, which is 0 or more.

        Args:
            name: Name of the array, such as `nodes`.
            index: The index, as the file gives it.

        Raises:
            Unreadable: The array has no such entry.
        """
        entries = self.list(name)
        if not isinstance(index, int) or not 0 <= index < len(entries):
            raise Unreadable(f"The file refers to {name}[{index!s:.40}], which it does not have.")
        return entries[index]

    def accessor(self, index: int) -> np.ndarray:
        """Numbers `[count width]` of an accessor; normalized integers are converted to floats."""
        about = self.entry("accessors", index)
        with damaged_at(f"accessors[{index}]"):
            return self._accessor(about, index)

    def _accessor(self, about: dict[str, Any], index: int) -> np.ndarray:
        kind, width, count = _TYPES[about["componentType"]], _WIDTHS[about["type"]], about["count"]
        if not 0 <= count * width * np.dtype(kind).itemsize <= MESH_BYTES:
            raise Unreadable(f"An accessor says that it has {count} entries.")
        if "bufferView" in about:
            values = self.view(about["bufferView"], kind, width, count, about.get("byteOffset", 0))
        elif "sparse" in about:
            values = np.zeros((count, width), kind)
        else:
            raise Unreadable(f"Accessor {index} refers to no data.")
        if "sparse" in about:
            values = self._replaced(values, about["sparse"], kind)
        if about.get("normalized"):
            values = np.maximum(values / np.float64(np.iinfo(kind).max), -1.0)
        return values

    def _replaced(self, values: np.ndarray, sparse: dict[str, Any], kind: str) -> np.ndarray:
        """The values, after the sparse replacements of the accessor."""
        places, new, count = sparse["indices"], sparse["values"], sparse["count"]
        row = self.view(
            places["bufferView"], _TYPES[places["componentType"]], 1, count,
            places.get("byteOffset", 0),
        )[:, 0]  # fmt: skip
        if len(row) and row.max() >= len(values):
            raise Unreadable("A sparse accessor replaces an entry that it does not have.")
        values = values.copy()
        values[row] = self.view(
            new["bufferView"], kind, values.shape[1], count, new.get("byteOffset", 0)
        )
        return values

    def view(self, index: int, kind: str, width: int, count: int, start: int) -> np.ndarray:
        """Numbers `[count width]` of a buffer view, from the byte `start` on."""
        content, size = self.view_bytes(index), np.dtype(kind).itemsize
        row = self.entry("bufferViews", index).get("byteStride", width * size)
        if start < 0 or row < 1 or start + (count - 1) * row + width * size > len(content):
            raise Unreadable(f"Buffer view {index} ends before the numbers that it should hold.")
        return (
            np.ndarray((count, width), kind, content, start, (row, size))
            if count
            else np.zeros((0, width), kind)
        )

    def view_bytes(self, index: int) -> bytes:
        """All bytes of a buffer view."""
        about = self.entry("bufferViews", index)
        with damaged_at(f"bufferViews[{index}]"):
            content = self.buffers[about["buffer"]]
            if "EXT_meshopt_compression" in about.get("extensions", {}) or content is None:
                raise NotSupported(
                    "The file is compressed by EXT_meshopt_compression; export it without."
                )
            start, length = about.get("byteOffset", 0), about["byteLength"]
            if start < 0 or length < 0 or start + length > len(content):
                raise Unreadable(f"Buffer view {index} reaches beyond its buffer.")
            return content[start : start + length]


def open_gltf(content: bytes, read_relative: Callable[[str], bytes]) -> GltfFile:
    """Parse a `.glb` or `.gltf` file, and read the buffers that it refers to.

    Args:
        content: All of the file.
        read_relative: Reads a file by its path relative to this one.

    Raises:
        Unreadable: The file is damaged.
        NotSupported: It is of glTF 1.
    """
    binary = None
    if content[:4] == b"glTF":
        content, binary = _chunks(content)
    try:
        header = reading.parse_json(content.decode("utf-8-sig"))
    except ValueError as problem:
        raise Unreadable(f"The header of the file cannot be read: {problem}.") from problem
    if not isinstance(header, dict):
        raise Unreadable("The file is no glTF: its JSON is no object.")
    with damaged_at("asset"):
        version = str(header.get("asset", {}).get("version", "2.0"))
    if not version.startswith("2."):
        raise NotSupported(f"The file is of glTF {version}; export glTF 2.0.")
    file = GltfFile(header, [])
    for i, about in enumerate(file.list("buffers")):
        with damaged_at(f"buffers[{i}]"):
            uri, length = about.get("uri"), about["byteLength"]
            inside = _inside(uri, binary if i == 0 else None)
        if inside is None and uri is not None:
            inside = read_buffer(uri, read_relative)
        with damaged_at(f"buffers[{i}]"):
            if inside is not None and len(inside) < length:
                raise Unreadable(f"A buffer has {len(inside)} bytes, but the file says {length}.")
        file.buffers.append(inside)
    return file


def _chunks(content: bytes) -> tuple[bytes, bytes | None]:
    """The JSON and the binary chunk of a `.glb` file."""
    version, length = (int.from_bytes(content[i : i + 4], "little") for i in (4, 8))
    if version == 1:
        raise NotSupported("The file is of glTF 1; export glTF 2.0.")
    if version != 2:
        raise Unreadable(f"The file is of glTF {version}, which does not exist.")
    if length > len(content):
        raise Unreadable(f"The file says {length} bytes, but has {len(content)}.")
    chunks, start = {}, 12
    while start + 8 <= length:
        size, kind = (int.from_bytes(content[i : i + 4], "little") for i in (start, start + 4))
        if start + 8 + size > length:
            raise Unreadable("A chunk of the file is not whole.")
        chunks.setdefault(kind, content[start + 8 : start + 8 + size])
        start += 8 + size
    if _JSON not in chunks:
        raise Unreadable("The file has no JSON chunk.")
    return chunks[_JSON], chunks.get(_BINARY)


def _inside(uri: str | None, binary: bytes | None) -> bytes | None:
    """The content of a buffer that is inside the file.

    None for a buffer in another file, and for a placeholder for data that an extension unpacks.
    """
    if uri is None:
        return binary
    if not uri.startswith("data:"):
        return None
    head, _, text = uri.partition(",")
    raw = urllib.parse.unquote_to_bytes(text)
    return base64.b64decode(raw) if head.endswith(";base64") else raw


def referred(content: bytes) -> list[str]:
    """Names of the files that a `.gltf` or `.glb` file refers to for its shapes, as it states them;
    none for any other file.

    Args:
        content: All of the file.
    """
    try:
        if content[:4] == b"glTF":
            content, _ = _chunks(content)
        if not re.match(rb"(\xef\xbb\xbf)?\s*\{", content):
            return []
        header = reading.parse_json(content.decode("utf-8-sig"))
        uris = [about.get("uri", "data:") for about in header.get("buffers", [])]
        return [uri for uri in uris if not uri.startswith("data:")]
    except (ValueError, TypeError, AttributeError):  # the reader of the file reports this
        return []


def read_buffer(uri: str, read_relative: Callable[[str], bytes]) -> bytes:
    """Read a file next to the mesh: `with%20space.bin` is `with space.bin`.

    Args:
        uri: Name of the file, as the mesh states it.
        read_relative: Reads a file by its path relative to the mesh.
    """
    name = urllib.parse.unquote(uri)
    try:
        return read_relative(name)
    except (FileNotFoundError, KeyError):
        if name == uri:
            raise
        return read_relative(uri)  # some writers do not encode names


def draco_mesh(
    file: GltfFile, primitive: dict[str, Any]
) -> tuple[dict[str, np.ndarray], np.ndarray] | None:
    """Attributes and triangles of a primitive that is compressed by Draco; None if it is not.

    Args:
        file: The file.
        primitive: The JSON description of the primitive.

    Raises:
        NotSupported: The library that decodes it is missing.
    """
    about = primitive.get("extensions", {}).get("KHR_draco_mesh_compression")
    if about is None:
        return None
    try:
        import DracoPy  # pyright: ignore[reportMissingImports]
    except ImportError as problem:
        raise NotSupported(
            "The file is compressed by Draco; pip install 'jaxshape[draco]' to read it."
        ) from problem
    decoded: Any = DracoPy.decode(file.view_bytes(about["bufferView"]))
    given = {one["unique_id"]: np.asarray(one["data"]) for one in decoded.attributes}
    attributes = {}
    for name, number in about["attributes"].items():
        values = given[number].reshape(len(given[number]), -1)
        accessor = file.entry("accessors", primitive["attributes"][name])
        if accessor.get("normalized"):
            limit = np.float64(np.iinfo(_TYPES[accessor["componentType"]]).max)
            values = np.maximum(values / limit, -1.0)
        attributes[name] = values
    return attributes, np.asarray(decoded.faces, np.int64).reshape(-1, 3)
