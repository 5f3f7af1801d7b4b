"""The model card: every fact of the run is in it, and its table says what was measured."""

from dataclasses import replace

import jax
import pytest

from jaxshape.model.config import TrainConfig
from jaxshape.model.training import Report
from jaxshape.model.weights import fingerprint, load_prior, save_prior
from jaxshape.report.card import COLUMNS, describe, hardware, rows_of, training_card

PATHS = {"paths": 3, "frames": [1, 4], "cameras": ["paper", "kinect"], "noisy": 0.25}
DATA = {"config": PATHS, "objects": 50, "used": 48, "source": "mugs/"}
METRICS = [Report(3, 0.5, 0.1, None, None, 9.0, 20.4), Report(5, 0.25, 0.75, 0.6, 0.4, 9.0, 30.3)]
SCORES = dict(
    iou=0.1, iou_composed=0.2, iou_occluded=0.3, cross_entropy_occluded=0.6, chamfer_l1=0.01234,
    f_score=0.4, objective=0.5,
)  # fmt: skip
MEANS = {"4": {"cma": SCORES, "bounds": {"occluded_empty": 0.6, "occluded_full": 0.7}}}
SEEN = {"camera": "kinect", "noise": True, "fusion": "distance"}
EVALUATED = {
    "config": SEEN | {"refine": {"iterations": 50}}, "per_mesh": [{}] * 5, "means": MEANS
}  # fmt: skip


def card_of(config=TrainConfig(steps=5, batch=2), start=None):  # noqa: B008 - it is frozen
    return training_card(
        config, METRICS, DATA, start=start, command="jaxshape train ...", licence="CC0"
    )


def test_a_card_tells_what_was_done():
    card = card_of()
    assert (card["samples"], card["samples_before"], card["start"]) == (10, 0, None)
    assert (card["training_loss"], card["training_iou"]) == (0.25, 0.75)
    assert card["training_seconds"] == 51
    text = describe("mug", card, EVALUATED)
    for said in (
        "mug.safetensors",
        "48 objects of `mugs/` (2 more could not be used), each filmed along 3 paths by a camera",
        "(paper, kinect), 25% with sensor noise; inputs are measurements of 1, 4 frames",
        "conditioned on the measurement",
        "IoU 0.600 of the decoded first codes, 0.400 in occluded voxels",
        "| Licence | CC0 |",
        "`jaxshape train ...`",
        "10 samples, 5 steps of 2",
        "51 s on",
        "0.2500 nats per voxel, IoU 0.750",
        "5 of the same folder",
        "camera kinect with noise, fused as signed distances; 50 iterations",
        "48 objects are few",
    ):
        assert said in text, said
    assert "Started from" not in text


def test_a_card_without_figures_says_so_and_many_objects_are_not_few():
    text = describe("mug", card_of() | {"data": DATA | {"used": 5000}})
    assert "None yet" in text and "few" not in text and "| cma |" not in text


def test_samples_add_up_over_runs(tmp_path, prior):
    for run, before in enumerate((0, 10, 20)):
        last = tmp_path / f"{run - 1}.safetensors"
        card = card_of(start=last if run else None)
        assert card["samples_before"] == before
        assert card["start"] == (fingerprint(load_prior(last)) if run else None)
        save_prior(tmp_path / f"{run}.safetensors", prior, card)
    assert "after 20 samples" in describe("mug", card)


def test_the_tables_hold_the_means():
    bounds = MEANS["4"]["bounds"] | {"ceiling": 0.8}
    rows = list(rows_of({"4": MEANS["4"] | {"bounds": bounds}}))
    assert rows[0] == ["4", "cma", "0.100", "0.200", "0.300", "0.600", "0.0123", "0.400", "0.500"]
    assert [row[:3] for row in rows[1:]] == [
        ["4", "F", "0.600"], ["4", "F or M", "0.700"], ["4", "ceiling", "0.800"]
    ]  # fmt: skip
    lines = describe("mug", card_of(), EVALUATED).splitlines()
    assert "| 4 | cma | 0.100 | 0.200 | 0.300 | 0.600 | 0.0123 | 0.400 | 0.500 |" in lines
    assert {len(row) for row in rows} == {len(COLUMNS)}


@pytest.mark.parametrize("bfloat16, said", [(True, "bfloat16"), (False, "float32")])
def test_the_precision_is_named(bfloat16, said):
    config = replace(TrainConfig(), bfloat16=bfloat16)
    assert said in describe("mug", card_of(config))


def test_hardware_names_devices_and_versions():
    assert jax.__version__ in hardware() and "Python 3." in hardware()
    assert "CPU cores" in hardware() or jax.devices()[0].platform != "cpu"
