"""Meshes of two chairs after few frames."""

import json
from dataclasses import replace

import pytest

import surface_accuracy as script


@pytest.mark.slow
def test_surface_accuracy(linear_weights, tmp_path):
    script.main(replace(script.Config(), weights=linear_weights, smoke=True, results=tmp_path))
    content = json.loads((tmp_path / "surface_accuracy.json").read_text())
    assert len(content["rows"]) == 2
    for ways in content["means"].values():
        assert ways["seen to fused"][0] < 2 < ways["seen to voxels"][0]  # millimetres
        assert ways["measured to CAD"][0] < 3
