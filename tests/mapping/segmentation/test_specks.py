"""Thin parts of which every frame shows some points only."""

import numpy as np

from jaxshape.data.boxes import Box
from jaxshape.mapping.segmentation.specks import confirmed

REACH = Box(np.eye(4), np.array([1.2, 1.2, 1.2]))
RNG = np.random.default_rng(0)
SEAT = RNG.uniform((-0.2, 0.0, -0.2), (0.2, 0.03, 0.2), (3000, 3))


def rod(x, count):
    """Some points of a leg from the seat to 40 cm below it."""
    height = RNG.uniform(-0.4, 0, count)
    return np.stack([np.full(count, x), height, np.zeros(count)], axis=1)


def test_a_leg_that_frames_show_in_pieces_is_confirmed_and_what_one_frame_shows_is_not():
    stray = np.array([[-0.15, -0.3, 0.1], [0.0, 0.3, 0.0]])
    frames = [np.concatenate([rod(0.15, 80), stray]), rod(0.15, 80)]
    first, second = confirmed(frames, [SEAT, SEAT], REACH)
    assert first[:80].mean() > 0.9 and second.mean() > 0.9
    assert not first[80:].any()


def test_what_stands_apart_is_not_confirmed():
    found = confirmed([rod(0.4, 40), rod(0.4, 40)], [SEAT, SEAT], REACH)
    assert not np.concatenate(found).any()
    nothing = np.zeros((0, 3))
    found = confirmed([rod(0.1, 40), rod(0.1, 40)], [nothing, nothing], REACH)
    assert not np.concatenate(found).any()


def test_a_turned_box_of_reach_confirms_the_same():
    T = np.eye(4)
    T[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    T[:3, 3] = 3, -1, 2
    moved = lambda points: points @ T[:3, :3].T + T[:3, 3]  # noqa: E731
    specks, ours = [rod(0.15, 30), rod(0.15, 30)], [SEAT, SEAT]
    plain = confirmed(specks, ours, REACH)
    turned = confirmed(list(map(moved, specks)), list(map(moved, ours)),
                       REACH._replace(T_world_object=T))  # fmt: skip
    assert np.mean(np.concatenate(plain) == np.concatenate(turned)) > 0.95
