import json

import numpy as np
import pytest

from jaxshape.data.boxes import points_in_box, read_box
from jaxshape.data.sequences import SequenceError


def turned(degrees, *t):
    """Object at `t` in the world, turned about its own +y."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    T = np.array([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1.0]])
    T[:3, 3] = t
    return T


def box_file(folder, content):
    path = folder / "box.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_points_are_inside_if_they_are_in_the_object_frame(tmp_path):
    T, size = turned(30, 1, 2, 3), np.array([0.4, 1.0, 0.6])
    hole = {"min": [-1, 0.2, 0.1], "max": [1, 1, 1]}
    content = {"T_world_object": T.tolist(), "size": size.tolist(), "exclude": [hole]}
    box = read_box(box_file(tmp_path, content))
    p_object = np.random.default_rng(0).uniform(-0.7, 0.7, (20, 50, 3))
    p_world = p_object @ T[:3, :3].T + T[:3, 3]

    def inside(p):
        in_box = all(abs(p[i]) <= size[i] / 2 for i in range(3))
        return in_box and not all(hole["min"][i] <= p[i] <= hole["max"][i] for i in range(3))

    expected = np.array([[inside(p) for p in row] for row in p_object])
    found = points_in_box(p_world, box)
    assert 50 < expected.sum() < 950
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("handedness", [1, -1])
def test_a_level_file_gives_a_right_handed_upright_box(tmp_path, handedness):
    """World: OpenCV camera axes. Level: X right, h up, Y ahead (or, left-handed, behind)."""
    world_to_level = np.array(
        [[1, 0, 0, 0.5], [0, 0, handedness, 0], [0, -1, 0, 1.2], [0, 0, 0, 1.0]]
    )
    ranges = {"X": [1, 2], "Y": [3, 3.4], "h": [0, 0.8]}
    content = {"world_to_level": world_to_level.tolist(), "chair_box_level": ranges}
    box = read_box(box_file(tmp_path, content))
    R = box.T_world_object[:3, :3]
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) > 0
    np.testing.assert_allclose(R @ (0, 1, 0), (0, -1, 0), atol=1e-12)  # up is against world y
    np.testing.assert_allclose(R @ (0, 0, 1), (1, 0, 0), atol=1e-12)  # front is level X

    p_level = np.random.default_rng(0).uniform((0.5, 2.5, -0.5), (2.5, 4, 1.2), (2000, 3))
    p_world = (p_level - world_to_level[:3, 3]) @ np.linalg.inv(world_to_level[:3, :3]).T
    low, high = np.array(list(ranges.values())).T
    expected = ((low <= p_level) & (p_level <= high)).all(axis=1)
    np.testing.assert_array_equal(points_in_box(p_world, box), expected)


def test_a_rule_of_the_level_frame_leaves_out_what_it_names(tmp_path):
    content = {
        "world_to_level": np.eye(4).tolist(),
        "chair_box_level": {"X": [0, 1], "Y": [0, 1], "h": [0, 1]},
        "exclude_level": "X > 0.5 and h < 0.25 (the table)",
    }
    box = read_box(box_file(tmp_path, content))
    points = np.random.default_rng(0).uniform(0, 1, (2000, 3))  # world and level are one here
    excluded = (points[:, 0] > 0.5) & (points[:, 2] < 0.25)
    np.testing.assert_array_equal(points_in_box(points, box), ~excluded)


def test_a_rule_in_words_is_refused(tmp_path):
    content = {
        "world_to_level": np.eye(4).tolist(),
        "chair_box_level": {"X": [0, 1], "Y": [0, 1], "h": [0, 1]},
        "exclude_level": "the table top",
    }
    with pytest.raises(SequenceError, match="'the table top' cannot be read"):
        read_box(box_file(tmp_path, content))


LEVEL = {
    "world_to_level": np.eye(4).tolist(),
    "chair_box_level": {"X": [0, 1], "Y": [0, 1], "h": [0, 1]},
}
GOOD = {"T_world_object": np.eye(4).tolist(), "size": [1, 1, 1]}


@pytest.mark.parametrize(
    "content, said",
    [
        ("{", "cannot be read as JSON"),
        ("[]", "holds a JSON list"),
        ({"size": [1, 1, 1]}, "gives None as T_world_object"),
        ({**GOOD, "size": [1, 1]}, r"gives \[1, 1\] as size; expected numbers of shape \(3,\)"),
        ({**GOOD, "size": [1, -1, 1]}, "expected positive extents"),
        ({**GOOD, "size": ["a", 1, 1]}, "as size"),
        ({**GOOD, "exclude": [{"min": [0, 0, 0]}]}, "gives None as max"),
        ({**GOOD, "exclude": {"min": [0, 0, 0], "max": [1, 1, 1]}}, "exclude"),
        ({**GOOD, "T_world_object": np.diag([1.0, 1, -1, 1]).tolist()}, "mirrors"),
        ("[" * 100_000, "nested more than"),
        ({**GOOD, "size": ["1", 1, 1]}, "as size"),
        ({**GOOD, "size": [True, 1, 1]}, "as size"),
        ({**GOOD, "size": [1e30, 1, 1]}, "as size"),
        ({**GOOD, "size": [1e-30, 1, 1]}, "0.001 to 1000 m"),
        ({**GOOD, "size": [float("nan"), 1, 1]}, "as size"),
        ({**GOOD, "exclude": [{"min": [0, 0, float("nan")], "max": [1, 1, 1]}]}, "as min"),
        ({**GOOD, "exclude": [{"min": [0, 2, 0], "max": [1, 1, 1]}]}, "min is above their max"),
        ({**GOOD, "T_world_object": [1] * 16}, "as T_world_object"),
        ({"world_to_level": [1], "chair_box_level": {}}, "as world_to_level"),
        ({**LEVEL, "world_to_level": np.diag([0, 0, 0, 1.0]).tolist()}, "not orthonormal"),
        ({**LEVEL, "world_to_level": np.diag([1, 1, 2, 1.0]).tolist()}, "not orthonormal"),
        ({**LEVEL, "chair_box_level": [1, 2]}, "as chair_box_level"),
        ({**LEVEL, "exclude_level": "(" * 100_000}, "shorten it"),
    ],
)
def test_faults_are_named(tmp_path, content, said):
    with pytest.raises(SequenceError, match=said):
        read_box(box_file(tmp_path, content))


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(SequenceError, match="box.json cannot be read"):
        read_box(tmp_path / "box.json")
