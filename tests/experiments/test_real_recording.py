"""The experiment clicks at the object, counts what is wrong and not said, and runs in small."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from drawn import is_drawn
from orbit_recording import write_recording
from PIL import Image

from jaxshape.data.boxes import Box
from jaxshape.data.sequences import Frame
from real_recording import middle_of, summary

SCRIPT = Path(__file__).parents[2] / "experiments" / "real_recording.py"


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
    assert found["summary"] == {
        "runs": 4, "refused": 1, "same chair": 1, "another": 2, "another and not said": 1,
    }  # fmt: skip


@pytest.mark.slow
def test_smoke(walk, tmp_path):
    recording = write_recording(tmp_path / "walk", walk)
    command = [sys.executable, SCRIPT, "--recording", recording, "--box", recording / "box.json",
               "--click", "64", "64", "--results", tmp_path, "--smoke"]  # fmt: skip
    subprocess.run(command, capture_output=True, text=True, check=True)
    ways = json.loads((tmp_path / "real_recording.json").read_text())["ways"]
    assert ways["given"]["rms_cm"] < 1e-3
    assert all(abs(x) < 8 for x in ways["given"]["box_center_cm"])
    assert ways["first"]["rms_cm"] < 5 and ways["none"]["rms_cm"] < 5
    assert is_drawn(tmp_path / "real_recording.png")
    assert Image.open(tmp_path / "real_recording.gif").n_frames == 72
    starts = json.loads((tmp_path / "first_frames.json").read_text())
    assert starts["summary"]["runs"] == 3 and set(starts["rows"]) == {
        "000000 given", "000000 first", "000000 none",
    }  # fmt: skip
