"""Cameras around an object, and their places in words."""

import numpy as np
import pytest

import jaxshape as js
from jaxshape.mapping.views.candidates import in_words


def test_cameras_are_within_reach_and_look_at_the_object():
    T = js.reachable_views(2.0, -0.45, heights=(0.3, 1.8))
    eyes = np.asarray(T.translation())
    assert len(eyes) == 252
    assert np.allclose(np.linalg.norm(eyes, axis=1), 2.0, atol=1e-5)
    height = eyes[:, 1] + 0.45
    assert height.min() == pytest.approx(0.3, abs=1e-4)
    assert height.max() == pytest.approx(1.8, abs=1e-4)
    ahead = np.asarray(T.rotation().as_matrix())[:, :, 2]
    assert np.allclose(ahead, -eyes / 2.0, atol=1e-4)


@pytest.mark.parametrize(
    ("azimuth", "words"),
    [
        (0, "from the front, at 2.0 m, camera 0.5 m above the floor"),
        (30, "from the front, 30 degrees towards its left side, at 2.0 m"),
        (70, "from its left side, 20 degrees towards its front, at 2.0 m"),
        (140, "from behind, 40 degrees towards its left side, at 2.0 m"),
        (-170, "from behind, 10 degrees towards its right side, at 2.0 m"),
        (-60, "from its right side, 30 degrees towards its front, at 2.0 m"),
    ],
)
def test_places_in_words(azimuth, words):
    a = np.radians(azimuth)
    eye = 2.0 * np.array([np.sin(a), 0, np.cos(a)])
    assert in_words(eye, -0.5).startswith(words)


def test_impossible_spheres_are_refused():
    with pytest.raises(ValueError, match="radius"):
        js.reachable_views(0.0, -0.4)
    with pytest.raises(ValueError, match="heights"):
        js.reachable_views(2.0, -0.4, heights=(2.0, 1.0))
