"""Every script of the paper runs on few chairs, writes its results, and has nothing left to do."""

import importlib
import json
from dataclasses import replace

import numpy as np
import pytest
from marks import slow
from PIL import Image

SCRIPTS = ["iou_by_frames"]
LONG = [
    "convergence",
    "objective",
    "step_size",
    "gallery",
    "gradient_failures",
    "equal_budget",
]


def check_gains_of_iou(content):
    """The gains of CMA-ES over the encoder are the means, computed again from the rows."""
    found = content["summary"]["procedural"]["CMA-ES less encoder"]
    for k, (mean, low, high) in found.items():
        gains = [row[k]["CMA-ES"]["iou"] - row[k]["encoder"]["iou"]
                 for row in content["rows"].values()]  # fmt: skip
        assert mean == pytest.approx(np.mean(gains), rel=1e-4) and low <= mean <= high


def check_voluminous(folder):
    """The two voluminous chairs among the first eleven have their rows and their picture."""
    content = json.loads((folder / "voluminous.json").read_text())
    assert set(content["rows"]) == {"chair-1000009", "chair-1000010"}
    assert content["summary"]["procedural"]["occluded voxels that are empty"]["1"][0] > 0.5
    check_picture(folder / "voluminous")


def check_picture(stem):
    with Image.open(stem.with_suffix(".png")) as image:
        assert image.size[0] >= 700 and image.convert("L").getextrema()[0] < 128  # not blank
    assert "<svg" in stem.with_suffix(".svg").read_text()


@pytest.mark.parametrize("name", [*SCRIPTS, *map(slow, LONG)])
def test_smoke(name, linear_weights, tmp_path, request):
    if name == "step_size":  # traces its settings
        request.getfixturevalue("unchecked_types")
    script = importlib.import_module(name)
    config = replace(script.Config(), weights=linear_weights, smoke=True, results=tmp_path)
    script.main(config)
    content = json.loads((tmp_path / f"{name}.json").read_text())
    assert content["rows"] and content["seconds"] > 0
    assert content["summary"] and "NaN" not in json.dumps(content["summary"])
    check_picture(tmp_path / name)
    if name == "iou_by_frames":
        check_gains_of_iou(content)
        check_voluminous(tmp_path)

    before = (tmp_path / f"{name}.json").read_text()
    script.main(config)
    assert (tmp_path / f"{name}.json").read_text() == before  # nothing was left to do
