"""The experiment runs from its command line, and seats that are done are kept."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from drawn import is_drawn

from jaxshape.data.chairs import random_chair

SCRIPT = Path(__file__).parents[2] / "experiments" / "tracked_orbits.py"


@pytest.mark.slow
def test_smoke(tmp_path):
    (tmp_path / "seats").mkdir()
    random_chair(3).export(tmp_path / "seats" / "chair.ply")
    command = [sys.executable, SCRIPT, "--meshes", tmp_path / "seats", "--results", tmp_path,
               "--smoke"]  # fmt: skip
    first = subprocess.run(command, capture_output=True, text=True, check=True)
    found = json.loads((tmp_path / "tracked_orbits.json").read_text())
    assert "1 of 1 seats" in first.stdout
    assert found["summary"]["true poses"]["ate_mm_mean"] == 0
    assert 0 < found["summary"]["map, realigned"]["ate_mm_mean"] < 100
    assert is_drawn(tmp_path / "tracked_orbits.png")

    again = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "seats" not in again.stdout  # nothing was left to do
