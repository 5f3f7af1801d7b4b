"""Points against distances on two chairs."""

import json
from dataclasses import replace

import pytest

import measurement as script


@pytest.mark.slow
def test_measurement(linear_weights, tmp_path):
    config = replace(script.Config(), weights=linear_weights, smoke=True, results=tmp_path)
    script.main(config)
    content = json.loads((tmp_path / "measurement.json").read_text())
    F = {way: content["means"][way]["F"] for way in ("points", "distances")}
    assert len(content["rows"]) == 2 and F["distances"][1] > F["distances"][0]
    assert content["means"]["distances"]["oracle"][1] > content["means"]["points"]["oracle"][1]

    before = (tmp_path / "measurement.json").read_text()
    script.main(config)
    assert (tmp_path / "measurement.json").read_text() == before
