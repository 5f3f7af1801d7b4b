"""The experiment runs from its command line, and finished variants are kept."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from drawn import is_drawn

from jaxshape.data.building import build_dataset
from jaxshape.data.config import DatasetConfig
from jaxshape.data.families import procedural_objects

SCRIPT = Path(__file__).parents[2] / "experiments" / "training_choices.py"


@pytest.mark.slow
def test_smoke(tmp_path):
    settings = DatasetConfig(frames=(1, 2), cameras=("paper",))
    for _ in build_dataset(tmp_path / "data", procedural_objects("chair", 12), settings, workers=1):
        pass
    command = [sys.executable, SCRIPT, "--dataset", tmp_path / "data", "--output", tmp_path / "out",
               "--smoke"]  # fmt: skip
    first = subprocess.run(command, capture_output=True, text=True, check=True)
    found = json.loads((tmp_path / "out" / "training_choices.json").read_text())
    assert set(found) == {"plain", "code 32"} and "step 1" in first.stdout
    assert 0 <= found["plain"]["procedural"]["8"]["bounds"]["ceiling"] <= 1
    assert is_drawn(tmp_path / "out" / "training_choices.png")
