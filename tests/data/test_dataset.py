import gc
import json
import os
import shutil
import weakref
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from jaxshape.data import building, dataset, paths
from jaxshape.data.archives import list_meshes
from jaxshape.data.building import build_dataset
from jaxshape.data.dataset import (
    FORMAT,
    OBJECTS_PER_SHARD,
    DatasetConfig,
    DatasetError,
    LoadedWhenNeeded,
    hash_seed,
    object_paths,
    open_dataset,
    pack,
    pack_measured,
    unpack,
    unpack_measured,
)
from jaxshape.data.families import procedural_objects
from jaxshape.data.meshes import Skipped
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
    """Build in this process, whose compiled functions are ready."""
    return list(build_dataset(folder, objects, config, workers=1))


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
    assert [p.objects for p in progress] == list(range(OBJECTS_PER_SHARD + 2))
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


def test_a_build_goes_on_after_its_last_object(objects, built, tmp_path, monkeypatch):
    """Killed while the second of three objects was made, whose arrays were half written."""
    few = [objects[0], objects[1], objects[OBJECTS_PER_SHARD]]
    progress = build_dataset(tmp_path, few, CONFIG, workers=1)
    assert [next(progress).objects for _ in range(2)] == [0, 1]
    progress.close()
    (tmp_path / "parts" / "00000001.npz").write_bytes(b"half")
    made = []
    whole = building._make_part
    monkeypatch.setattr(
        building,
        "_make_part",
        lambda folder, config, it: made.append(it[0]) or whole(folder, config, it),
    )
    assert [p.objects for p in build_here(tmp_path, few)] == [1, 2, 3] and made == [1, 2]
    assert not (tmp_path / "parts").exists()
    assert open_dataset(tmp_path).names == ["000", f"{OBJECTS_PER_SHARD:03d}"]


def test_a_shard_whose_names_are_missing_is_made_anew(objects, built, copied):
    """The kill came while the arrays of the second shard were being written."""
    (copied / "shard-00001.json").unlink()
    (copied / "shard-00001.measured.npy").write_bytes(b"half")
    untouched = (copied / "shard-00000.surface.npy").stat()
    progress = build_here(copied, objects)
    assert [p.objects for p in progress] == [OBJECTS_PER_SHARD, OBJECTS_PER_SHARD + 1]
    assert len(progress[-1].skipped) == OBJECTS_PER_SHARD - 1
    assert contents(copied) == contents(built[0])
    assert (copied / "shard-00000.surface.npy").stat().st_mtime_ns == untouched.st_mtime_ns


@pytest.mark.parametrize("content", [None, b"", b"{", b"{}", b'{"names": 5, "skipped": []}'])
@pytest.mark.parametrize("name", ["json", "surface.npy", "measured.npy"])
def test_a_damaged_shard_is_made_again(objects, built, copied, name, content):
    """The remedy that its message names: build the dataset again."""
    damaged = copied / f"shard-00001.{name}"
    damaged.unlink()
    if content is not None:
        damaged.write_bytes(content)
    with pytest.raises(DatasetError, match="shard"):
        open_dataset(copied)
    build_here(copied, objects)
    assert contents(copied) == contents(built[0])


@pytest.mark.parametrize("content", ["{", "[]", '["000", "", [], null]'])
def test_a_damaged_part_is_made_again(objects, tmp_path, content):
    """The last one is the record of an object whose arrays are missing."""
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "00000000.json").write_text(content)
    build_here(tmp_path, objects[:1])
    assert open_dataset(tmp_path).names == ["000"]


@pytest.mark.parametrize("content", ["{", "[]", '{"config": null}'])
def test_a_build_over_a_damaged_claim_is_refused(objects, copied, content):
    (copied / "dataset.json").write_text(content)
    with pytest.raises(DatasetError, match="remove it and build|other objects or settings"):
        build_here(copied, objects)


def test_parts_of_a_written_shard_are_removed(objects, built, copied):
    """The kill came while the parts of the second shard were being removed."""
    left = building._part_path(copied, OBJECTS_PER_SHARD, "json")
    left.parent.mkdir()
    left.write_text("[]")
    assert [p.objects for p in build_here(copied, objects)] == [len(objects)]
    assert contents(copied) == contents(built[0]) and not left.parent.exists()


def test_a_repaired_file_is_made_anew(objects, copied, tmp_path):
    """A file that was empty is a box now; the other shard is left alone."""
    untouched = (copied / "shard-00001.surface.npy").stat()
    repaired = shutil.copytree(os.path.dirname(objects[0].path), tmp_path / "repaired")
    trimesh.creation.box((1, 1, 2)).export(repaired / "001.off")
    progress = build_here(copied, list_meshes(repaired))
    assert progress[0].objects == 1 and progress[-1].objects == len(objects)
    assert open_dataset(copied).names == ["000", "001", f"{OBJECTS_PER_SHARD:03d}"]
    assert (copied / "shard-00001.surface.npy").stat().st_mtime_ns == untouched.st_mtime_ns


def test_a_dataset_without_contents_is_finished_and_can_be_read(objects, copied):
    """As earlier versions of this format wrote them."""
    for shard in ("shard-00000.json", "shard-00001.json"):
        about = json.loads((copied / shard).read_text())
        (copied / shard).write_text(json.dumps({k: about[k] for k in ("names", "skipped")}))
    claim = json.loads((copied / "dataset.json").read_text())
    del claim["config"]["unit"]
    (copied / "dataset.json").write_text(json.dumps(claim))
    (progress,) = build_dataset(copied, objects, CONFIG)
    assert progress.objects == len(objects) and len(open_dataset(copied).names) == 2


def test_an_object_of_which_nothing_is_measured_is_left_out(tmp_path, monkeypatch):
    drawn = []

    def draw_path(mesh, config, seed):
        drawn.append(seed)
        empty = np.zeros((1, 32, 32, 32), np.float32)
        return paths.Path(np.ones((32, 32, 32), bool), Grids(empty, empty))

    monkeypatch.setattr(dataset, "draw_path", draw_path)
    *_, progress = build_here(
        tmp_path, procedural_objects("chair", 1), replace(CONFIG, frames=(1,), paths=1)
    )
    assert len(set(drawn)) == 3
    assert [(s.name, s.reason) for s in progress.skipped] == [("chair-0", "nothing measured")]


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


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("dataset.json", b"{"),
        ("dataset.json", b'{"format": "' + FORMAT.encode() + b'", "objects": -4}'),
        ("shard-00000.json", b"[" * 100_000),
        ("shard-00000.surface.npy", b"no array"),
        ("shard-00000.surface.npy", b""),
    ],
)
def test_a_damaged_file_is_named(copied, name, content):
    (copied / name).write_bytes(content)
    with pytest.raises(DatasetError, match="is damaged"):
        open_dataset(copied)


def test_an_array_of_fewer_objects_than_its_names_is_refused(copied):
    path = copied / "shard-00000.measured.npy"
    np.save(path, np.load(path)[:-1])
    with pytest.raises(DatasetError, match="measured.npy.*its shard has"):
        open_dataset(copied)


def test_meshes_are_read_when_they_are_needed_and_freed_afterwards(tmp_path):
    for i in range(3):
        trimesh.creation.box([1, 2, 1 + i]).export(tmp_path / f"box-{i}.ply")
    files = list_meshes(tmp_path)
    (tmp_path / "box-2.ply").unlink()
    gc.disable()
    try:
        needed = LoadedWhenNeeded(files, up="y", front="z", unit="cm")
        first, second = needed[0], needed[:2][1]
        assert len(needed) == 3 and first.name == "box-0"
        np.testing.assert_allclose(second.mesh.extents, [0.01, 0.02, 0.02])
        seen = weakref.ref(second.mesh)
        del second
        assert seen() is not None  # its parts refer to each other
        assert isinstance(needed[2], Skipped) and seen() is None
    finally:
        gc.enable()
