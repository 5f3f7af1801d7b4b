"""Which meshes are held out: about one in ten, always the same ones, by their names alone."""

import pytest

from jaxshape.data.archives import MeshSource
from jaxshape.data.split import hold_out


def sources(count, prefix="mug"):
    return [MeshSource(f"{prefix}-{i}", f"/anywhere/{i}") for i in range(count)]


@pytest.mark.parametrize("count", [2, 3, 12, 1000])
def test_every_mesh_is_on_one_side_and_none_is_empty(count):
    training, held_out = hold_out(sources(count))
    assert sorted(training + held_out) == sorted(sources(count))
    assert training == [source for source in sources(count) if source in training]  # their order
    assert training and held_out
    if count == 1000:
        assert 70 < len(held_out) < 130


def test_a_mesh_stays_on_its_side_as_the_collection_grows():
    small, large = ({s.name for s in hold_out(sources(n))[0]} for n in (300, 3000))
    held_out = {s.name for s in hold_out(sources(3000))[1]}
    assert small <= large and not small & held_out


def test_order_and_place_of_the_files_do_not_matter():
    elsewhere = [source._replace(path="/other") for source in reversed(sources(50))]
    assert {s.name for s in hold_out(elsewhere)[1]} == {s.name for s in hold_out(sources(50))[1]}


def test_one_mesh_cannot_be_split():
    with pytest.raises(ValueError, match="There is 1 mesh; give two or more"):
        hold_out(sources(1))
