"""The notebooks of docs/notebooks run in small, and their figures show what their text says."""

import re
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest

import jaxshape as js

NOTEBOOKS = Path(__file__).parents[2] / "docs" / "notebooks"

SMALL = {
    "quickstart": {
        "FRAMES = 4": "FRAMES = 2",
        'virtual_camera("kinect")': "VirtualCamera(160, 120, 62.7)",
    },
    "gradients_against_cma_es": {"001, 1_000_005": "001, 1_000_003", "CALLS = 1020": "CALLS = 34"},
    "own_decoder": {
        "CHAIRS, CODE = 120, 24": "CHAIRS, CODE = 16, 8",
        "iterations=60": "iterations=10",
    },
    "own_category": {
        "TABLES, CODE = 80, 32": "TABLES, CODE = 12, 4",
        "iterations=40": "iterations=5",
    },
    "recording": {"12, 640, 480": "3, 160, 120"},
    "uncertainty_and_next_views": {
        "SAMPLES = 16": "SAMPLES = 4",
        "AZIMUTHS, ELEVATIONS = 36, 7": "AZIMUTHS, ELEVATIONS = 8, 2",
        'virtual_camera("kinect")': "VirtualCamera(160, 120, 62.7)",
    },
}
"""Of each notebook, text and the text that runs in its place."""

NAMES = sorted(SMALL)


class Run(NamedTuple):
    """A notebook after its last cell."""

    names: dict[str, Any]
    """Its variables."""
    figures: int
    """Figures that it showed."""
    folder: Path


@pytest.fixture
def run(tmp_path, monkeypatch, unchecked_types, linear_weights):
    """Run a notebook in small in an empty folder, with a prior that compiles at once."""

    def run(name: str) -> Run:
        code = (NOTEBOOKS / f"{name}.py").read_text()
        for said, done in SMALL[name].items():
            assert said in code, f"{name} no longer says {said!r}"
            code = code.replace(said, done)
        quick = f"js.load_prior({str(linear_weights)!r})"
        code = re.sub(r'js\.load_prior\(("chair-autoencoder")?\)', quick, code)
        monkeypatch.chdir(tmp_path)
        shown = []
        monkeypatch.setattr(plt, "show", lambda: shown.append(_pixels()))
        names: dict[str, Any] = {"__name__": "__main__"}
        exec(compile(code, name, "exec"), names)
        assert all(image.std() > 1 for image in shown), "a figure is blank"
        return Run(names, len(shown), tmp_path)

    yield run
    plt.close("all")


def _pixels() -> np.ndarray:
    figure = plt.gcf()
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())


def test_no_notebook_is_overlooked():
    assert sorted(path.stem for path in NOTEBOOKS.glob("*.py")) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_a_notebook_is_short_and_linked(name):
    text = (NOTEBOOKS / f"{name}.py").read_text()
    assert len(text.splitlines()) <= 110
    assert text.startswith("# %% [markdown]\n# # ")
    assert f"notebooks/{name}.py" in (NOTEBOOKS.parent / "index.md").read_text()


def test_quickstart_keeps_measured_voxels(run):
    ran = run("quickstart")
    found, grids = ran.names["found"], ran.names["grids"]
    sure = (grids.occluded < 0.01) & (grids.occupied > 0.99)
    assert sure.any() and found.composed[sure].all()
    assert ran.figures == 1 and (ran.folder / "chair.ply").stat().st_size > 1000


@pytest.mark.slow
def test_gradients_spend_as_many_calls_as_cma_es(run):
    ran = run("gradients_against_cma_es")
    price, found = ran.names["PRICE"], ran.names["found"]
    for method, one in found.items():
        assert 34 - price[method] < price[method] * one.trace.best_loss.shape[1] <= 34
        assert (jnp.diff(one.trace.best_loss) <= 0).all()
    assert ran.figures == 1


@pytest.mark.slow
def test_the_linear_decoder_explains_training_chairs_and_is_searched(run):
    names = run("own_decoder").names
    prior, surfaces = names["prior"], names["surfaces"]
    code = js.encode(prior, js.Grids(surfaces[:2], jnp.zeros_like(surfaces[:2])))
    mean = js.decode(prior, jnp.zeros_like(code))
    assert (
        js.iou(js.decode(prior, code) > 0, surfaces[:2] > 0) > js.iou(mean > 0, surfaces[:2] > 0)
    ).all()
    assert (names["found"].objective < names["found"].first_objective).all()


@pytest.mark.slow
def test_the_own_category_is_trained_by_the_command(run):
    ran = run("own_category")
    assert ran.names["prior"].code_size == 4
    assert "12" in (ran.folder / "out/table/table.md").read_text()
    assert len(list((ran.folder / "tables").glob("*.ply"))) == 12


@pytest.mark.slow
def test_the_recording_is_read_in_metres_and_mapped(run):
    names = run("recording").names
    sequence, film = names["sequence"], names["film"]
    assert sequence.layout == "tum" and len(sequence) == len(names["progress"].logs) == 3
    hit = np.isfinite(film.depth[1]) & (film.depth[1] > 0)
    np.testing.assert_allclose(sequence[1].depth[hit], film.depth[1][hit], atol=2e-4)
    T = film.T_object_camera.as_matrix()[1]
    np.testing.assert_allclose(sequence[1].T_world_camera, T, atol=1e-5)


@pytest.mark.slow
def test_the_best_view_settles_most(run):
    ran = run("uncertainty_and_next_views")
    ranked = ran.names["ranked"]
    assert ran.names["best"] == int(jnp.argmax(ranked.score)) and 0 < ran.names["settled"] <= 1
    np.testing.assert_allclose(jnp.sum(ran.names["share"]), 1, atol=1e-6)
    assert ran.figures == 2
