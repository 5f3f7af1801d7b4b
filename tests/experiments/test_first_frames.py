"""The experiment clicks at the object, and counts what is wrong and not said."""

import numpy as np

from first_frames import middle_of, summary
from jaxshape.data.boxes import Box
from jaxshape.data.sequences import Frame


def test_the_click_shows_the_middle_of_what_lies_in_the_box():
    depth = np.full((40, 60), 3.0, np.float32)
    depth[10:31, 20:51] = 1.0
    depth[15:25, 30:40] = 0.0  # a hole in its middle
    K = np.array([[50.0, 0, 30], [0, 50, 20], [0, 0, 1]])
    T = np.eye(4)
    T[:3, 3] = 5.0
    frame = Frame(depth=depth, color=None, mask=None, T_world_camera=T, intrinsics=K, name="0")
    box = Box(T, np.array([2.0, 2.0, 2.4]))
    column, row = middle_of(frame, box)
    assert depth[int(row), int(column)] == 1.0
    assert abs(column - 35.5) < 7 and abs(row - 20.5) < 7


def test_another_chair_counts_as_said_with_a_word_of_it():
    same = {"off": [0.02, -0.01, 0.0], "verdict": "good", "warnings": []}
    other = same | {"off": [0.0, 0.05, 0.0]}
    said = other | {"verdict": "doubtful"}
    found = summary({"a": same, "b": other, "c": said, "d": {"failed": "It is not seen."}})
    assert found == {
        "runs": 4, "refused": 1, "same chair": 1, "another": 2, "another and not said": 1,
    }  # fmt: skip
