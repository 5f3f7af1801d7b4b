"""What belongs to the object: decided for all frames together, in a room that is known exactly."""

import numpy as np
import pytest
from analytic_room import CHAIR, CRATE, FLOOR, HEIGHT, TABLE, WALLS, WIDTH, K, iou, room

from jaxshape.data.boxes import Box
from jaxshape.mapping.placement.faces import reach_of
from jaxshape.mapping.segmentation.belonging import Seen, belonging
from jaxshape.mapping.segmentation.parts import parts_of

GROUPS = [FLOOR, WALLS, CHAIR, TABLE]
OURS, ITS_TABLE = 2, 3
EYES = [(0.9, 1.4, 1.8), (0.1, 1.6, 1.9), (-0.7, 1.3, 2.0)]
CLOSE = (0.5, 1.25, 0.9), (0, 0.85, 0)
"""A camera that sees the back and the seat alone."""
ABOVE_FLOOR = np.array([[[-9, -9, -9], [9, 0.02, 9]]], float)
"""What lies lower is floor."""


def box_of(low, high):
    """A box of this room, with the floor excluded from it."""
    low, high = np.array(low, float), np.array(high, float)
    T = np.eye(4)
    T[:3, 3] = (low + high) / 2
    return Box(T, high - low, ABOVE_FLOOR - T[:3, 3])


WHOLE = box_of((-0.25, 0, -0.25), (0.25, 0.96, 0.25))
SHORT = box_of((-0.25, 0.4, -0.25), (0.25, 0.96, 0.25))


def in_the_world(view):
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(K).T
    z = np.where(np.isfinite(view.depth), view.depth, np.nan)
    T = view.T_world_camera
    return (rays * z[..., None]) @ T[:3, :3].T + T[:3, 3]


def seen(view, sure=None):
    parts = parts_of(view.depth, K, sure)
    return Seen(
        in_the_world(view), parts.labels, parts.sure, parts.corners, parts.tops, parts.pairs
    )


def found_in(views, box, first=OURS):
    """The object's pixels, where those of the first view are known."""
    frames = [seen(view) for view in views]
    frames[0] = frames[0]._replace(sure=views[0].label == first)
    return belonging(frames, box, *reach_of(box))


@pytest.fixture(scope="module")
def views():
    return [room(GROUPS, *CLOSE), *(room(GROUPS, eye, seed=i) for i, eye in enumerate(EYES))]


@pytest.mark.parametrize("box", [WHOLE, SHORT], ids=["whole", "short"])
def test_a_box_that_was_cut_short_excludes_nothing_of_the_chair(views, box):
    for view, found in zip(views[1:], found_in(views, box)[1:], strict=True):
        chair = (view.label == OURS) & (in_the_world(view)[..., 1] > 0.06)
        assert found[chair].mean() > 0.95
        assert not found[view.label == ITS_TABLE].any()
        assert iou(found, view.label == OURS) > 0.85


def test_the_table_beside_is_not_the_chair_though_it_is_within_reach(views):
    reach, _ = reach_of(SHORT)
    assert reach.size[0] / 2 > 0.6  # where the table begins
    assert all(not found[v.label == ITS_TABLE].any()
               for v, found in zip(views, found_in(views, SHORT), strict=True))  # fmt: skip


def test_a_box_that_reaches_too_far_does_not_hold_the_table_beside(views):
    wide = box_of((-0.25, 0, -0.6), (1.65, 0.96, 0.45))
    for view, found in zip(views[1:], found_in(views, wide)[1:], strict=True):
        chair = (view.label == OURS) & (in_the_world(view)[..., 1] > 0.06)
        assert found[chair].mean() > 0.95
        assert not found[view.label == ITS_TABLE].any()


def beside_its_leg(by):
    """The table, moved so that a leg of it stands next to the chair."""
    return [tuple(np.add(corner, (-by, 0, 0.35)) for corner in part) for part in TABLE]


def test_the_leg_of_a_table_next_to_the_chair_stays_the_tables():
    """Both parts adjoin, and the box reaches too far: what is under the table top is not taken."""
    groups = [FLOOR, WALLS, CHAIR, beside_its_leg(0.36)]
    eyes = [(0.3, 1.9, 2.2), (-0.4, 1.8, 2.3), (-1.0, 1.6, 1.9)]
    views = [room(groups, eye, seed=i) for i, eye in enumerate(eyes)]
    wide = box_of((-0.25, 0, -0.25), (0.6, 0.96, 0.4))
    frames = [seen(view) for view in views]
    frames[0] = frames[0]._replace(sure=views[0].label == OURS)
    assert all(one.tops.any() for one in frames)
    for view, found in zip(views[1:], belonging(frames, wide, *reach_of(wide))[1:], strict=True):
        chair = (view.label == OURS) & (in_the_world(view)[..., 1] > 0.06)
        assert found[chair].mean() > 0.9
        assert found[view.label == ITS_TABLE].mean() < 0.01
    blind = [one._replace(tops=None) for one in frames]
    taken = belonging(blind, wide, *reach_of(wide))[1] & (views[1].label == ITS_TABLE)
    assert taken.sum() > 30  # without the table top its leg is taken


def open_back(gap):
    """The chair, its back so far above the seat that background shows between them."""
    seat, ((x, _, z), high), *legs = CHAIR
    return [seat, ((x, 0.47 + gap, z), high), *legs]


def test_two_frames_that_show_a_seat_below_the_back_make_it_part_of_the_object():
    """The box lies behind the back, which was all that the first frame told: the front is wrong."""
    groups = [FLOOR, WALLS, open_back(0.12), TABLE]
    views = [room(groups, eye, seed=i) for i, eye in enumerate([(0.5, 1.25, 0.9), *EYES])]
    frames, box = [seen(view) for view in views], box_of((-0.25, 0, -0.7), (0.25, 0.96, -0.15))
    high = in_the_world(views[0])[..., 1] > 0.5
    frames[0] = frames[0]._replace(sure=(views[0].label == OURS) & high)
    for view, found in zip(views[1:], belonging(frames, box, *reach_of(box))[1:], strict=True):
        chair = (view.label == OURS) & (in_the_world(view)[..., 1] > 0.06)
        assert found[chair].mean() > 0.9
        assert not found[view.label == ITS_TABLE].any()
    alone = [one._replace(pairs=one.pairs[: 100 * (i == 1)]) for i, one in enumerate(frames)]
    found = belonging(alone, box, *reach_of(box))[1]
    seat = (views[1].label == OURS) & (in_the_world(views[1])[..., 1] < 0.5)
    assert found[seat].mean() < 0.05  # one frame may be wrong


def test_a_view_that_shows_the_table_alone_shows_nothing_of_the_chair(views):
    away = room(GROUPS, (1.6, 1.3, 1.2), (1.5, 0.4, -0.5))
    assert not (away.label == OURS).any()
    assert not found_in([*views, away], SHORT)[-1].any()


def test_a_cluster_of_the_chair_and_a_crate_is_cut_where_others_show_the_crate_alone():
    """As where both touch, or where depth is too coarse to tell one from the other."""
    views = [room([*GROUPS, CRATE], *CLOSE)]
    views += [room([*GROUPS, CRATE], eye, seed=i) for i, eye in enumerate(EYES)]
    frames = [seen(view) for view in views]
    frames[0] = frames[0]._replace(sure=views[0].label == OURS)
    labels = frames[-1].labels.copy()
    both = np.isin(labels, labels[np.isin(views[-1].label, (OURS, 4))]) & (labels > 0)
    labels[both] = labels.max() + 1
    frames[-1] = frames[-1]._replace(labels=labels)
    found = belonging(frames, WHOLE, *reach_of(WHOLE))[-1]
    chair = (views[-1].label == OURS) & (in_the_world(views[-1])[..., 1] > 0.06)
    assert found[chair].mean() > 0.9 and both[views[-1].label == 4].any()
    assert not found[views[-1].label == 4].any()


def test_far_from_the_object_and_without_depth_nothing_is_found(views):
    blind = views[1]._replace(depth=np.zeros_like(views[1].depth))
    assert not found_in([*views, blind], WHOLE)[-1].any()
    shift = WHOLE.T_world_object.copy()
    shift[0, 3] -= 6
    frames = [seen(view) for view in views]
    elsewhere = WHOLE._replace(T_world_object=shift)
    assert not any(one.any() for one in belonging(frames, elsewhere, *reach_of(elsewhere)))
