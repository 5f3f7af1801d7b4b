"""One layer more or less is another resolution: from meshes to a refined mesh, by the same code."""

import jax
import numpy as np
import pytest

from jaxshape.data.building import build_dataset
from jaxshape.data.capture import camera_distance, capture, measure_frames
from jaxshape.data.chairs import random_chair
from jaxshape.data.config import DatasetConfig
from jaxshape.data.dataset import open_dataset
from jaxshape.data.families import TEST_SEEDS, procedural_objects
from jaxshape.geometry import camera, fusion
from jaxshape.model.config import Architecture, TrainConfig
from jaxshape.model.training import finished_prior, train
from jaxshape.results.surface import surface
from jaxshape.search.config import RefineConfig
from jaxshape.search.reconstruction import reconstruct_jit, refiner_for


@pytest.mark.slow
@pytest.mark.parametrize(
    "encoder, decoder", [((4, 8, 8), (8, 8)), ((4, 8, 8, 16, 16), (16, 8, 8, 4))]
)
def test_a_network_of_another_resolution_trains_refines_and_meshes(tmp_path, encoder, decoder):
    sizes = Architecture(encoder, decoder, 8)
    n = sizes.resolution
    list(
        build_dataset(
            tmp_path / "d",
            procedural_objects("chair", 8),
            DatasetConfig(frames=(1, 2), cameras=("paper",), resolution=n),
            workers=1,
        )
    )
    dataset = open_dataset(tmp_path / "d")
    assert dataset.resolution == n
    config = TrainConfig(sizes, steps=30, batch=4, report_every=10)
    losses = [report.loss for report in train(tmp_path / "run", dataset, config)]
    assert losses[-1] < losses[0]
    prior = finished_prior(tmp_path / "run", dataset, config)
    assert prior.resolution == n

    mesh = random_chair(TEST_SEEDS)
    views = camera.orbit(4, camera_distance(mesh))
    seen = capture(mesh, views, noise=False, seed=0, resolution=n)
    merged = fusion.merge_all(measure_frames(seen))
    F, M = fusion.occupied(merged), fusion.occluded(merged)
    search = RefineConfig(iterations=10)
    run = reconstruct_jit(refiner_for("gradient:adam", prior, search), search)
    found = run(jax.random.key(0), prior, F[None], M[None])
    assert found.objective[0] < found.first_objective[0]
    rebuilt = surface(found.composed[0], seen.frame)
    np.testing.assert_allclose(rebuilt.extents, mesh.extents, atol=3 * float(mesh.scale) / n)


def test_a_dataset_of_another_resolution_is_refused(tmp_path):
    list(
        build_dataset(
            tmp_path / "d",
            procedural_objects("chair", 2),
            DatasetConfig(frames=(1,), cameras=("paper",), resolution=8),
            workers=1,
        )
    )
    dataset = open_dataset(tmp_path / "d")
    config = TrainConfig(Architecture((4, 4, 4), (4, 4), 4), steps=1, batch=1)
    with pytest.raises(ValueError, match=r"grids of 8\^3 voxels, and the network .* 16\^3"):
        next(train(tmp_path / "run", dataset, config))
