"""Training pairs on disk: partial views and complete surfaces of many objects. [host]

A dataset is a folder of shards. A shard holds up to `OBJECTS_PER_SHARD` objects in one `.npy` of
bit-packed grids, `[object, 1 + view, bytes]`, where entry 0 is the complete surface **Y** and
the others are the measurements **F** of one frame each; a `.json` beside it names its objects and
what was skipped. Shards are written whole or not at all, so a killed build goes on where it
stopped, and a finished one has nothing left to do.
"""

import hashlib
import json
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import trimesh
from jaxtyping import Array, Bool, UInt8

from jaxshape.data import meshes
from jaxshape.data.archives import MeshSource
from jaxshape.data.capture import Capture, camera_distance, capture, measure_frames
from jaxshape.data.chairs import random_chair
from jaxshape.data.config import DatasetConfig
from jaxshape.data.meshes import Model, Skipped
from jaxshape.files import atomic_path, write_json
from jaxshape.geometry import camera, fusion

OBJECTS_PER_SHARD = 64

TEST_SEEDS = 1_000_000
"""Procedural chairs from this seed on are for tests; training uses smaller ones."""

Object = int | MeshSource
"""An object of a dataset: the seed of a procedural chair, or a mesh file."""


class DatasetError(ValueError):
    """A dataset folder cannot be read or continued."""


class BuildProgress(NamedTuple):
    """Progress of a build.

    Attributes:
        objects: Objects that are done, skipped ones included.
        total: Objects in all.
        skipped: Objects that could not be used.
    """

    objects: int
    total: int
    skipped: list[Skipped]


# ------------------------------------------------------------------ one object


def load_object(item: Object, *, up: str = "y", front: str = "z") -> Model | Skipped:
    """Make or read one object in the canonical frame."""
    if isinstance(item, MeshSource):
        return meshes.load(item, up=up, front=front)
    return Model(f"chair-{item}", random_chair(item), {})


def training_grids(
    mesh: trimesh.Trimesh, config: DatasetConfig, seed: int
) -> UInt8[np.ndarray, "n bytes"]:
    """The complete surface of one object and its views, packed."""
    key = jax.random.key(seed)
    T_object_camera = camera.random_views(key, config.views, camera_distance(mesh))
    captured = capture(
        mesh,
        T_object_camera,
        noise=_draws_noise(config, seed),
        seed=seed,
        resolution=config.resolution,
    )
    views = _occupied_by_frame(captured)
    return pack(np.concatenate([np.asarray(captured.surface)[None], np.asarray(views)]))


def is_noisy(index: int, config: DatasetConfig) -> bool:
    """Whether the depth images of an object, by its place among all, have a sensor's faults."""
    return _draws_noise(config, _object_seed(config, index))


def _object_seed(config: DatasetConfig, index: int) -> int:
    return hash_seed(config.seed, index)


def _draws_noise(config: DatasetConfig, seed: int) -> bool:
    return bool(np.random.default_rng(seed).random() < config.noisy)


@jax.jit
def _occupied_by_frame(captured: Capture) -> Bool[Array, "views x y z"]:
    """The measurement **F** of each frame alone; jit leaves out what it does not need."""
    return fusion.occupied(measure_frames(captured))


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


# ------------------------------------------------------------------ writing


def build_dataset(
    folder: str | os.PathLike[str],
    objects: Sequence[Object],
    config: DatasetConfig = DatasetConfig(),
    *,
    workers: int | None = None,
) -> Iterator[BuildProgress]:
    """Write the missing shards of a dataset in parallel processes.

    Args:
        folder: Folder of the dataset; made if missing.
        objects: Seeds of procedural chairs, or meshes.
        config: Settings of the dataset.
        workers: Processes, 1 or more; None for one for each CPU core.

    Yields:
        The progress, at first and after each shard.

    Raises:
        DatasetError: The folder holds a dataset of other objects or settings.
    """
    folder = Path(folder)
    _claim(folder, objects, config)
    starts = range(0, len(objects), OBJECTS_PER_SHARD)
    shards = [(n, objects[s : s + OBJECTS_PER_SHARD]) for n, s in enumerate(starts)]
    missing = [shard for shard in shards if not _shard_path(folder, shard[0], "json").exists()]
    done = sum(len(items) for _, items in shards) - sum(len(items) for _, items in missing)
    skipped = [s for n, _ in shards if (n, _) not in missing for s in _read_names(folder, n)[1]]
    yield BuildProgress(done, len(objects), skipped)
    if not missing:
        return
    write = partial(_write_shard, folder, config)
    workers = min(workers or os.cpu_count() or 1, len(missing))
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        futures = {pool.submit(write, *shard): shard for shard in missing}
        for future in as_completed(futures):
            skipped = skipped + future.result()
            done += len(futures[future][1])
            yield BuildProgress(done, len(objects), skipped)


def _write_shard(
    folder: Path, config: DatasetConfig, number: int, items: Sequence[Object]
) -> list[Skipped]:
    names, grids, skipped = [], [], []
    for i, item in enumerate(items):
        model = load_object(item, up=config.up, front=config.front)
        if isinstance(model, Skipped):
            skipped.append(model)
            continue
        seed = _object_seed(config, number * OBJECTS_PER_SHARD + i)
        names.append(model.name)
        grids.append(training_grids(model.mesh, config, seed))
    shape = (0, 1 + config.views, config.resolution**3 // 8)
    with atomic_path(_shard_path(folder, number, "npy")) as path:
        np.save(path, np.stack(grids) if grids else np.zeros(shape, np.uint8))
    # The names come last: a shard counts as written once they are there.
    write_json(_shard_path(folder, number, "json"), {"names": names, "skipped": skipped})
    return skipped


def hash_seed(*numbers: int) -> int:
    """A seed below 2^31 for each tuple of numbers, unrelated between neighbours."""
    return int(np.random.SeedSequence(numbers).generate_state(1)[0] >> 1)


def _claim(folder: Path, objects: Sequence[Object], config: DatasetConfig) -> None:
    names = [item.name if isinstance(item, MeshSource) else str(item) for item in objects]
    digest = hashlib.sha256("\n".join(names).encode()).hexdigest()
    claim = {"config": asdict(config), "objects": len(names), "names_sha256": digest}
    path = folder / "dataset.json"
    if path.exists():
        if _of_today(json.loads(path.read_text())) != claim:
            raise DatasetError(
                f"{str(folder)!r} already holds a dataset of other objects or settings; "
                "give another folder, or remove this one."
            )
        return
    write_json(path, claim)


def _of_today(claim: dict[str, Any]) -> dict[str, Any]:
    """The claim of a folder, with the defaults of settings that came after it was made."""
    return claim | {"config": asdict(DatasetConfig()) | claim.get("config", {})}


def _shard_path(folder: Path, number: int, suffix: str) -> Path:
    return folder / f"shard-{number:05d}.{suffix}"


def _read_names(folder: Path, number: int) -> tuple[list[str], list[Skipped]]:
    content = json.loads(_shard_path(folder, number, "json").read_text())
    return content["names"], [Skipped(*entry) for entry in content["skipped"]]


# ------------------------------------------------------------------ reading


class Dataset(NamedTuple):
    """Objects of a dataset folder, left on disk until they are asked for.

    Attributes:
        names: Names of the objects.
        shards: Memory-mapped shards `[object view bytes]`; entry 0 of the second axis is the
            complete surface.
        row: Shard, and place in it, of each object.
    """

    names: list[str]
    shards: list[UInt8[np.ndarray, "object view bytes"]]
    row: list[tuple[int, int]]

    @property
    def views(self) -> int:
        """Views of each object."""
        return self.shards[0].shape[1] - 1

    @property
    def resolution(self) -> int:
        """Voxels along each axis of the grids."""
        return _side(self.shards[0])

    def packed(self, index: int) -> UInt8[np.ndarray, "view bytes"]:
        """The packed surface of one object, followed by its views."""
        shard, place = self.row[index]
        return self.shards[shard][place]


def surfaces(dataset: Dataset, limit: int = 4096) -> Bool[np.ndarray, "n x y z"]:
    """The complete surfaces of a dataset, at most `limit` of them, evenly chosen."""
    count = len(dataset.names)
    chosen = np.unique(np.linspace(0, count - 1, min(count, limit)).astype(int))
    return unpack(np.stack([dataset.packed(i)[0] for i in chosen]))


def open_dataset(folder: str | os.PathLike[str]) -> Dataset:
    """Open a finished dataset.

    Args:
        folder: Folder of the dataset.

    Raises:
        DatasetError: There is no dataset, or a part of it is missing.
    """
    folder = Path(folder)
    if not (folder / "dataset.json").exists():
        raise DatasetError(f"There is no dataset in {str(folder)!r}; make one: jaxshape dataset.")
    count = json.loads((folder / "dataset.json").read_text())["objects"]
    expected = -(-count // OBJECTS_PER_SHARD)
    missing = [n for n in range(expected) if not _shard_path(folder, n, "json").exists()]
    if missing:
        raise DatasetError(
            f"{len(missing)} of the {expected} shards of {str(folder)!r} are missing; "
            "run the same `jaxshape dataset` command again to finish it."
        )
    names, shards, row = [], [], []
    for number in range(expected):
        inside = _read_names(folder, number)[0]
        names += inside
        row += [(number, place) for place in range(len(inside))]
        shards.append(np.load(_shard_path(folder, number, "npy"), mmap_mode="r"))
    if not names:
        raise DatasetError(f"Every object of the dataset in {str(folder)!r} was skipped.")
    return Dataset(names, shards, row)
