"""Point clouds of the Point Cloud Library: ascii, binary and binary_compressed. [host]"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxshape import limits

_ENTRIES = ("FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
_KINDS = ("F4", "F8", "I1", "I2", "I4", "I8", "U1", "U2", "U4", "U8")
"""Types of numbers, each with its size in bytes."""


class Columns(NamedTuple):
    """The fields of a file.

    Attributes:
        values: The numbers of each field `[n]`, by its name.
        viewpoint: Position of the sensor `[3]`; None if the file does not give it, or gives the
            default, the origin, or numbers that are not finite.
    """

    values: dict[str, Float[np.ndarray, " n"]]
    viewpoint: Float[np.ndarray, " 3"] | None


def parse_pcd(content: bytes) -> Columns:
    """Read the fields of a PCD file, as float64.

    Args:
        content: The whole file.

    Raises:
        ValueError: The file is damaged, or a field has several numbers of each point that are used.
    """
    header, body = _header(content)
    names, counts, kinds = header["FIELDS"], _counts(header), _kinds(header)
    width, height = (int(header.get(name, ["1"])[0]) for name in ("WIDTH", "HEIGHT"))
    count = int(header["POINTS"][0]) if "POINTS" in header else width * height
    if not 0 <= count <= limits.CLOUD_POINTS:
        raise ValueError(f"it holds {count} points; expected 0 to {limits.CLOUD_POINTS}")
    row = np.dtype(
        [(str(i), kind, (n,)) for i, (kind, n) in enumerate(zip(kinds, counts, strict=True))]
    )
    how = header["DATA"][0].lower()
    if how == "ascii":
        columns = _ascii(body, counts, count)
    elif how == "binary":
        size = row.itemsize * count
        if len(body) < size or body[size:].strip(b"\0 \t\r\n"):
            raise ValueError(f"{len(body)} bytes follow its header; expected {size}")
        table = np.frombuffer(body, row, count)
        columns = [table[str(i)] for i in range(len(names))]
    elif how == "binary_compressed":
        columns = _by_columns(_unpacked(body, row.itemsize * count), row, count)
    else:
        raise ValueError(f"its data are {how!r}; expected ascii, binary or binary_compressed")
    values = {
        name.lower(): column[:, 0].astype(np.float64)
        for name, column, n in zip(names, columns, counts, strict=True)
        if n == 1
    }
    place = np.array([float(word) for word in header.get("VIEWPOINT", ["0"] * 3)[:3]])
    is_known = place.shape == (3,) and place.any() and np.isfinite(place).all()
    return Columns(values, place if is_known else None)


def _header(content: bytes) -> tuple[dict[str, list[str]], bytes]:
    """The entries of the header, and the bytes after it."""
    header: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in header:
        end = content.find(b"\n", start)
        if end < 0 or start > 10_000:
            raise ValueError("its header does not end in a line DATA")
        words = content[start:end].decode("latin-1").split()
        start = end + 1
        if words and words[0] in _ENTRIES and len(words) > 1:
            header[words[0]] = words[1:]
    if missing := [name for name in ("FIELDS", "SIZE", "TYPE", "WIDTH") if name not in header]:
        raise ValueError(f"its header has no line {missing[0]}")
    return header, content[start:]


def _kinds(header: dict[str, list[str]]) -> list[str]:
    kinds = [kind + size for kind, size in zip(header["TYPE"], header["SIZE"], strict=True)]
    if unknown := [kind for kind in kinds if kind not in _KINDS]:
        raise ValueError(f"a field is of type {unknown[0]}; expected one of {', '.join(_KINDS)}")
    return [f"<{kind.lower()}" for kind in kinds]


def _counts(header: dict[str, list[str]]) -> list[int]:
    counts = [int(word) for word in header.get("COUNT", ["1"] * len(header["FIELDS"]))]
    if {len(header[name]) for name in ("FIELDS", "SIZE", "TYPE")} != {len(counts)}:
        raise ValueError("its header gives another number of sizes, types or counts than of fields")
    used = [name.lower() for name in header["FIELDS"] if name != "_"]  # which is padding
    if len(set(used)) < len(used):
        raise ValueError("its header names a field twice")
    if min(counts) < 1 or max(counts) > 10_000:
        raise ValueError(f"its fields hold {counts} numbers")
    return counts


# Data ------------------------------------------------------------------------------------------


def _ascii(body: bytes, counts: list[int], count: int) -> list[np.ndarray]:
    if len(body) > limits.CLOUD_TEXT_BYTES:
        raise ValueError("it has too many points for a text; save it as binary")
    table = np.array(body.split(), dtype=np.float64)
    width = sum(counts)
    if len(table) != width * count:
        raise ValueError(
            f"it holds {len(table)} numbers; expected {width} of each of {count} points"
        )
    return np.split(table.reshape(count, width), np.cumsum(counts)[:-1], axis=1)


def _by_columns(content: bytes, row: np.dtype, count: int) -> list[np.ndarray]:
    """Split the content into fields that are stored one after the other, each for all points."""
    columns, start = [], 0
    for i in range(len(row.names or ())):
        field = row[i]
        columns.append(np.frombuffer(content, field, count, start))
        start += field.itemsize * count
    return columns


def _unpacked(body: bytes, size: int) -> bytes:
    """Decompress a block: its packed and its real size, then runs and references of LZF."""
    packed, real = np.frombuffer(body, "<u4", 2)
    if real != size or size > limits.MESH_BYTES:
        raise ValueError(f"its block holds {real} bytes; expected {size}")
    source, out, i = memoryview(body)[8 : 8 + int(packed)], bytearray(), 0
    while i < len(source) and len(out) <= size:
        control = source[i]
        i += 1
        if control < 32:  # literal bytes
            out += source[i : i + control + 1]
            i += control + 1
            continue
        length = control >> 5
        if length == 7:
            length += source[i]
            i += 1
        first = len(out) - ((control & 31) << 8) - source[i] - 1
        i += 1
        if first < 0:
            raise ValueError("its block refers to bytes before its start")
        part = bytes(out[first : first + length + 2])
        # A reference may overlap the bytes that it writes; it then repeats them.
        out += (part * (-(-(length + 2) // len(part))))[: length + 2]
    if len(out) != size:
        raise ValueError(f"its block unpacks to {len(out)} bytes; expected {size}")
    return bytes(out)
