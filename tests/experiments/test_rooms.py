"""Rooms stand as they say, and what is found in them is compared with the truth."""

import numpy as np
import pytest
import trimesh

from class_evidence import confusion
from jaxshape.data.boxes import Box
from rooms import box_overlap, furnished, summary


def test_objects_of_a_room_stand_on_the_floor_apart_from_each_other():
    for number in range(2):
        placed = furnished(number)
        assert 3 <= len(placed) <= 6
        meshes = [one.mesh.copy().apply_transform(one.T_world_object) for one in placed]
        assert [round(float(mesh.bounds[0, 1]), 6) for mesh in meshes] == [0.0] * len(meshes)
        for i, a in enumerate(meshes):
            for b in meshes[:i]:
                near = trimesh.convex.convex_hull(a).contains(b.vertices)
                assert not near.any()


@pytest.mark.parametrize(("shift", "expected"), [(0.0, 1.0), (0.5, 1 / 3), (2.0, 0.0)])
def test_overlap_of_boxes_is_that_of_their_volumes(shift, expected):
    T = np.eye(4)
    T[0, 3] = shift
    a, b = Box(np.eye(4), np.ones(3)), Box(T, np.ones(3))
    assert box_overlap(a, b) == pytest.approx(expected, abs=0.02)


def test_a_summary_counts_what_is_found_classed_and_wrong():
    def one(kind, name, yaw=0.0):
        return {"kind": kind, "found": True, "class": name, "yaw": yaw, "scale": [0.1, 0, 0],
                "iou": 0.5}  # fmt: skip

    room = {
        "objects": [
            one("chair", "chair", 350.0),
            one("box", None),
            {"kind": "table", "found": False},
        ],
        "false": [{"class": "chair"}],
        "cpu_seconds": 2.0,
    }
    alone = {"objects": [one("chair", "table")], "false": [], "cpu_seconds": 0.5}
    found = summary({"0": room, "chair 0 alone": alone})["summary"]
    assert found["seconds by objects"] == {"1": 0.5, "3": 2.0} and found["rooms"] == 1
    assert found["chair"]["classed chair"] == 1 and found["chair"]["yaw median"] == 10
    assert found["neither"]["classed None"] == 1 and found["table"]["found"] == 0
    assert found["false objects of a class"] == 1


def test_the_confusion_table_counts_classes_and_fronts():
    done = {
        "a": {"kind": "chair", "class": "chair", "quarters": 0},
        "b": {"kind": "chair", "class": "chair", "quarters": 2},
        "c": {"kind": "plant", "class": None, "quarters": 0},
    }
    table = confusion(done)["confusion"]
    assert table["chair"] == {"objects": 2, "chair": 2, "front right": 1}
    assert table["plant"] == {"objects": 1, "None": 1}
