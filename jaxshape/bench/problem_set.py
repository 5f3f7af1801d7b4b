"""The frozen problems: measurements of chairs and seats, and their true surfaces. [host]

A set is two files with the same stem. The `.npz` file holds the grids, packed as in a dataset. The
`.json` file holds the objects with their makers, the fingerprint of the weights, and the lowest
known objective of each problem. experiments/bench_set.py made both. A set never changes; a new set
gets a new name.
"""

import hashlib
import json
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import UInt8

from jaxshape.bench.config import FRAMES, KINDS
from jaxshape.files import atomic_path, write_json

NAME = "jaxshape-bench-1"
SHA256 = "3e51b57120826df6eca017f1be39cd830519a69e3e4ae0d22ee2529f7a5ae07b"
"""Hash of the packaged set, which every entry names (`fingerprint`)."""


class ProblemSet(NamedTuple):
    """Measurements of some objects after some numbers of frames.

    Attributes:
        name: Name of the set, with its version.
        objects: Name and source of each object.
        measured: F and M of each object and number of frames `[object number voxels]`, by kind,
            packed by `pack_measured`.
        surfaces: True surface voxels of each object `[object bytes]`, packed by `pack`.
        weights: Fingerprint of the weights whose codes are searched.
        best: The lowest known objective of each problem, in nats per voxel.
    """

    name: str
    objects: list[dict[str, Any]]
    measured: dict[str, UInt8[np.ndarray, "object number voxels"]]
    surfaces: UInt8[np.ndarray, "object bytes"]
    weights: str
    best: dict[str, float]

    def keys(self) -> list[tuple[str, int, int, str]]:
        """Name, object, index in `FRAMES`, and kind of every problem."""
        every = product(range(len(self.objects)), enumerate(FRAMES), KINDS)
        return [
            (f"{self.objects[o]['name']}/{k}/{kind}", o, place, kind)
            for o, (place, k), kind in every
        ]


def packaged_set() -> ProblemSet:
    """The set that comes with the package."""
    return read_set(Path(__file__).with_name(NAME))


def read_set(stem: Path) -> ProblemSet:
    """Read a set of problems.

    Args:
        stem: Path of its files without their suffixes.
    """
    about = json.loads(stem.with_suffix(".json").read_text(encoding="utf-8"))
    with np.load(stem.with_suffix(".npz")) as arrays:
        measured, surfaces = {kind: arrays[kind] for kind in KINDS}, arrays["surface"]
    return ProblemSet(
        stem.name, about["objects"], measured, surfaces, about["weights"], about["best"]
    )


def write_set(folder: Path, found: ProblemSet) -> None:
    """Write both files of a set; the same set gives the same bytes.

    Args:
        folder: Folder to write into.
        found: The set.
    """
    with atomic_path(folder / f"{found.name}.npz") as path:
        arrays: dict[str, Any] = {"surface": found.surfaces, **found.measured}
        np.savez_compressed(path, **arrays)
    about = {"weights": found.weights, "objects": found.objects, "best": found.best}
    write_json(folder / f"{found.name}.json", about)


def fingerprint(found: ProblemSet) -> str:
    """A hash of the content of a set, independent of the compression of its files.

    Args:
        found: The set.
    """
    arrays = [found.surfaces, *(found.measured[kind] for kind in KINDS)]
    about = json.dumps([found.name, found.weights, found.objects, found.best], sort_keys=True)
    digest = hashlib.sha256(about.encode())
    for array in arrays:
        digest.update(f"{array.shape}".encode() + array.tobytes())
    return digest.hexdigest()
