"""What is said of a collection before it is used."""

import pytest

from jaxshape.data.archives import MeshSource
from jaxshape.data.survey import doubted_size, evenly


@pytest.mark.parametrize(
    ("size", "unit", "said"),
    [
        (1.0, "m", None),
        (0.1, "m", None),
        (1050.0, "m", "give --unit mm (1.1 m)"),
        (105.0, "m", "or --unit inch (2.7 m)"),
        (41.0, "m", "--unit inch (1 m)"),
        (0.001, "mm", "give --unit m (1 m)"),
        (1e9, "m", "scale the files"),
    ],
)
def test_a_median_size_that_nothing_in_a_room_has_is_named(size, unit, said):
    """Two meshes of the size, and one that is far larger."""
    sentence = doubted_size([size, size, 1e4 * size], unit)
    assert sentence is None if said is None else said in sentence


def test_a_sample_is_spread_over_the_collection():
    sources = [MeshSource(str(i), f"/{i}") for i in range(10)]
    assert evenly(sources, 4) == [sources[i] for i in (0, 3, 6, 9)]
    assert evenly(sources, 20) == sources
