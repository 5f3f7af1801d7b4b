"""Clusters of a room from analytic views of it."""

import numpy as np
import pytest
from analytic_room import CHAIR, CRATE, FLOOR, TABLE, WALLS, K, room

from jaxshape.geometry.camera import intrinsics_of
from jaxshape.mapping.placement.faces import Cutout
from jaxshape.mapping.scene.boxing import boxed, turned_box
from jaxshape.mapping.scene.things import Tracks, associate
from jaxshape.mapping.scene.world import CELL, Cells, Level, cells_of, clusters_of, rectangle
from jaxshape.mapping.segmentation.parts import parts_of

LEVEL = Level(np.eye(4), 0.0)
VASE = [((0.9, 0.74, -0.2), (1.1, 1.04, 0.0))]
AZIMUTHS = (-50, -30, -10, 10, 30, 50)


def seen(*groups, azimuths=AZIMUTHS, target=(0.2, 0.4, 0)):
    """Views of a room, with the pixels of all that is neither floor nor wall."""
    views = []
    for i, azimuth in enumerate(azimuths):
        angle = np.deg2rad(azimuth)
        eye = 2.6 * np.sin(angle), 1.7, 2.6 * np.cos(angle)
        one = room([FLOOR, WALLS, *groups], eye, target, seed=i)
        things = parts_of(one.depth, K, with_tables=False).labels != 0
        views.append(Cutout(one.depth, things, intrinsics_of(K), one.T_world_camera))
    return views


def found(views):
    return clusters_of(cells_of(views, LEVEL), LEVEL)


def bounds(cluster):
    return np.stack([cluster.index.min(axis=0), cluster.index.max(axis=0) + 1]) * CELL


def corners(group):
    low, high = np.array(group, float).transpose(1, 0, 2)
    return np.stack([low.min(axis=0), high.max(axis=0)])


@pytest.fixture(scope="module")
def furnished():
    return found(seen(CHAIR, CRATE, TABLE))


def test_each_thing_is_one_cluster_where_it_stands(furnished):
    assert len(furnished) == 3
    for group in (CHAIR, CRATE, TABLE):
        apart = [np.abs(bounds(one) - corners(group)) for one in furnished]
        nearest = min(apart, key=lambda x: x[:, ::2].max())
        assert nearest[:, ::2].max() < 2.5 * CELL  # along the floor
        assert nearest[1, 1] < 2 * CELL  # at the top


def test_an_empty_room_has_no_things():
    assert found(seen(azimuths=(-20, 0, 20))) == []


def test_what_stands_on_a_table_is_no_part_of_it():
    things = found(seen(TABLE, VASE))
    (vase,) = [one for one in things if one.is_on_top]
    assert np.abs(bounds(vase) - corners(VASE)).max() < 3 * CELL
    (table,) = [one for one in things if not one.is_on_top]
    assert bounds(table)[1, 1] < 0.74 + 3 * CELL


@pytest.mark.parametrize("degrees", [0, 30, 45])
def test_a_long_bench_is_one_thing_whichever_way_it_is_turned(degrees):
    """2.4 m are not too long for an object; 3.2 m are, and no part of it is one by itself."""

    def things(length):
        p = np.random.default_rng(0).uniform(-0.5, 0.5, (60_000, 3)) * [length, 0.8, 0.5]
        a = np.deg2rad(degrees)
        p = p @ np.array([[np.cos(a), 0, -np.sin(a)], [0, 1, 0], [np.sin(a), 0, np.cos(a)]])
        index = np.unique(np.floor((p + [0, 0.42, 0]) / CELL).astype(int), axis=0)
        always = np.full(len(index), 3)
        cells = Cells(index, always, 0 * always, np.zeros(len(index), bool))
        return clusters_of(cells, LEVEL)

    (bench,) = things(2.4)
    assert 0.98 * 2.4 < np.hypot(*np.ptp(bench.index[:, ::2], axis=0)) * CELL < 2.4 * 1.25
    assert things(3.2) == []


def test_something_that_was_moved_is_noticed():
    there, elsewhere = seen(CHAIR, CRATE), seen(CHAIR)
    views = [*there[:3], *elsewhere[3:]]
    things = found(views)
    assert [one.is_moved for one in things if bounds(one)[0, 0] < -0.5] == [True]
    assert [one.is_moved for one in things if bounds(one)[0, 0] > -0.5] == [False]


def test_the_smallest_rectangle_is_turned_as_its_points_are():
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.5, 0.5, (4000, 2)) * [2.0, 1.0]
    for degrees in (0, 20, 45, 70):
        a = np.deg2rad(degrees)
        turn = np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]])
        yaw, size, middle = rectangle(points @ turn.T + [3, 4])
        assert abs((np.degrees(yaw) - degrees + 45) % 90 - 45) < 2
        np.testing.assert_allclose(sorted(size), [1, 2], atol=0.05)
        np.testing.assert_allclose(middle, [3, 4], atol=0.05)


def test_a_box_is_around_all_cells_and_stands_on_the_floor(furnished):
    for thing in associate(Tracks(), furnished).things:
        box = boxed(thing, LEVEL)
        p = ((thing.index + 0.5) * CELL - box.T_world_object[:3, 3]) @ box.T_world_object[:3, :3]
        assert (np.abs(p) <= box.size / 2 + CELL).mean() > 0.98
        assert box.T_world_object[1, 3] - box.size[1] / 2 == pytest.approx(0, abs=1e-6)


def test_a_box_turned_four_times_is_the_same():
    thing = associate(Tracks(), found(seen(CHAIR)))[0][0]
    box = boxed(thing, LEVEL)
    again = box
    for _ in range(4):
        again = turned_box(again, 1)
    np.testing.assert_allclose(again.T_world_object, box.T_world_object, atol=1e-9)
    np.testing.assert_allclose(again.size, box.size)
    np.testing.assert_allclose(again.exclude, box.exclude, atol=1e-9)
