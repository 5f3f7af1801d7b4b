"""The experiment runs on a recording whose truth is known; images go only where they may."""

import json

import numpy as np
import pytest
from drawn import is_drawn
from orbit_recording import write_recording

import real_chair
from jaxshape.process import prepare_process


@pytest.mark.slow
def test_smoke(walk, tmp_path):
    prepare_process()
    recording = write_recording(tmp_path / "walk", walk)
    config = real_chair.Config(
        recording=recording,
        box=recording / "box.json",
        results=tmp_path / "results",
        images=tmp_path / "images",
        smoke=True,
    )
    real_chair.main(config)
    found = json.loads((tmp_path / "results/real_chair.json").read_text())
    for way in ("given", "first"):
        end = list(found["rows"][way].values())[-1]
        assert 0 <= end["refined"]["violated"] < end["refined"]["explained"] <= 1
        assert end["refined"]["objective"] <= end["encoder"]["objective"]
        assert found["summary"][way] == end
    for folder in ("results", "images"):
        assert is_drawn(tmp_path / folder / "real_chair.png")


def test_pyramids_open_along_the_optical_axis():
    T = np.eye(4)
    T[:3, 3] = 1, 2, 3
    lines = real_chair._pyramid(T, length=0.5)
    assert np.allclose(lines[4:, 0], T[:3, 3])
    assert np.allclose(lines[:4, :, 2], 3.5)
