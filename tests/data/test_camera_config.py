"""The rules by which a camera's frames have noise and are fused."""

import pytest

from jaxshape.data.camera_config import CameraConfig


@pytest.mark.parametrize(
    "given, noisy, fused",
    [
        ({}, True, "distance"),
        ({"camera": "iphone-lidar"}, True, "distance"),
        ({"camera": "paper"}, False, "points"),
        ({"camera": "paper", "noise": True}, True, "distance"),
        ({"camera": "kinect", "noise": False}, False, "distance"),
        ({"camera": "kinect", "fusion": "points"}, True, "points"),
        ({"camera": "paper", "fusion": "distance"}, False, "distance"),
    ],
)
def test_points_are_for_clean_frames_of_the_papers_camera(given, noisy, fused):
    config = CameraConfig(**given)
    assert (config.is_noisy, config.fused_by) == (noisy, fused)
