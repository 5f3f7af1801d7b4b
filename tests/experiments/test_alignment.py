"""The experiment measures the errors that it says."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from alignment import errors, medians
from jaxshape.data.boxes import Box


def test_errors_are_those_of_a_box_that_was_turned_scaled_and_moved():
    extents = np.array([0.4, 0.9, 0.5])
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("y", -12, degrees=True).as_matrix()
    T[:3, 3] = 0.03, 0, 0.04
    found = errors(Box(T, extents * (1.1, 1.0, 0.8)), extents)
    assert found["yaw"] == pytest.approx(-12)
    np.testing.assert_allclose(found["extents"], [10, 0, 20], atol=1e-9)
    assert found["centre"] == pytest.approx(5)
    rows = [{"placed": found}, {"placed": found | {"yaw": 2.0}}, {"placed": found | {"yaw": 4.0}}]
    assert medians(rows)["placed"] == {
        "yaw_degrees": 4.0, "extent_percent": 10.0, "worst_extent_percent": 20.0, "centre_cm": 5.0,
    }  # fmt: skip
