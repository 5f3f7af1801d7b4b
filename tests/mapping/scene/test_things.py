"""Identity of objects while clusters appear, join, part, move and vanish."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxshape.mapping.scene.things import Tracks, associate
from jaxshape.mapping.scene.world import Cluster


def block(x, width=10, *, height=10, is_moved=False):
    index = np.stack(np.meshgrid(range(x, x + width), range(height), range(10)), -1)
    return Cluster(index.reshape(-1, 3), is_moved, False)


def numbers(tracks):
    """Number of each object, by where it lies."""
    return {int(one.index[:, 0].min()): one.number for one in tracks.things}


def tracks_after(*steps):
    found = Tracks()
    for clusters in steps:
        found = associate(found, clusters)
    return found


@given(st.permutations([0, 20, 40, 60]), st.permutations([0, 20, 40, 60]))
def test_objects_keep_their_numbers_whatever_the_order_of_the_clusters(first, second):
    before = tracks_after([block(x) for x in first])
    after = associate(before, [block(x + 2) for x in second])
    assert {x - 2: n for x, n in numbers(after).items()} == numbers(before)
    assert after.events == before.events


def test_what_appears_gets_a_new_number():
    assert numbers(tracks_after([block(0)], [block(30), block(0)])) == {0: 1, 30: 2}


def test_of_two_that_join_the_larger_one_stays():
    joined = tracks_after([block(0, 12), block(14, 6)], [block(0, 20)])
    assert numbers(joined) == {0: 1}
    assert joined.events[-1] == "Object 2 is a part of object 1."


def test_of_one_that_parts_the_larger_part_stays():
    parted = tracks_after([block(0, 20)], [block(14, 6), block(0, 12)])
    assert numbers(parted) == {0: 1, 14: 2}
    assert parted.events[-1] == "Object 2 was split from object 1."


def test_numbers_are_never_given_twice():
    assert numbers(tracks_after([block(0)], [], [block(0)])) == {0: 2}


def test_one_that_moves_is_told_once():
    moved = block(0, is_moved=True)
    after = tracks_after([block(0)], [moved], [moved])
    assert [one.is_moved for one in after.things] == [True]
    assert sum("moved" in event for event in after.events) == 1


@pytest.mark.parametrize("share", [0.1, 0.9])
def test_a_remnant_of_another_is_no_object_of_its_own(share):
    """What shares little with an object is another one."""
    shift = round(20 * (1 - share))
    after = tracks_after([block(0, 20)], [block(shift, 20)])
    assert numbers(after)[shift] == (1 if share > 0.3 else 2)
