"""Up where no floor is seen: the walls, or an axis of the world, whatever its makers meant."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxshape.mapping.placement.finding import _up
from jaxshape.mapping.segmentation.planes import Floor, Plane


def looking_down(degrees):
    """A camera in a world with +y up, which looks along -z and down by an angle."""
    level = np.diag([1.0, -1.0, -1.0])
    return Rotation.from_euler("x", -degrees, degrees=True).as_matrix() @ level


@pytest.mark.parametrize("degrees", [0, 25, 40])
@pytest.mark.parametrize("up", [[0, 1, 0], [0, 0, 1], [0, -1, 0], [-1, 0, 0]])
def test_the_axis_of_the_world_nearest_to_the_images_up(up, degrees):
    onto, _ = Rotation.align_vectors([up], [[0, 1, 0]])
    T = np.eye(4)
    T[:3, :3] = onto.as_matrix() @ looking_down(degrees)
    found, said = _up(None, None, T, True)
    np.testing.assert_allclose(found, up, atol=1e-9)
    sign = "-" if sum(up) < 0 else "+"
    assert f"the world's {sign}{'xyz'[int(np.argmax(np.abs(up)))]} is taken as up" in said


def test_without_poses_or_axes_nearby_the_camera_is_taken_as_level():
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0.0, 0, 0.6]).as_matrix()
    found, said = _up(None, None, T, False)
    np.testing.assert_allclose(found, -T[:3, 1])
    assert "assumed to be level" in said
    oblique, _ = Rotation.align_vectors([[1, 1, 1]], [[0, -1, 0]])
    T[:3, :3] = oblique.as_matrix()
    assert "assumed to be level" in _up(None, None, T, True)[1]


@pytest.mark.parametrize("confidence", [None, 0.0, 0.3, 0.9])
def test_walls_count_more_than_a_level_surface_that_may_be_a_table_top(confidence):
    T = np.eye(4)
    T[:3, :3] = looking_down(20)
    vertical, tilted = T[:3, :3].T @ [0.0, 1, 0], T[:3, :3].T @ [0.1, 1, 0]
    plane = Plane(tilted / np.linalg.norm(tilted), 1.0, 0.3)
    floor = None if confidence is None else Floor(plane, confidence)
    found, said = _up(floor, vertical, T, True)
    of_walls = confidence is None or confidence < 0.5
    expected = [0, 1, 0] if of_walls else T[:3, :3] @ plane.normal
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert ("walls give the up direction" in said) == of_walls
