"""Meshes of two chairs after few frames."""

import json
from dataclasses import replace

from test_smoke import load


def test_surface_accuracy(linear_prior, tmp_path, monkeypatch):
    script = load("surface_accuracy")
    monkeypatch.setattr(script, "load_prior", lambda: linear_prior)
    from jaxshape.search import reconstruction

    for network in ("encode", "decode"):
        monkeypatch.setattr(script, network, getattr(reconstruction, network))
    script.main(replace(script.Config(), smoke=True, results=tmp_path))
    content = json.loads((tmp_path / "surface_accuracy.json").read_text())
    assert len(content["rows"]) == 2
    for ways in content["means"].values():
        assert ways["seen to fused"][0] < 2 < ways["seen to voxels"][0]  # millimetres
        assert ways["measured to CAD"][0] < 3
