import json
import os
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from jaxshape.data import dataset
from jaxshape.data.archives import list_meshes
from jaxshape.data.dataset import (
    OBJECTS_PER_SHARD,
    DatasetConfig,
    DatasetError,
    build_dataset,
    hash_seed,
    object_paths,
    open_dataset,
    pack,
    pack_measured,
    unpack,
    unpack_measured,
)
from jaxshape.geometry.grids import Grids

CONFIG = DatasetConfig(paths=2, frames=(1, 2), cameras=("paper",))
BOXES = {0: (0.4, 0.9, 0.5), OBJECTS_PER_SHARD: (0.6, 0.3, 0.2)}  # one in each of two shards


@pytest.fixture(scope="module")
def objects(tmp_path_factory):
    """Two shards of mesh files: a box at the start of each, and files with nothing in them."""
    folder = tmp_path_factory.mktemp("meshes")
    for i in range(OBJECTS_PER_SHARD + 1):
        path = folder / f"{i:03d}.off"
        if i in BOXES:
            trimesh.creation.box(BOXES[i]).export(path)
        else:
            path.write_bytes(b"")
    return list_meshes(folder)


def build_here(folder, objects, config=CONFIG):
    """Build in this process, whose compiled functions are ready; one shard after the other."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dataset, "ProcessPoolExecutor", lambda _, mp_context: ThreadPoolExecutor(1))
        return list(build_dataset(folder, objects, config))


@pytest.fixture(scope="module")
def built(objects, tmp_path_factory):
    """A finished dataset, and the progress of its build."""
    folder = tmp_path_factory.mktemp("built")
    return folder, build_here(folder, objects)


@pytest.fixture
def copied(built, tmp_path):
    return shutil.copytree(built[0], tmp_path / "copy")


def contents(folder):
    return {name: (folder / name).read_bytes() for name in os.listdir(folder)}


@pytest.mark.parametrize("batch", [(), (1,), (2, 3)])
def test_unpacking_gives_back_what_was_packed_in_four_kib_a_grid(batch):
    grids = np.random.default_rng(0).random((*batch, 32, 32, 32)) < 0.3
    packed = pack(grids)
    assert packed.shape == (*batch, 4096) and packed.dtype == np.uint8
    np.testing.assert_array_equal(unpack(packed), grids)


def test_binary_measurements_survive_packing_and_soft_ones_to_a_thirtieth():
    rng = np.random.default_rng(0)
    M = rng.random((2, 3, 16, 16, 16)) < 0.4
    F = (rng.random(M.shape) < 0.2) & ~M
    packed = pack_measured(Grids(F, M))
    assert packed.shape == (2, 3, 16**3) and packed.dtype == np.uint8
    again = unpack_measured(packed)
    np.testing.assert_array_equal(again.occupied, F)
    np.testing.assert_array_equal(again.occluded, M)
    soft = Grids(rng.random(M.shape), rng.random(M.shape))
    again = unpack_measured(pack_measured(soft))
    for part in (lambda F, M: F * (1 - M), lambda F, M: (1 - F) * (1 - M), lambda F, M: M):
        np.testing.assert_allclose(part(*again[:2]), part(*soft[:2]), atol=1.01 / 15)
    np.testing.assert_allclose(
        again.occupied * (1 - again.occluded), soft.occupied * (1 - soft.occluded), atol=0.51 / 15
    )


def test_the_first_voxels_are_the_highest_bits():
    grid = np.zeros((32, 32, 32), bool)
    grid[0, 0, 0] = grid[0, 0, 9] = True
    np.testing.assert_array_equal(pack(grid)[:3], [128, 64, 0])


def test_processes_write_the_same_bytes_as_one_thread(objects, built, tmp_path):
    progress = list(build_dataset(tmp_path, objects, CONFIG, workers=2))
    assert progress[-1].objects == progress[-1].total == len(objects)
    assert contents(tmp_path) == contents(built[0])


def test_progress_counts_objects_and_what_was_skipped(objects, built):
    progress = built[1]
    assert [p.objects for p in progress] == [0, OBJECTS_PER_SHARD, OBJECTS_PER_SHARD + 1]
    assert {p.total for p in progress} == {len(objects)}
    skipped = progress[-1].skipped
    assert sorted(s.name for s in skipped) == [f"{i:03d}" for i in range(1, OBJECTS_PER_SHARD)]
    assert {s.reason for s in skipped} == {"empty"}


def test_what_is_read_is_what_was_made_of_each_object(objects, built):
    opened = open_dataset(built[0])
    assert opened.names == ["000", f"{OBJECTS_PER_SHARD:03d}"]
    assert opened.resolution == 32
    for index, place in enumerate(BOXES):
        mesh = dataset.load_object(objects[place]).mesh
        packed, measured = object_paths(mesh, CONFIG, hash_seed(CONFIG.seed, place))
        assert opened.inputs_of(index) == (2, 2)
        for path in range(2):
            surface = opened.surface(index, path)
            np.testing.assert_array_equal(surface, unpack(packed[path]))
            assert surface[1:31, 1:31, 1:31].any() and not surface[5:27, 5:27, 5:27].any()
            for number in range(2):
                found = opened.grids(index, path, number)
                np.testing.assert_array_equal(
                    found.occupied, unpack_measured(measured[path, number]).occupied
                )
                assert found.occupied.any()
        assert (opened.grids(index, 0, 0).occupied != opened.grids(index, 1, 0).occupied).any()


def test_a_build_goes_on_where_it_was_killed(objects, built, copied):
    """The kill came while the arrays of the second shard were being written."""
    (copied / "shard-00001.json").unlink()
    (copied / "shard-00001.measured.npy").write_bytes(b"half")
    untouched = (copied / "shard-00000.surface.npy").stat()
    progress = build_here(copied, objects)
    assert [p.objects for p in progress] == [OBJECTS_PER_SHARD, OBJECTS_PER_SHARD + 1]
    assert len(progress[-1].skipped) == OBJECTS_PER_SHARD - 1
    assert contents(copied) == contents(built[0])
    assert (copied / "shard-00000.surface.npy").stat().st_mtime_ns == untouched.st_mtime_ns


def test_a_finished_build_has_nothing_left_to_do(objects, built):
    before = contents(built[0])
    (progress,) = build_dataset(built[0], objects, CONFIG)
    assert progress.objects == progress.total == len(objects)
    assert len(progress.skipped) == OBJECTS_PER_SHARD - 1
    assert contents(built[0]) == before


@pytest.mark.parametrize(
    "config, count", [(replace(CONFIG, paths=3), None), (replace(CONFIG, seed=1), None),
                      (CONFIG, -1)],
)  # fmt: skip
def test_other_settings_or_objects_are_refused(objects, built, config, count):
    with pytest.raises(DatasetError, match="other objects or settings"):
        next(build_dataset(built[0], objects[:count], config))


def test_a_missing_shard_is_counted_and_the_remedy_named(copied):
    (copied / "shard-00001.json").unlink()
    with pytest.raises(
        DatasetError, match=r"1 of the 2 shards of .*copy.* are missing; run the same"
    ):
        open_dataset(copied)


def test_a_folder_without_a_dataset_is_named(tmp_path):
    with pytest.raises(DatasetError, match="no dataset in .*jaxshape dataset"):
        open_dataset(tmp_path)


def test_a_dataset_of_which_all_was_skipped_is_refused(objects, tmp_path):
    empty = [item for i, item in enumerate(objects) if i not in BOXES]
    build_here(tmp_path, empty)
    assert json.loads((tmp_path / "shard-00000.json").read_text())["names"] == []
    with pytest.raises(DatasetError, match="Every object .* was skipped"):
        open_dataset(tmp_path)


def test_seeds_of_neighbours_differ_and_fit_31_bits():
    seeds = [hash_seed(a, b) for a in range(20) for b in range(50)]
    assert len(set(seeds)) == 1000
    assert min(seeds) >= 0 and 2**30 < max(seeds) < 2**31


def test_a_dataset_of_an_earlier_version_is_named(copied):
    claim = json.loads((copied / "dataset.json").read_text())
    del claim["format"]
    (copied / "dataset.json").write_text(json.dumps(claim))
    with pytest.raises(DatasetError, match="earlier version .* build it again"):
        open_dataset(copied)
