"""Build a dataset, object by object, in processes that may be killed. [host]

Each object that is made, or skipped, leaves a part in `parts/`: its arrays and then, as the last
file, a record. When all objects of a shard are done, their parts are merged into the shard. A
killed build therefore loses only the objects in progress.
"""

import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxshape import reading
from jaxshape.data import dataset, meshes
from jaxshape.data.archives import MeshSource
from jaxshape.data.config import DatasetConfig
from jaxshape.data.dataset import (
    FORMAT,
    KINDS,
    OBJECTS_PER_SHARD,
    DatasetError,
    Object,
    hash_seed,
    load_object,
    shard_path,
)
from jaxshape.data.meshes import Skipped
from jaxshape.data.pool import in_processes
from jaxshape.files import atomic_path, write_json

NOTHING = (
    "The virtual camera measured nothing of it along a whole path: it is too thin, or too far."
)


class BuildProgress(NamedTuple):
    """Progress of a build.

    Attributes:
        objects: Objects that are done, skipped ones included.
        total: Total number of objects.
        skipped: Objects that could not be used.
        notes: Names of objects, and notes on other things in their files.
    """

    objects: int
    total: int
    skipped: list[Skipped]
    notes: list[tuple[str, str]]

    def after(
        self, objects: int, skipped: list[Skipped], notes: list[tuple[str, str]]
    ) -> "BuildProgress":
        """The progress with some more objects."""
        done = self.objects + objects
        return BuildProgress(done, self.total, self.skipped + skipped, self.notes + notes)

    def after_one(self, record: "Record") -> "BuildProgress":
        """The progress with one more object."""
        skipped = [record.skipped] if record.skipped else []
        return self.after(1, skipped, [(record.name, note) for note in record.notes])


class Record(NamedTuple):
    """The result of one object.

    Attributes:
        name: Its name.
        content: Digest of its file; empty for a procedural object.
        notes: Notes on other things in its file.
        skipped: Why the object could not be used; None if it could.
    """

    name: str
    content: str
    notes: tuple[str, ...]
    skipped: Skipped | None


def build_dataset(
    folder: str | os.PathLike[str],
    objects: Sequence[Object],
    config: DatasetConfig = DatasetConfig(),
    *,
    workers: int | None = None,
) -> Iterator[BuildProgress]:
    """Make the missing objects of a dataset in parallel processes.

    A shard is made again if the file of one of its objects has changed.

    Args:
        folder: Folder of the dataset; made if missing.
        objects: Procedural objects, or meshes.
        config: Settings of the dataset.
        workers: Processes, 1 or more; None for one for each CPU core.

    Yields:
        The progress, at the start and after each object.

    Raises:
        DatasetError: The folder holds a dataset of other objects or settings.
        WorkersDied: Processes end before they begin to work.
    """
    folder = Path(folder)
    _claim(folder, objects, config)
    starts = range(0, len(objects), OBJECTS_PER_SHARD)
    shards = [objects[start : start + OBJECTS_PER_SHARD] for start in starts]
    progress, missing = BuildProgress(0, len(objects), [], []), []
    done: dict[int, dict[int, Record]] = {}
    for shard, items in enumerate(shards):
        if (found := _finished(folder, shard, items)) is not None:
            _remove_parts(folder, range(starts[shard], starts[shard] + len(items)))
            progress = progress.after(len(items), *found)
            continue
        done[shard] = {}
        for number, item in enumerate(items, shard * OBJECTS_PER_SHARD):
            record = _read_part(folder, number)
            if record is not None and record.content in ("", content_of(item)):
                done[shard][number] = record
                progress = progress.after_one(record)
            else:
                missing.append((number, item))
    yield progress
    for shard, known in done.items():  # a build may have been killed before merging a shard
        if len(known) == len(shards[shard]):
            _write_shard(folder, config, shard, known)
    make = partial(_make_part, folder, config)
    for place, died in in_processes(make, missing, workers or os.cpu_count() or 1):
        number, item = missing[place]
        shard = number // OBJECTS_PER_SHARD
        if died is not None:
            _skip(folder, number, item, "killed", str(died))
        record = _read_part(folder, number)
        assert record is not None
        done[shard][number] = record
        if len(done[shard]) == len(shards[shard]):
            _write_shard(folder, config, shard, done.pop(shard))
        progress = progress.after_one(record)
        yield progress


def content_of(item: Object) -> str:
    """Digest of the content of an object's file; empty if there is no file, or it cannot be read.

    Args:
        item: The object.
    """
    try:
        return meshes.digest(item) if isinstance(item, MeshSource) else ""
    except Exception:  # archives and folders may raise anything
        return ""


def _claim(folder: Path, objects: Sequence[Object], config: DatasetConfig) -> None:
    names = [item.name for item in objects]
    digest = hashlib.sha256("\n".join(names).encode()).hexdigest()
    settings = json.loads(json.dumps(asdict(config)))
    claim = {"format": FORMAT, "config": settings, "objects": len(names), "names_sha256": digest}
    path = folder / "dataset.json"
    if not path.exists():
        return write_json(path, claim)
    found = dataset.read_part(path)
    # Older datasets lack newer settings; they were made with the present defaults.
    usual, given = json.loads(json.dumps(asdict(DatasetConfig()))), found.get("config", {})
    known = {"config": usual | given if isinstance(given, dict) else given}
    if found | known != claim:
        raise DatasetError(
            f"{str(folder)!r} already holds a dataset of other objects or settings; "
            "give another folder, or remove this one."
        )


# ------------------------------------------------------------------ parts


def _part_path(folder: Path, number: int, suffix: str) -> Path:
    return folder / "parts" / f"{number:08d}.{suffix}"


def _make_part(folder: Path, config: DatasetConfig, numbered: tuple[int, Object]) -> None:
    """Film one object along its paths."""
    number, item = numbered
    model = load_object(item, up=config.up, front=config.front, unit=config.unit)
    if isinstance(model, Skipped):
        return _skip(folder, number, item, model.reason, model.detail)
    made = dataset.object_paths(model.mesh, config, hash_seed(config.seed, number))
    if made is None:
        return _skip(folder, number, item, "nothing measured", NOTHING)
    with atomic_path(_part_path(folder, number, "npz")) as path:
        np.savez(path, **dict(zip(KINDS, made, strict=True)))
    _write_part(folder, number, Record(model.name, model.digest, model.notes, None))


def _skip(folder: Path, number: int, item: Object, reason: str, detail: str) -> None:
    skipped = Skipped(item.name, reason, detail)
    _write_part(folder, number, Record(item.name, content_of(item), (), skipped))


def _write_part(folder: Path, number: int, record: Record) -> None:
    write_json(_part_path(folder, number, "json"), record)


def _read_part(folder: Path, number: int) -> Record | None:
    """The record of an object; None if its part is missing or damaged."""
    try:
        found = reading.read_json(_part_path(folder, number, "json"))
        name, content, notes, skipped = found
        if skipped is None:
            arrays = reading.array_names(_part_path(folder, number, "npz"))
            return Record(name, content, tuple(notes), None) if arrays >= set(KINDS) else None
        return Record(name, content, tuple(notes), Skipped(*skipped))
    except (OSError, ValueError, TypeError):
        return None


# ------------------------------------------------------------------ shards


def _write_shard(
    folder: Path, config: DatasetConfig, shard: int, records: dict[int, Record]
) -> None:
    """Merge the parts of a shard, and remove them."""
    numbers = sorted(records)
    made = [number for number in numbers if records[number].skipped is None]
    voxels = config.resolution**3
    shapes = (config.paths, voxels // 8), (config.paths, len(config.frames), voxels)
    for kind, shape in zip(KINDS, shapes, strict=True):
        with atomic_path(shard_path(folder, shard, f"{kind}.npy")) as path:
            rows = np.lib.format.open_memmap(path, "w+", np.uint8, (len(made), *shape))
            for row, number in enumerate(made):
                with np.load(_part_path(folder, number, "npz")) as arrays:
                    rows[row] = arrays[kind]
            rows.flush()
    # The JSON file comes last: with it, a shard counts as written.
    content = {
        "names": [records[number].name for number in made],
        "skipped": [records[number].skipped for number in numbers if records[number].skipped],
        "contents": [records[number].content for number in numbers],
        "notes": [(records[n].name, note) for n in numbers for note in records[n].notes],
    }
    write_json(shard_path(folder, shard, "json"), content)
    _remove_parts(folder, numbers)


def _remove_parts(folder: Path, numbers: Iterable[int]) -> None:
    """Remove parts that a shard now holds; this also works after an interrupted removal."""
    if not (folder / "parts").is_dir():
        return
    for number in numbers:
        for suffix in ("npz", "json"):
            _part_path(folder, number, suffix).unlink(missing_ok=True)
    if not any((folder / "parts").iterdir()):
        (folder / "parts").rmdir()


def _finished(
    folder: Path, shard: int, items: Sequence[Object]
) -> tuple[list[Skipped], list[tuple[str, str]]] | None:
    """The skipped objects and the notes of a shard; None if the shard has to be made, or is damaged
    and has to be made again."""
    path = shard_path(folder, shard, "json")
    if not path.exists():
        return None
    try:
        found, _ = dataset.open_shard(folder, shard)
        contents = found.get("contents", [""] * len(items))  # old datasets have no contents
        skipped = [Skipped(*one) for one in found["skipped"]]
        notes = [(a, b) for a, b in found.get("notes", [])]
        is_whole = len(found["names"]) + len(skipped) == len(items) and all(
            content in ("", content_of(item)) for content, item in zip(contents, items, strict=True)
        )
    except (DatasetError, KeyError, TypeError, ValueError):
        is_whole = False
    if is_whole:
        return skipped, notes
    path.unlink()
    return None
