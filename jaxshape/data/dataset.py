"""Training pairs on disk: measurements of many objects, and their complete surfaces. [host]

A dataset is a folder of shards of up to `OBJECTS_PER_SHARD` objects. For each object and camera
path, a shard holds the complete surface **Y** in bit-packed grids `[object path bytes]`, and the
measurement after each number of frames, `[object path number voxels]`. A voxel takes one byte: 4
bits for the probability of surface and 4 for the probability of free space, in fifteenths. A
`.json` file of the same name lists the objects, the skipped ones, and digests of their files.

`building` makes datasets; this module packs the pairs of one object and reads finished datasets.
"""

import gc
import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, overload

import jax
import numpy as np
import trimesh
from jaxtyping import Bool, UInt8

from jaxshape import limits, reading
from jaxshape.data import meshes
from jaxshape.data.archives import MeshSource
from jaxshape.data.config import DatasetConfig, UnitName
from jaxshape.data.families import Procedural
from jaxshape.data.meshes import Model, Skipped
from jaxshape.data.paths import draw_path
from jaxshape.geometry.grids import Grids

FORMAT = "jaxshape-dataset-2"

KINDS = ("surface", "measured")
"""Arrays of a shard, each in a separate file."""

OBJECTS_PER_SHARD = 64

STEPS = 15
"""Quantisation steps of the measured probabilities, which have 4 bits each."""

ATTEMPTS = 3
"""Number of times that a path is drawn if nothing is measured along it."""

Object = Procedural | MeshSource
"""An object of a dataset: a procedural one, or a mesh file."""


class DatasetError(ValueError):
    """A dataset folder cannot be read or continued."""


# ------------------------------------------------------------------ one object


def load_object(
    item: Object, *, up: str = "y", front: str = "z", unit: UnitName = "m"
) -> Model | Skipped:
    """Make or read one object in the canonical frame."""
    if isinstance(item, MeshSource):
        return meshes.load(item, up=up, front=front, unit=unit)
    return Model(item.name, item.make(), {})


class LoadedWhenNeeded(Sequence[Model | Skipped]):
    """Objects of which none stays in memory: each is made or read whenever it is asked for.

    The parts of a mesh refer to each other in cycles, and Python looks for unused cycles rarely
    where JAX holds many objects. So earlier meshes are freed before others are read.
    """

    def __init__(
        self, items: Sequence[Object], *, up: str = "y", front: str = "z", unit: UnitName = "m"
    ):
        self._items = items
        self._load = partial(load_object, up=up, front=front, unit=unit)

    def __len__(self) -> int:
        return len(self._items)

    @overload
    def __getitem__(self, index: int) -> Model | Skipped: ...
    @overload
    def __getitem__(self, index: slice) -> list[Model | Skipped]: ...
    def __getitem__(self, index: int | slice) -> Model | Skipped | list[Model | Skipped]:
        gc.collect()
        if isinstance(index, slice):
            return [self._load(item) for item in self._items[index]]
        return self._load(self._items[index])


def object_paths(
    mesh: trimesh.Trimesh, config: DatasetConfig, seed: int
) -> tuple[UInt8[np.ndarray, "path bytes"], UInt8[np.ndarray, "path number voxels"]] | None:
    """The complete surface and the measurements of one object along each path, packed; None if a
    camera measures nothing along a whole path in `ATTEMPTS` draws."""
    drawn = [_drawn(mesh, config, (seed, i)) for i in range(config.paths)]
    paths = [path for path in drawn if path is not None]
    if len(paths) < len(drawn):
        return None
    return pack(np.stack([surface for surface, _ in paths])), np.stack([m for _, m in paths])


def _drawn(
    mesh: trimesh.Trimesh, config: DatasetConfig, seed: tuple[int, int]
) -> tuple[Bool[np.ndarray, "x y z"], UInt8[np.ndarray, "number voxels"]] | None:
    for attempt in range(ATTEMPTS):
        path = draw_path(mesh, config, hash_seed(*seed, *[attempt] * (attempt > 0)))
        measured = pack_measured(jax.device_get(path.measured))
        if (measured[-1] > STEPS).any():  # after all frames, some voxel may be surface
            return np.asarray(path.surface), measured
    return None


def pack_measured(grids: Grids) -> UInt8[np.ndarray, "*batch voxels"]:
    """Binary or soft F and M with two probabilities in each byte, in fifteenths."""
    F, M = (np.asarray(x, np.float32) for x in grids[:2])
    surface = np.rint(STEPS * F * (1 - M)).astype(np.uint8)
    free = np.minimum(np.rint(STEPS * (1 - F) * (1 - M)), STEPS - surface).astype(np.uint8)
    return (16 * surface + free).reshape(*F.shape[:-3], -1)


def unpack_measured(packed: UInt8[np.ndarray, "*batch voxels"]) -> Grids:
    """The soft F and M `[*batch x y z]`, float32, that were packed."""
    surface, free = packed // 16, packed % 16
    known = surface + free
    side = round(packed.shape[-1] ** (1 / 3))
    F, M = np.float32(surface / np.maximum(known, 1)), np.float32(1 - known / STEPS)
    return Grids(*(x.reshape(*packed.shape[:-1], side, side, side) for x in (F, M)))


def pack(grids: Bool[np.ndarray, "*batch x y z"]) -> UInt8[np.ndarray, "*batch bytes"]:
    """Pack grids with eight voxels in a byte: 4 KiB for a grid of 32^3."""
    return np.packbits(grids.reshape(*grids.shape[:-3], -1), axis=-1)


def unpack(packed: UInt8[np.ndarray, "*batch bytes"]) -> Bool[np.ndarray, "*batch x y z"]:
    """The grids that were packed."""
    grids = np.unpackbits(packed, axis=-1).astype(bool)
    return grids.reshape(*packed.shape[:-1], *[_side(packed)] * 3)


def _side(packed: UInt8[np.ndarray, "*batch bytes"]) -> int:
    """Voxels along each axis of the grids that were packed."""
    return round((8 * packed.shape[-1]) ** (1 / 3))


def hash_seed(*numbers: int) -> int:
    """A seed below 2^31 from a tuple of numbers; similar tuples give unrelated seeds."""
    return int(np.random.SeedSequence(numbers).generate_state(1)[0] >> 1)


def shard_path(folder: Path, number: int, suffix: str) -> Path:
    """A file of a shard.

    Args:
        folder: Folder of the dataset.
        number: Number of the shard, from 0.
        suffix: "json", or a kind of array and "npy".
    """
    return folder / f"shard-{number:05d}.{suffix}"


# ------------------------------------------------------------------ reading


class Dataset(NamedTuple):
    """Objects of a dataset folder; they stay on disk until they are requested.

    Attributes:
        names: Names of the objects.
        surfaces: Memory-mapped complete surfaces of each shard `[object path bytes]`, packed.
        measured: Memory-mapped measurements of each shard `[object path number voxels]`, packed.
        row: Shard of each object, and its row in the shard.
    """

    names: list[str]
    surfaces: list[UInt8[np.ndarray, "object path bytes"]]
    measured: list[UInt8[np.ndarray, "object path number voxels"]]
    row: list[tuple[int, int]]

    @property
    def resolution(self) -> int:
        """Voxels along each axis of the grids."""
        return _side(self.surfaces[0])

    def surface(self, index: int, path: int = 0) -> Bool[np.ndarray, "x y z"]:
        """The complete surface of an object along one of its paths."""
        shard, place = self.row[index]
        return unpack(self.surfaces[shard][place, path])

    def inputs_of(self, index: int) -> tuple[int, int]:
        """Number of paths of an object, and of measurements of each path."""
        return self.measured[self.row[index][0]].shape[1:3]

    def grids(self, index: int, path: int, number: int) -> Grids:
        """Soft F and M of an object along one of its paths; `number` is an index of `frames`."""
        shard, place = self.row[index]
        return unpack_measured(self.measured[shard][place, path, number])


def surfaces(dataset: Dataset, limit: int = 4096) -> Bool[np.ndarray, "n x y z"]:
    """The complete surfaces of a dataset, at most `limit` of them, evenly chosen."""
    count = len(dataset.names)
    chosen = np.unique(np.linspace(0, count - 1, min(count, limit)).astype(int))
    return np.stack([dataset.surface(i) for i in chosen])


def open_dataset(folder: str | os.PathLike[str]) -> Dataset:
    """Open a finished dataset.

    Args:
        folder: Folder of the dataset.

    Raises:
        DatasetError: There is no dataset, or a part of it is missing or damaged.
    """
    folder = Path(folder)
    if not (folder / "dataset.json").exists():
        raise DatasetError(f"There is no dataset in {str(folder)!r}; make one: jaxshape dataset.")
    claim = read_part(folder / "dataset.json")
    if claim.get("format") != FORMAT:
        raise DatasetError(
            f"{str(folder)!r} holds a dataset of an earlier version of jaxshape; build it again: "
            "jaxshape dataset."
        )
    count = claim.get("objects")
    if not isinstance(count, int) or not 0 < count <= limits.OBJECTS:
        raise DatasetError(f"{str(folder)!r} is damaged: it claims {count!r} objects.")
    expected = -(-count // OBJECTS_PER_SHARD)
    missing = [n for n in range(expected) if not shard_path(folder, n, "json").exists()]
    if missing:
        raise DatasetError(
            f"{len(missing)} of the {expected} shards of {str(folder)!r} are missing; "
            "run the same `jaxshape dataset` command again to finish it."
        )
    names, row = [], []
    arrays: dict[str, list[np.ndarray]] = {kind: [] for kind in KINDS}
    for number in range(expected):
        about, found = open_shard(folder, number)
        names += about["names"]
        row += [(number, place) for place in range(len(about["names"]))]
        for kind in KINDS:
            arrays[kind].append(found[kind])
    if not names:
        raise DatasetError(f"Every object of the dataset in {str(folder)!r} was skipped.")
    return Dataset(names, arrays["surface"], arrays["measured"], row)


def open_shard(folder: Path, number: int) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The content of the JSON file of a shard, and its memory-mapped arrays by kind.

    Args:
        folder: Folder of the dataset.
        number: Number of the shard.

    Raises:
        DatasetError: A file is missing or damaged, or they do not belong together.
    """
    path = shard_path(folder, number, "json")
    about = read_part(path)
    names = about.get("names")
    if not (isinstance(names, list) and all(isinstance(name, str) for name in names)):
        raise _damaged(path, "it has no names of objects")
    surface, measured = (_mapped(shard_path(folder, number, f"{kind}.npy")) for kind in KINDS)
    for kind, array, axes in (("surface", surface, 3), ("measured", measured, 4)):
        if array.dtype != np.uint8 or array.ndim != axes or len(array) != len(names):
            raise _damaged(
                shard_path(folder, number, f"{kind}.npy"),
                f"it holds {array.shape} {array.dtype}, its shard has {len(names)} objects",
            )
    if measured.shape[1::2] != (surface.shape[1], 8 * surface.shape[2]):
        raise _damaged(path, f"its arrays have shapes {surface.shape} and {measured.shape}")
    return about, {"surface": surface, "measured": measured}


def read_part(path: Path) -> dict[str, Any]:
    """The object in a JSON file of a dataset.

    Args:
        path: The file.

    Raises:
        DatasetError: It cannot be read.
    """
    try:
        return reading.read_json_object(path)
    except (OSError, ValueError) as problem:
        raise _damaged(path, problem) from None


def _mapped(path: Path) -> np.ndarray:
    try:
        return np.lib.format.open_memmap(path, mode="r")
    except (OSError, ValueError, EOFError) as problem:
        raise _damaged(path, problem) from None


def _damaged(path: Path, problem: Any) -> DatasetError:
    return DatasetError(
        f"{str(path)!r} is damaged ({problem}); remove it and build the dataset again."
    )
