"""Every script of the paper runs on two chairs, writes its results, and has nothing left to do."""

import importlib
import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

SCRIPTS = ["iou_by_frames"]
LONG = [
    "convergence",
    "objective",
    "step_size",
    "voluminous",
    "gallery",
    "gradient_failures",
    "equal_budget",
]


def check_claims_of_iou(content):
    """The first claim holds if the gains, computed again from the rows, are positive and grow."""
    few, many = (
        np.mean([row[k]["CMA-ES"]["iou"] - row[k]["encoder"]["iou"] for row in rows])
        for rows in [content["rows"].values()]
        for k in ("1", "4")
    )
    claim = content["claims"][0]
    assert claim["holds"] == ("yes" if many > few > 0 else "partly")
    assert f"{few:+.3f} (" in claim["ours"] and f"{many:+.3f} (" in claim["ours"]


@pytest.mark.parametrize(
    "name", [*SCRIPTS, *(pytest.param(name, marks=pytest.mark.slow) for name in LONG)]
)
def test_smoke(name, linear_weights, tmp_path, request):
    if name == "step_size":  # traces its settings
        request.getfixturevalue("unchecked_types")
    script = importlib.import_module(name)
    config = replace(script.Config(), weights=linear_weights, smoke=True, results=tmp_path)
    script.main(config)
    content = json.loads((tmp_path / f"{name}.json").read_text())
    assert content["rows"] and content["seconds"] > 0
    for claim in content["claims"]:
        assert set(claim) == {"figure", "claim", "ours", "holds"} and all(claim.values())
        assert "nan" not in claim["ours"]
    if name == "iou_by_frames":
        check_claims_of_iou(content)
    with Image.open(tmp_path / f"{name}.png") as image:
        assert image.size[0] >= 700 and image.convert("L").getextrema()[0] < 128  # not blank
    assert "<svg" in (tmp_path / f"{name}.svg").read_text()

    before = (tmp_path / f"{name}.json").read_text()
    script.main(config)
    assert (tmp_path / f"{name}.json").read_text() == before  # nothing was left to do
