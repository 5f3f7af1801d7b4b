"""Faces of a box: where the object was seen to end, and where that is a guess."""

import jax.numpy as jnp
import numpy as np
import pytest
from analytic_room import CHAIR, FLOOR, K, look_from, room

from jaxshape.data.boxes import Box, points_in_box
from jaxshape.geometry.camera import intrinsics_of
from jaxshape.mapping.placement.faces import (
    Cutout,
    between,
    faces_of,
    fits,
    fitted,
    reach_of,
)

TRUE = np.array([[-0.22, 0, -0.22], [0.22, 0.95, 0.22]])
"""Lowest and highest corner of the chair."""
AROUND = [(1.6 * np.sin(a), 1.3, 1.6 * np.cos(a)) for a in np.deg2rad([10, 100, 190, 280])]


def box_of(low, high, exclude=()):
    low, high = np.array(low, float), np.array(high, float)
    T = np.eye(4)
    T[:3, 3] = (low + high) / 2
    return Box(T, high - low, np.array(exclude, float).reshape(-1, 2, 3))


def corners(box):
    middle = box.T_world_object[:3, 3]
    return np.stack([middle - box.size / 2, middle + box.size / 2])


def view(eye, target=(0, 0.45, 0), chair=CHAIR):
    seen = room([FLOOR, chair], eye, target, noise=0.3)
    segmented = seen.label == 1
    return Cutout(jnp.float32(seen.depth), segmented, intrinsics_of(K), seen.T_world_camera)


@pytest.mark.parametrize("error", [-0.1, 0.0, 0.12])
def test_a_chair_seen_from_all_around_ends_where_it_does(error):
    box = box_of(TRUE[0] - [error, 0, error], TRUE[1] + error)
    views = [view(eye) for eye in AROUND]
    faces = faces_of(box, views)
    assert faces is not None and faces.seen[:, [0, 2]].all() and faces.seen[1, 1]
    np.testing.assert_allclose(corners(fitted(box, faces))[:, [0, 2]], TRUE[:, [0, 2]], atol=0.025)
    assert corners(fitted(box, faces))[1, 1] == pytest.approx(0.95, abs=0.025)


def test_a_castor_of_few_pixels_is_inside_the_box():
    castor = ((0.24, 0, -0.02), (0.28, 0.03, 0.02))
    views = [view(eye, chair=[*CHAIR, castor]) for eye in AROUND]
    faces = faces_of(box_of(*TRUE), views)
    assert faces is not None and faces.seen[1, 0] and 0.265 < faces.upper[0] < 0.3


def test_a_box_fits_until_a_face_is_seen_elsewhere_than_it_lies():
    deep = box_of(TRUE[0] - [0, 0, 0.08], TRUE[1])
    front, everywhere = [view(AROUND[0])], [view(eye) for eye in AROUND]
    assert not fits(deep, faces_of(deep, everywhere))
    faces = faces_of(deep, front)
    assert faces is not None and not faces.seen[0, 2]
    right = fitted(deep, faces_of(deep, everywhere))
    assert fits(right, faces_of(right, everywhere)) and fits(right, None)


def test_a_face_that_nobody_saw_stays_where_the_prior_put_it():
    """From the left and the right before it; how deep it is behind its back is a guess."""
    box = box_of(TRUE[0] - [0, 0, 0.15], TRUE[1])
    views = [view((side, 1.0, 0.9)) for side in (-1.3, 1.3)]
    faces = faces_of(box, views)
    assert faces is not None and not faces.seen[0, 2]
    assert faces.seen[:, 0].all() and faces.seen[1, 2]
    assert corners(fitted(box, faces))[0, 2] == pytest.approx(-0.37, abs=1e-6)


def test_the_air_before_a_back_says_nothing_of_the_seat():
    """Only the back is in sight: the box keeps the room for a seat."""
    box = box_of(TRUE[0], TRUE[1])
    faces = faces_of(box, [view((0.0, 1.3, 0.8), (0, 0.95, 0))])
    assert faces is not None and not faces.seen[1, 2]
    assert corners(fitted(box, faces))[1, 2] >= 0.22 - 1e-6


def test_a_box_with_a_floor_keeps_its_bottom_and_one_that_cuts_the_object_grows():
    slab = [[[-9, -9, -9], [9, -0.4, 9]]]
    box = box_of(TRUE[0], TRUE[1] - [0, 0.3, 0], slab)
    grown = fitted(box, faces_of(box, [view(AROUND[0])]))
    assert corners(grown)[0, 1] == pytest.approx(0.0, abs=1e-9)
    assert corners(grown)[1, 1] == pytest.approx(0.95, abs=0.03)
    # What was excluded stays excluded, wherever the middle of the box is now.
    points = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    low = points[:, 1] < box.T_world_object[1, 3] - 0.4
    assert not points_in_box(points[low], grown).any()


def test_without_a_point_of_the_object_there_are_no_faces():
    nothing = view(AROUND[0])._replace(segmented=np.zeros((120, 160), bool))
    assert faces_of(box_of(*TRUE), [nothing]) is None
    assert fitted(box_of(*TRUE), None).size.tolist() == box_of(*TRUE).size.tolist()


def test_the_reach_holds_the_box_and_stops_at_what_is_excluded():
    slab = [[[-9, -9, -9], [9, -0.4, 9]]]
    reach, column = reach_of(box_of(TRUE[0], TRUE[1], slab))
    inside = np.random.default_rng(0).uniform(TRUE[0], TRUE[1], (200, 3))
    inside = inside[inside[:, 1] > 0.475 - 0.4]
    assert points_in_box(inside, reach).all() and points_in_box(inside, column).all()
    under, beside, far = np.array([[[0.0, 0.01, 0.0]], [[0.5, 0.5, 0.0]], [[2.0, 0.5, 0.0]]])
    assert not points_in_box(under, reach).any() and not points_in_box(far, reach).any()
    assert points_in_box(beside, reach).all() and not points_in_box(beside, column).any()


def test_other_corners_of_a_turned_box_are_those_in_its_own_frame():
    T = look_from((1, 2, 3))
    box = between(Box(T, np.ones(3)), np.array([0.0, -1, 2]), np.array([1.0, 1, 5]))
    np.testing.assert_allclose(box.size, [1, 2, 3])
    middle = T[:3, :3] @ [0.5, 0, 3.5] + T[:3, 3]
    np.testing.assert_allclose(box.T_world_object[:3, 3], middle, atol=1e-12)
