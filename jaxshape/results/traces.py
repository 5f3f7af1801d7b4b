"""The course of a search on disk, `trace.npz` of a result folder. [host]"""

import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int

from jaxshape import reading
from jaxshape.files import atomic_path
from jaxshape.search.refiner import Distribution, Trace


class TraceError(ValueError):
    """A result folder holds no trace of a search."""


class Search(NamedTuple):
    """One search of a result folder.

    Attributes:
        name: Name of the folder.
        trace: Trace of the search, NumPy arrays with one row per iteration.
        result: Content of result.json.
    """

    name: str
    trace: Trace
    result: dict[str, Any]


def write_trace(path: str | os.PathLike[str], trace: Trace) -> None:
    """Write the trace of ONE search, a row per iteration, atomically."""
    arrays: dict[str, Any] = trace._asdict()
    distribution = arrays.pop("distribution")
    arrays |= distribution._asdict() if distribution else {}
    with atomic_path(path) as temporary:
        np.savez_compressed(temporary, **arrays)


def read_trace(path: str | os.PathLike[str]) -> Trace:
    """Read what `write_trace` wrote.

    Args:
        path: The file to read.

    Raises:
        TraceError: The file is something else.
    """
    try:
        arrays: dict[str, Any] = reading.read_arrays(path)  # pyright: ignore[reportAssignmentType]
        drawn = {name: arrays.pop(name) for name in Distribution._fields if name in arrays}
        return Trace(**arrays, distribution=Distribution(**drawn) if drawn else None)
    except (OSError, ValueError, TypeError) as problem:
        raise TraceError(f"{str(path)!r} cannot be read as a trace: {problem}.") from None


def read_search(folder: str | os.PathLike[str]) -> Search:
    """Read the search of a folder made by `jaxshape reconstruct` or `jaxshape demo`.

    Args:
        folder: The result folder.

    Raises:
        TraceError: The folder is no result folder, was made before traces were kept, or holds the
            encoder's shape, which takes no search.
    """
    folder = Path(folder)
    if not (folder / "result.json").is_file():
        raise TraceError(
            f"{str(folder)!r} is not a result folder: result.json is missing. Give one made by "
            "`jaxshape reconstruct` or `jaxshape demo`."
        )
    try:
        result = reading.read_json_object(folder / "result.json")
    except (OSError, ValueError) as problem:
        raise TraceError(f"{str(folder / 'result.json')!r} is damaged: {problem}.") from None
    if result.get("method") == "encoder":
        raise TraceError(
            f"{str(folder)!r} holds the encoder's result, without a search; "
            "choose another --method to get a search that can be plotted."
        )
    if not (folder / "trace.npz").is_file():
        raise TraceError(
            f"{str(folder)!r} holds no trace.npz: an earlier version, which wrote none, made it. "
            "Make it again."
        )
    return Search(folder.resolve().name, read_trace(folder / "trace.npz"), result)


def restarts(trace: Trace) -> Int[np.ndarray, " n"]:
    """The iterations after which a population restarted: all its axes are equal again."""
    if trace.distribution is None:
        return np.zeros(0, int)
    lengths = np.asarray(trace.distribution.axis_lengths)
    is_round = lengths[:, -1] <= (1 + 1e-5) * lengths[:, 0]
    return np.flatnonzero(is_round[1:] & ~is_round[:-1]) + 1
