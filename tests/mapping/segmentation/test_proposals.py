"""What stands in a room is proposed by number, and taken by it."""

import numpy as np
import pytest
from analytic_room import CHAIR, CRATE, FLOOR, TABLE, WALLS, K, iou, room

from jaxshape.mapping.segmentation.proposals import propose
from jaxshape.mapping.segmentation.segment import Prompt, segment

SEEN = room([FLOOR, WALLS, CHAIR, CRATE, TABLE])


def best(found, group):
    shown = SEEN.label == group
    return max(enumerate(found, 1), key=lambda one: iou(one[1].segmented, shown))


@pytest.mark.parametrize("group, size", [(2, (0.44, 0.95, 0.44)), (3, (0.45, 0.45, 0.45))])
def test_each_object_of_the_room_is_proposed_with_its_size(group, size):
    number, one = best(propose(SEEN.depth, K), group)
    assert iou(one.segmented, SEEN.label == group) > 0.85
    # The camera looks across the sides, so that their widths are those of the diagonal at most.
    assert abs(one.size[1] - size[1]) < 0.08
    assert size[0] - 0.12 < one.size[0] < 1.5 * size[0]
    assert abs(one.distance - np.median(SEEN.depth[SEEN.label == group])) < 0.05
    taken = segment(SEEN.depth, None, K, Prompt(number=number))
    np.testing.assert_array_equal(taken.segmented, one.segmented)
    assert taken.confidence > 0.5


def test_proposals_do_not_overlap_and_the_largest_comes_first():
    found = propose(SEEN.depth, K)
    counts = [int(one.segmented.sum()) for one in found]
    assert counts == sorted(counts, reverse=True) and len(found) >= 2
    assert np.sum([one.segmented for one in found], axis=0).max() == 1


def test_a_number_that_nothing_has_is_refused():
    with pytest.raises(ValueError, match="number 12, and . are seen"):
        segment(SEEN.depth, None, K, Prompt(number=12))
    assert propose(np.zeros_like(SEEN.depth), K) == ()
