"""The experiment films a seat as it says, and compares boxes with the truth."""

import numpy as np
import trimesh

from hand_held import T_WORLD_OBJECT, record, sides_of, summary
from jaxshape.data.boxes import Box
from jaxshape.data.sequences import open_sequence


def test_a_seat_is_filmed_from_close_up_and_its_own_box_is_right(tmp_path):
    seat = trimesh.creation.box((0.4, 0.9, 0.5))
    seen = record(tmp_path, seat, 3, seed=0)
    sequence = open_sequence(tmp_path)
    assert len(sequence) == 3 and sequence.has_poses
    column, row = (int(x) for x in seen.click)
    first, last = sequence[0], sequence[2]
    assert 0.3 < first.depth[row, column] < 1.2  # the seat is under the click, and near
    near, far = (np.linalg.norm(one.T_world_camera[:3, 3] - T_WORLD_OBJECT[:3, 3])
                 for one in (first, last))  # fmt: skip
    assert far > near + 0.5
    right = Box(T_WORLD_OBJECT, np.array([0.4, 0.9, 0.5]))
    np.testing.assert_allclose(sides_of(right, seen), 0, atol=1e-9)
    wide = right._replace(size=np.array([0.5, 0.9, 0.5]))
    np.testing.assert_allclose(sides_of(wide, seen), [-0.05, 0, 0, 0.05, 0, 0], atol=1e-9)


def test_a_wrong_box_counts_as_said_only_with_a_word_of_it():
    right = {"sides": [0.01] * 6, "warnings": [], "verdict": "good"}
    wrong = {"sides": [0.0, 0, 0.08, 0, 0, 0], "warnings": [], "verdict": "good"}
    said, low = {**wrong, "verdict": "doubtful"}, {**wrong, "sides": [0.0, 0.2, 0, 0, 0, 0]}
    found = summary({"a": right, "b": wrong, "c": said, "d": low})
    assert found["summary"] == {
        "seats": 4, "whole": 2, "wrong": 3, "wrong and not said": 2, "right and good": 1,
    }  # fmt: skip
