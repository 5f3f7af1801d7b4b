"""The experiment runs from its command line, on a recording whose truth is known."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from drawn import is_drawn
from orbit_recording import write_recording
from PIL import Image

SCRIPT = Path(__file__).parents[2] / "experiments" / "real_recording.py"


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
