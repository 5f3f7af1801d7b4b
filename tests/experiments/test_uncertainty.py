"""Calibrations are judged by what came true, and drawn."""

import numpy as np
from PIL import Image

import uncertainty
from jaxshape.model.calibration import Calibration


def outcomes(count=20_000):
    """Voxels that are occupied as often as calibrated logits say."""
    rng = np.random.default_rng(0)
    logits, spread = rng.normal(0, 2, count), rng.uniform(0, 1, count)
    found = uncertainty.Voxels(logits, spread, np.zeros(count, bool))
    p = uncertainty.probability(found, Calibration(0.8, 0.1, -0.3))
    return found._replace(occupied=rng.random(count) < p)


def test_the_right_calibration_has_no_error_and_the_least_nats():
    found = outcomes()
    right = uncertainty.figures_of(found, Calibration(0.8, 0.1, -0.3))
    wrong = uncertainty.figures_of(found, Calibration())
    assert right["ece"] < 0.01 < wrong["ece"]
    assert right["nats"] < wrong["nats"]
    curve = right["curve"]
    assert abs(sum(curve["share"]) - 1) < 1e-3
    for said, came, share in zip(*curve.values(), strict=True):
        assert share < 0.01 or abs(said - came) < 0.05


def test_curves_are_drawn_for_each_set_and_number_of_frames(tmp_path):
    one = uncertainty.figures_of(outcomes(), Calibration())
    figures = {name: {str(k): {"decoder": one} for k in uncertainty.FRAMES} for name in "ab"}
    uncertainty.plot(figures, tmp_path / "curves.png")
    with Image.open(tmp_path / "curves.png") as image:
        assert image.size[0] > image.size[1] > 500
        dark = np.asarray(image.convert("L")) < 200
    half = dark.shape[0] // 2
    assert dark[:half].any() and dark[half:].any()
