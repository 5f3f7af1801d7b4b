import json
import shutil
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import tiny_training
from marks import slow
from tiny_training import CONFIG, NUMBERS, OBJECTS, PATHS

from jaxshape.data.config import DATASETS, FAULTLESS, InputConfig
from jaxshape.geometry.overlap import iou
from jaxshape.model import autoencoder, training
from jaxshape.model.config import PRESETS, Architecture, Completion
from jaxshape.model.families import Batch
from jaxshape.model.shapes import decode, encode
from jaxshape.model.training import (
    TrainState,
    batch_of,
    initial_state,
    read_metrics,
    train_step,
    validation_batch,
    validation_size,
)
from jaxshape.model.weights import load_prior

SMALL = Completion((4, 4, 4), 1, 3, 16)
CLEAN = replace(CONFIG, inputs=InputConfig(complete=0.0, mirror=False, warp=0.0))


def object_of(dataset, surface):
    """Number and path of the object with a complete surface."""
    return next(
        (i, path)
        for i in range(OBJECTS)
        for path in range(PATHS)
        if np.array_equal(dataset.surface(i, path), surface)
    )


# ------------------------------------------------------------------ batches


def test_a_batch_is_a_function_of_the_seed_and_the_step(dataset):
    first, again = batch_of(dataset, CONFIG, 3), batch_of(dataset, CONFIG, 3)
    jax.tree.map(np.testing.assert_array_equal, first, again)
    for other in (batch_of(dataset, CONFIG, 4), batch_of(dataset, replace(CONFIG, seed=1), 3)):
        assert (first.occupied != other.occupied).any()


@pytest.mark.parametrize("count", [2, 4])
def test_a_batch_in_parts_is_the_whole_batch(dataset, count):
    whole = batch_of(dataset, CONFIG, 3)  # over the end of an epoch: pairs 12 to 15 of 7 objects
    parts = [batch_of(dataset, CONFIG, 3, (i, count)) for i in range(count)]
    for grids, expected in zip(zip(*parts, strict=True), whole, strict=True):
        assert all(len(grid) == CONFIG.batch // count for grid in grids)
        np.testing.assert_array_equal(np.concatenate(grids), expected)


def test_each_epoch_visits_each_object_once_in_an_order_of_its_own(dataset):
    surfaces = np.concatenate([batch_of(dataset, CLEAN, step).surface for step in range(OBJECTS)])
    visited = np.array([object_of(dataset, surface)[0] for surface in surfaces])
    epochs = visited.reshape(4, OBJECTS)  # 7 batches of 4 are four epochs of 7
    np.testing.assert_array_equal(np.sort(epochs), np.tile(np.arange(OBJECTS), (4, 1)))
    assert len({tuple(epoch) for epoch in epochs}) > 1


def test_clean_inputs_are_measurements_of_the_object_itself(dataset):
    drawn = set()
    for step in range(10):
        for F, M, surface in zip(*batch_of(dataset, CLEAN, step), strict=True):
            index, path = object_of(dataset, surface)
            inputs = [dataset.grids(index, path, k) for k in range(NUMBERS)]
            (number,) = [k for k in range(NUMBERS) if np.array_equal(inputs[k].occupied, F)]
            np.testing.assert_array_equal(inputs[number].occluded, M)
            drawn.add((path, number))
    assert len(drawn) == PATHS * NUMBERS


def test_objects_kept_out_are_in_no_batch_and_in_the_validation(monkeypatch, dataset):
    monkeypatch.setattr(training, "validation_size", lambda *_: 2)
    seen = {
        object_of(dataset, surface)[0]
        for step in range(10)
        for surface in batch_of(dataset, CLEAN, step).surface
    }
    kept = [object_of(dataset, surface)[0] for surface in validation_batch(dataset, CLEAN).surface]
    assert seen == set(range(OBJECTS - 2)) and kept == [OBJECTS - 2, OBJECTS - 1]


def test_at_most_a_tenth_is_kept_out(dataset):
    assert validation_size(dataset, CONFIG) == 0 and validation_batch(dataset, CONFIG) is None
    many = dataset._replace(names=["x"] * 3000)
    assert validation_size(many, CONFIG) == CONFIG.validation
    assert validation_size(dataset._replace(names=["x"] * 50), CONFIG) == 5


# ------------------------------------------------------------------ one step


class FixedNetwork:
    """In place of the network: the logits and the code that its parameters say, for every grid."""

    def __init__(self, *_):
        pass

    def apply(self, variables, measured, *, noise, **_):
        params = variables["params"]
        code = jnp.broadcast_to(params["code"], (len(measured), *params["code"].shape))
        logits = jnp.broadcast_to(params["logit"], measured.shape[:-1]) + 0 * jnp.sum(noise)
        return (logits, code), {}


LOGIT, CODE = 0.7, np.array([1.0, -2.0, 3.0], np.float32)


@pytest.fixture
def first_step(monkeypatch):
    """The step of a fixed network on grids of which an eighth is occupied."""
    monkeypatch.setattr(autoencoder, "AutoEncoder", FixedNetwork)
    surface = np.zeros((2, 32, 32, 32), bool)
    surface[:, :16, :16, :16] = True
    params = {"logit": jnp.float32(LOGIT), "code": jnp.asarray(CODE)}

    def step(**settings):
        config = replace(CONFIG, **{"code_weight": 0.0} | settings)
        optimizer = training.optimizer_for(config).init(params)
        state = TrainState(jnp.zeros((), jnp.int32), {"params": params}, optimizer, ())
        hidden = np.zeros(surface.shape, np.float32)
        hidden[:, :8] = 1  # half of the surface, a quarter of all
        batch = Batch(surface.astype(np.float32), hidden, surface)
        state, (loss, iou) = jax.jit(partial(train_step, config=config))(state, batch)
        return float(loss), float(iou), state.variables["params"]

    return step


def test_the_loss_weighs_occupied_voxels(first_step):
    for weight in (1.0, 1.5):
        loss, iou, _ = first_step(occupied_weight=weight)
        occupied, free = np.log1p(np.exp(-LOGIT)), np.log1p(np.exp(LOGIT))
        np.testing.assert_allclose(loss, weight * occupied / 8 + free * 7 / 8, rtol=1e-5)
        np.testing.assert_allclose(iou, 1 / 8)  # everything is completed


def test_the_loss_weighs_occluded_voxels(first_step):
    occupied, free = np.log1p(np.exp(-LOGIT)), np.log1p(np.exp(LOGIT))
    loss, _, _ = first_step(occupied_weight=1.0, occluded_weight=3.0)
    expected = occupied / 8 + free * 7 / 8 + 2 * (occupied / 16 + free * 3 / 16)
    np.testing.assert_allclose(loss, expected, rtol=1e-5)


@pytest.mark.slow
def test_the_running_average_follows_the_parameters_slowly():
    config = replace(CONFIG, architecture=SMALL, average=0.9, bfloat16=False)
    state = initial_state(config)
    rng = np.random.default_rng(0)
    surface = rng.random((2, 16, 16, 16)) < 0.2
    batch = Batch(np.float32(surface), np.zeros(surface.shape, np.float32), surface)
    step = jax.jit(partial(train_step, config=config))
    average = state.average
    for number in range(3):
        state, _ = step(state, batch)
        share = min(0.9, (1 + number) / (10 + number))
        params = state.variables["params"]
        average = jax.tree.map(lambda a, p, s=share: s * a + (1 - s) * p, average, params)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-6), state.average, average)
    assert training.averaged(state)["params"] is state.average


def test_the_weight_of_codes_adds_half_their_squared_length_a_voxel(first_step):
    plain, _, unmoved = first_step()
    np.testing.assert_array_equal(unmoved["code"], CODE)
    weighted, _, moved = first_step(code_weight=100.0)
    np.testing.assert_allclose(weighted - plain, 100 * 0.5 * np.sum(CODE**2) / 32**3, rtol=1e-4)
    assert (np.abs(moved["code"]) < np.abs(CODE)).all()


def test_muon_orthogonalizes_the_moves_of_kernels_and_leaves_the_rest_to_adam():
    config = replace(CONFIG, optimizer="muon", schedule="constant", learning_rate=0.01)
    rng = np.random.default_rng(0)
    params = {"kernel": jnp.zeros((5, 5, 5, 2, 6)), "bias": jnp.zeros(6)}
    gradients = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape), x.dtype), params)
    optimizer = training.optimizer_for(config)
    moves, _ = jax.jit(optimizer.update)(gradients, optimizer.init(params), params)
    values = np.linalg.svd(np.reshape(moves["kernel"], (-1, 6)), compute_uv=False)
    assert values.max() < 1.8 * values.min()  # Newton-Schulz leaves them between 0.7 and 1.2
    adam = optax.adam(0.01, nesterov=True)
    expected, _ = adam.update(gradients["bias"], adam.init(params["bias"]))
    np.testing.assert_allclose(moves["bias"], expected, rtol=1e-3)


def test_the_cosine_schedule_warms_up_and_ends_with_steps_of_nothing():
    optimizer = training.optimizer_for(replace(CONFIG, schedule="cosine", steps=20))
    gradient, state, moves = jnp.ones(3), optimizer.init(jnp.zeros(3)), []
    for _ in range(21):
        move, state = optimizer.update(gradient, state)
        moves.append(-float(move[0]))
    np.testing.assert_allclose(max(moves), CONFIG.learning_rate, rtol=1e-4)
    np.testing.assert_allclose([moves[0], moves[-1]], 0, atol=1e-9)
    assert np.argmax(moves) == 2 and (np.diff(moves[2:]) < 0).all()


def losses_on_one_batch(step, state, batch, count):
    losses = []
    for _ in range(count):
        state, (loss, _) = step(state, batch)
        losses.append(float(loss))
    assert int(state.step) == count
    assert all(x.dtype == np.float32 for x in jax.tree.leaves(state.variables))
    return np.array(losses)


def test_the_loss_falls_on_one_batch(dataset, whole_run, start):
    state = initial_state(CONFIG, load_prior(start))
    batch = jax.device_put(batch_of(dataset, CONFIG, 0))
    losses = losses_on_one_batch(whole_run.programs[0], state, batch, 60)
    assert losses[-5:].mean() < 0.9 * losses[:5].mean()


@pytest.mark.slow
def test_training_in_bfloat16_follows_that_in_float32(dataset):
    def losses(config):
        step = jax.jit(partial(train_step, config=config))
        return losses_on_one_batch(step, initial_state(config), batch_of(dataset, config, 0), 4)

    config = replace(CLEAN, learning_rate=1e-2, occupied_weight=1.0)
    full, halved = losses(config), losses(replace(config, bfloat16=True))
    assert (halved != full).any()
    np.testing.assert_allclose(halved, full, rtol=0.03)


# ------------------------------------------------------------------ a run


def test_a_killed_and_resumed_run_equals_an_unbroken_one_bit_for_bit(
    dataset, whole_run, start, tmp_path, monkeypatch
):
    """The kill falls after metrics were written for steps that are then repeated."""
    assert [r.step for r in whole_run.reports] == [2, 4, 5]
    tiny_training.make_quick(monkeypatch.setattr, whole_run.programs)
    shutil.copy(whole_run.folder / "metrics.jsonl", tmp_path)
    (tmp_path / "checkpoint.safetensors").write_bytes(whole_run.first_checkpoint)
    resumed = list(training.train(tmp_path, dataset, CONFIG, load_prior(start)))
    assert [(r.step, r.loss, r.iou) for r in resumed] == [
        (r.step, r.loss, r.iou) for r in whole_run.reports[1:]
    ]
    assert [r.step for r in read_metrics(tmp_path)] == [2, 4, 5]
    last = (whole_run.folder / "checkpoint.safetensors").read_bytes()
    assert (tmp_path / "checkpoint.safetensors").read_bytes() == last
    assert last != whole_run.first_checkpoint


@pytest.mark.parametrize("optimizer", ["adam", "muon"])
def test_a_checkpoint_holds_the_whole_state(optimizer, start, tmp_path):
    config = replace(CONFIG, optimizer=optimizer)
    state = initial_state(config, load_prior(start))
    state = jax.tree.map(lambda x: np.asarray(x) + np.ones((), x.dtype), state)
    training.save_checkpoint(tmp_path, state, "a run")
    again = training._read_checkpoint(tmp_path / "checkpoint.safetensors", config)
    jax.tree.map(np.testing.assert_array_equal, again, state)


def test_metrics_on_disk_are_the_reports(whole_run, tmp_path):
    assert read_metrics(whole_run.folder) == whole_run.reports
    assert read_metrics(tmp_path) == []


@pytest.mark.parametrize("name, value", [("step", "4"), ("step", None), ("loss", [1])])
def test_metrics_that_are_no_numbers_are_named(whole_run, tmp_path, name, value):
    lines = [json.dumps(report._asdict() | {name: value}) for report in whole_run.reports]
    (tmp_path / "metrics.jsonl").write_text("\n".join(lines))
    with pytest.raises(ValueError, match=f"metrics.jsonl' is damaged .a {name} is .*not a number"):
        read_metrics(tmp_path)


def test_a_finished_run_has_nothing_left_to_do(dataset, whole_run, start):
    before = (whole_run.folder / "checkpoint.safetensors").read_bytes()
    assert list(training.train(whole_run.folder, dataset, CONFIG, load_prior(start))) == []
    assert (whole_run.folder / "checkpoint.safetensors").read_bytes() == before


def test_a_run_of_other_settings_or_another_start_is_refused(dataset, whole_run, start):
    prior = load_prior(start)
    other = prior._replace(code_mean=prior.code_mean + 1)
    for config, begin in ((replace(CONFIG, seed=1), prior), (CONFIG, None), (CONFIG, other)):
        with pytest.raises(ValueError, match="training run of other settings"):
            next(training.train(whole_run.folder, dataset, config, begin))


def test_a_run_on_another_dataset_is_refused(dataset, whole_run, start):
    """Its weights would be those of the first dataset, under the name of the second."""
    renamed = dataset._replace(names=[f"table {name}" for name in dataset.names])
    other = dataset._replace(measured=[np.asarray(x)[:, ::-1] for x in dataset.measured])
    for pairs in (renamed, other):
        with pytest.raises(ValueError, match="on another dataset"):
            list(training.train(whole_run.folder, pairs, CONFIG, load_prior(start)))


def test_a_checkpoint_that_does_not_name_its_pairs_is_resumed(dataset, whole_run, start, tmp_path):
    """As earlier versions wrote them."""
    run = json.loads(training._identity(CONFIG, load_prior(start), dataset))
    del run["pairs"]
    state = training._read_checkpoint(whole_run.folder / "checkpoint.safetensors", CONFIG)
    training.save_checkpoint(tmp_path, state, json.dumps(run))
    assert list(training.train(tmp_path, dataset, CONFIG, load_prior(start))) == []


def test_a_run_starts_with_a_copy_of_the_weights_it_is_given(start):
    prior = load_prior(start)
    state = initial_state(CONFIG, prior)
    jax.tree.map(np.testing.assert_array_equal, state.variables, prior.params)
    jax.tree.map(lambda x: x.delete(), state.variables)
    assert not any(x.is_deleted() for x in jax.tree.leaves(prior.params))


def test_weights_of_other_sizes_are_no_start(start):
    wider = replace(CONFIG, architecture=Architecture((4, 4, 8, 8), (8, 8, 4), 12))
    with pytest.raises(ValueError, match=r"start from are of .*code=10.*the run of .*code=12"):
        initial_state(wider, load_prior(start))


def test_the_prior_describes_the_codes_of_the_training_set(dataset, whole_run, monkeypatch):
    tiny_training.make_quick(monkeypatch.setattr, whole_run.programs)
    prior = whole_run.prior
    batch = batch_of(dataset, replace(CONFIG, batch=64, seed=CONFIG.seed + 1), 0)
    codes = np.asarray(jax.jit(encode)(prior, batch.grids))
    np.testing.assert_allclose(prior.code_mean, codes.mean(axis=0), atol=1e-5)
    covariance = np.asarray(prior.code_covariance)
    np.testing.assert_allclose(covariance, covariance.T)
    np.testing.assert_allclose(
        covariance, np.cov(codes, rowvar=False), atol=2e-3 * np.trace(covariance)
    )
    assert np.linalg.eigvalsh(covariance).min() > 0


def test_the_paper_preset_is_the_paper(dataset):
    """Sections 2.2 and 2.3: single views as they are, the plain loss, Adam at 1e-4."""
    paper = PRESETS["paper"]
    assert (paper.optimizer, paper.learning_rate, paper.schedule) == ("adam", 1e-4, "constant")
    assert (paper.occupied_weight, paper.code_noise, paper.code_weight) == (1, 0, 0)
    assert paper.architecture == Architecture((32, 64, 128, 256), (256, 128, 64), 100)
    data = DATASETS["paper"]
    assert (data.paths, data.frames, data.cameras) == (18, (1,), ("paper",))
    assert (data.noisy, data.arcs, data.faults) == (0, 0, FAULTLESS)
    assert paper.inputs == InputConfig(complete=0.0, mirror=False, warp=0.0)
    assert (paper.average, paper.occluded_weight, paper.validation) == (0, 1, 0)


@pytest.mark.slow
def test_a_completion_network_learns_one_batch(dataset):
    config = replace(
        CONFIG, architecture=Completion((8, 16, 16), 1, 8), average=0.5, code_weight=1.0
    )
    batch = batch_of(dataset, config, 0)
    state, step = initial_state(config), jax.jit(partial(train_step, config=config))
    losses = losses_on_one_batch(step, state, batch, 60)
    assert losses[-5:].mean() < 0.5 * losses[:5].mean()


def test_the_prior_of_a_completion_network_is_normal(dataset, tmp_path):
    config = replace(CONFIG, architecture=Completion((4, 4, 4), 1, 3), average=0.5)
    state = initial_state(config)
    training.save_checkpoint(tmp_path, state, "a run")
    prior = training.finished_prior(tmp_path, dataset, config)
    np.testing.assert_array_equal(prior.code_mean, np.zeros(3))
    np.testing.assert_array_equal(prior.code_covariance, np.eye(3))
    jax.tree.map(np.testing.assert_array_equal, prior.params, state.average)


@pytest.mark.parametrize("architecture", [slow(CONFIG.architecture), Completion((4, 4, 4), 1, 3)])
def test_reports_score_the_objects_kept_out(monkeypatch, dataset, tmp_path, architecture):
    monkeypatch.setattr(training, "validation_size", lambda *_: 2)
    config = replace(CONFIG, architecture=architecture, steps=1, average=0.5)
    (report,) = training.train(tmp_path, dataset, config)
    prior, kept = (
        training.finished_prior(tmp_path, dataset, config),
        validation_batch(dataset, config),
    )
    completed = np.asarray(decode(prior, encode(prior, kept.grids), kept.grids)) > 0
    hidden = kept.occluded > 0.5
    for found, at in ((report.validation_iou, True), (report.validation_occluded, hidden)):
        expected = np.mean(iou(completed & at, kept.surface & at))
        assert found == pytest.approx(float(expected), abs=1e-3)


def test_weights_of_another_model_are_no_start(linear_prior):
    with pytest.raises(ValueError, match="of the kind 'pca', the run is of 'autoencoder'"):
        initial_state(CONFIG, linear_prior)
