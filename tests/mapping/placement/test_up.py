"""Up where no floor is seen: an axis of the world, whichever its makers meant by it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxshape.mapping.placement.finding import _up


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
    found, said = _up(None, T, True)
    np.testing.assert_allclose(found, up, atol=1e-9)
    sign = "-" if sum(up) < 0 else "+"
    assert f"the world's {sign}{'xyz'[int(np.argmax(np.abs(up)))]} is taken as up" in said


def test_without_poses_or_axes_nearby_the_camera_is_taken_as_level():
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0.0, 0, 0.6]).as_matrix()
    found, said = _up(None, T, False)
    np.testing.assert_allclose(found, -T[:3, 1])
    assert "held level" in said
    oblique, _ = Rotation.align_vectors([[1, 1, 1]], [[0, -1, 0]])
    T[:3, :3] = oblique.as_matrix()
    assert "held level" in _up(None, T, True)[1]
