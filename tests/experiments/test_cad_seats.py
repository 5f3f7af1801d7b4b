"""Seats from packages: turned, scaled and named as the list says; what is amiss is said."""

import json
import zipfile

import numpy as np
import pytest
import trimesh

import cad_seats
from cad_seats import LISTS, Piece, collect, read_list
from jaxshape.data.meshes import Model, read_meshes

CATALOGUE = """
license=CC0
name#1=Step
model#1=/a/step.obj
modelRotation#1=0 0 1 0 1 0 -1 0 0
width#1=60
height#1=40
depth#1=20
"""


def step() -> trimesh.Trimesh:
    """A step whose high part lies at -x: one that a catalogue's quarter turn puts at +z."""
    low = trimesh.creation.box(bounds=[[-1, 0, -1], [1, 0.5, 1]])
    high = trimesh.creation.box(bounds=[[-1, 0.5, -1], [0, 1, 1]])
    return trimesh.util.concatenate([low, high])


@pytest.fixture
def packages(tmp_path):
    cad_seats._sources.cache_clear()
    (tmp_path / "models").mkdir()
    with zipfile.ZipFile(tmp_path / "models/some.sh3f", "w") as archive:
        archive.writestr("PluginFurnitureCatalog.properties", CATALOGUE)
        archive.writestr("a/step.obj", step().export(file_type="obj"))
    step().export(tmp_path / "models/plain.glb")
    return tmp_path


def seat(name="one", file="models/some.sh3f", member="a/step.obj", size=(0.6, 0.4, 0.2)):
    return Piece(name, "stool", "Step", "N. N.", "CC0", "some 1.0", file, member, list(size))


def test_seats_are_turned_scaled_and_named(packages):
    plain = seat("two", "models/plain.glb", None, (2, 1, 2))
    collect([seat(), plain], packages, packages / "out")
    one, two = read_meshes(packages / "out")
    assert isinstance(one, Model) and isinstance(two, Model)
    assert (one.name, two.name) == ("one", "two")
    assert np.allclose(one.mesh.extents, [0.6, 0.4, 0.2])
    assert np.allclose(one.mesh.bounds.sum(axis=0), 0, atol=1e-6)
    top = one.mesh.vertices[one.mesh.vertices[:, 1] > 0.19]
    assert top[:, 2].min() == pytest.approx(0, abs=1e-6) and top[:, 2].max() > 0.09
    manifest = json.loads((packages / "out/manifest.json").read_text())
    assert manifest[0] == seat()._asdict()


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        (seat(member="a/stool.obj"), "a/stool.obj is not in"),
        (seat(file="models/other.sh3f"), "some 1.0; unpack that version"),
        (seat(size=(0.6, 0.4, 0.3)), "another version than that of some 1.0"),
    ],
)
def test_what_is_missing_or_of_another_version_is_said(packages, wrong, sentence):
    with pytest.raises(ValueError, match=sentence):
        collect([wrong], packages, packages / "out")
    assert not (packages / "out/manifest.json").exists()


@pytest.mark.parametrize(
    ("name", "count", "kinds"),
    [
        ("seats", 78, {"chair", "armchair", "stool", "other_seat"}),
        ("tables", 62, {"table", "low_table", "desk"}),
    ],
)
def test_every_piece_of_a_list_is_free_and_has_a_creator(name, count, kinds):
    pieces = read_list(LISTS[name])
    assert len(pieces) == count == len({one.name for one in pieces})
    assert {one.kind for one in pieces} == kinds
    assert all(one.creator and one.licence.startswith(("CC0", "CC-BY-3.0")) for one in pieces)
