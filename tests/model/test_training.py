import shutil
from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest

from jaxshape.data.dataset import Dataset, pack, unpack
from jaxshape.model import training
from jaxshape.model.autoencoder import Architecture
from jaxshape.model.training import TrainConfig, batch_of, initial_state, read_metrics, train_step

OBJECTS, VIEWS = 7, 4
CONFIG = TrainConfig(
    Architecture((4, 4, 8, 8), (8, 8, 4), 10),
    steps=5, batch=2, learning_rate=1e-2, max_views=3, report_every=2,
)  # fmt: skip


@pytest.fixture(scope="module")
def dataset():
    """Random slabs, and views that each hold a random half of one."""
    rng = np.random.default_rng(0)
    surface = np.zeros((OBJECTS, 1, 32, 32, 32), bool)
    for i in range(OBJECTS):
        surface[i, 0, 4 * i : 4 * i + 6, 5:27, 5:27] = True
    views = surface & (rng.random((OBJECTS, VIEWS, 32, 32, 32)) < 0.5)
    packed = pack(np.concatenate([surface, views], axis=1))
    names = [f"object {i}" for i in range(OBJECTS)]
    return Dataset(names, [packed[:4], packed[4:]], [(i // 4, i % 4) for i in range(OBJECTS)])


@pytest.fixture(scope="module")
def whole_run(dataset, tmp_path_factory):
    """The folder of a run that was not interrupted, and its first checkpoint."""
    folder = tmp_path_factory.mktemp("run")
    reports = training.train(folder, dataset, CONFIG)
    first = next(reports)
    checkpoint = (folder / "checkpoint.safetensors").read_bytes()
    return folder, checkpoint, [first, *reports]


def views_of(dataset, surface):
    """The packed views of the object with a complete surface."""
    index = next(i for i in range(OBJECTS) if np.array_equal(unpack(dataset.packed(i)[0]), surface))
    return index, unpack(dataset.packed(index)[1:])


def test_a_batch_is_a_function_of_the_seed_and_the_step(dataset):
    first, again = batch_of(dataset, CONFIG, 3), batch_of(dataset, CONFIG, 3)
    jax.tree.map(np.testing.assert_array_equal, first, again)
    for other in (batch_of(dataset, CONFIG, 4), batch_of(dataset, replace(CONFIG, seed=1), 3)):
        assert (first[0] != other[0]).any()


def test_each_epoch_visits_each_object_once_in_an_order_of_its_own(dataset):
    surfaces = np.concatenate([batch_of(dataset, CONFIG, step)[1] for step in range(OBJECTS)])
    visited = np.array([views_of(dataset, surface)[0] for surface in surfaces])
    epochs = visited.reshape(2, OBJECTS)  # 7 batches of 2 are two epochs of 7
    np.testing.assert_array_equal(np.sort(epochs), np.tile(np.arange(OBJECTS), (2, 1)))
    assert (epochs[0] != epochs[1]).any()


def test_inputs_are_unions_of_one_to_the_most_views_of_the_object_itself(dataset):
    counts = set()
    for step in range(20):
        for measured, surface in zip(*batch_of(dataset, CONFIG, step), strict=True):
            views = views_of(dataset, surface)[1]
            chosen = [view for view in views if not (view & ~measured).any()]
            np.testing.assert_array_equal(np.any(chosen, axis=0), measured)
            counts.add(len(chosen))
    assert counts == {1, 2, 3}


def test_more_views_than_there_are_means_all_of_them(dataset):
    measured, _ = batch_of(dataset, replace(CONFIG, max_views=99, batch=OBJECTS), 0)
    assert measured.any(axis=(1, 2, 3)).all()


def losses_on_one_batch(dataset, config, count):
    step = jax.jit(partial(train_step, config=config))
    state, batch = initial_state(config), batch_of(dataset, config, 0)
    losses = []
    for _ in range(count):
        state, (loss, _) = step(state, *batch)
        losses.append(float(loss))
    assert int(state.step) == count
    assert all(x.dtype == np.float32 for x in jax.tree.leaves(state.variables))
    return np.array(losses)


def test_the_loss_falls_on_one_batch(dataset):
    losses = losses_on_one_batch(dataset, replace(CONFIG, steps=100), 15)
    np.testing.assert_allclose(losses[0], np.log(2), atol=0.02)  # every voxel undecided
    assert losses[-1] < 0.8 * losses[0]


@pytest.mark.slow
def test_training_in_bfloat16_follows_that_in_float32(dataset):
    config = replace(CONFIG, steps=100)
    losses = losses_on_one_batch(dataset, config, 4)
    halved = losses_on_one_batch(dataset, replace(config, bfloat16=True), 4)
    assert (halved != losses).any()
    np.testing.assert_allclose(halved, losses, rtol=0.03)


def test_a_killed_and_resumed_run_equals_an_unbroken_one_bit_for_bit(dataset, whole_run, tmp_path):
    """The kill falls after metrics were written for steps that are then repeated."""
    folder, first_checkpoint, reports = whole_run
    assert [r.step for r in reports] == [2, 4, 5]
    shutil.copy(folder / "metrics.jsonl", tmp_path)
    (tmp_path / "checkpoint.safetensors").write_bytes(first_checkpoint)
    resumed = list(training.train(tmp_path, dataset, CONFIG))
    assert [(r.step, r.loss, r.iou) for r in resumed] == [
        (r.step, r.loss, r.iou) for r in reports[1:]
    ]
    assert [r.step for r in read_metrics(tmp_path)] == [2, 4, 5]
    last = (folder / "checkpoint.safetensors").read_bytes()
    assert (tmp_path / "checkpoint.safetensors").read_bytes() == last != first_checkpoint


def test_metrics_on_disk_are_the_reports(whole_run, tmp_path):
    assert read_metrics(whole_run[0]) == whole_run[2]
    assert read_metrics(tmp_path) == []


def test_a_finished_run_has_nothing_left_to_do(dataset, whole_run):
    before = (whole_run[0] / "checkpoint.safetensors").read_bytes()
    assert list(training.train(whole_run[0], dataset, CONFIG)) == []
    assert (whole_run[0] / "checkpoint.safetensors").read_bytes() == before


def test_a_run_of_other_settings_is_refused(dataset, whole_run):
    with pytest.raises(ValueError, match="training run of other settings"):
        next(training.train(whole_run[0], dataset, replace(CONFIG, learning_rate=1e-3)))


def test_the_prior_describes_the_codes_of_the_training_set(dataset, whole_run):
    prior = training.finished_prior(whole_run[0], dataset, CONFIG)
    inputs, _ = batch_of(dataset, replace(CONFIG, batch=64, seed=CONFIG.seed + 1), 0)
    codes = np.asarray(jax.jit(training.encode)(prior.params, inputs))
    np.testing.assert_allclose(prior.code_mean, codes.mean(axis=0), atol=1e-5)
    covariance = np.asarray(prior.code_covariance)
    np.testing.assert_allclose(covariance, covariance.T)
    np.testing.assert_allclose(
        covariance, np.cov(codes, rowvar=False), atol=2e-3 * np.trace(covariance)
    )
    assert np.linalg.eigvalsh(covariance).min() > 0
