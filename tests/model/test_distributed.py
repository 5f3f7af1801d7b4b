"""A batch spread over devices, or over processes, trains as on one device."""

import json
import re
import socket
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny_training
from forced_devices import environment
from safetensors.numpy import load_file

from jaxshape.model import training
from jaxshape.process import join_processes


@pytest.fixture(scope="module")
def begin(start):
    """Start a process that trains on as many devices, with a break after the first report."""

    def begin(folder, *machines, devices=1):
        command = [sys.executable, tiny_training.__file__, folder, start, *machines]
        return subprocess.Popen(
            [str(part) for part in command],
            env=environment(devices),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    return begin


def outcome(process):
    """What a process printed before it ended well."""
    output, errors = process.communicate(timeout=200)
    assert process.returncode == 0, errors
    return json.loads(output.splitlines()[-1])


@pytest.fixture(scope="module")
def two_devices(begin, tmp_path_factory):
    folder = tmp_path_factory.mktemp("devices")
    return folder, outcome(begin(folder, devices=2))


@pytest.fixture(scope="module")
def two_processes(begin, tmp_path_factory):
    """Two processes that train together, each with its own idea of where the run lies."""
    folders = [tmp_path_factory.mktemp("processes") / name for name in ("first", "second")]
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    processes = [begin(folder, address, 2, i) for i, folder in enumerate(folders)]
    return folders, [outcome(process) for process in processes]


def assert_same_course(reports, whole_run):
    for report, expected in zip(reports, whole_run, strict=True):
        step, loss, iou, *_ = report
        assert step == expected.step
        np.testing.assert_allclose(loss, expected.loss, rtol=1e-5)
        np.testing.assert_allclose(iou, expected.iou, atol=1e-4)  # a voxel may pass the threshold


def assert_same_weights(folder, whole_run, start):
    found, expected = (load_file(f / "checkpoint.safetensors") for f in (folder, whole_run.folder))
    assert found.keys() == expected.keys()
    for name, x in expected.items():
        # Muon orthogonalises gradients, which magnifies the rounding of sums in another order.
        np.testing.assert_allclose(found[name], x, atol=5e-5, rtol=1e-5, err_msg=name)
    name = "params/decoder/conv1"
    moved = expected[f"variables/{name}"] - load_file(start)[name]
    assert np.abs(moved).max() > 2e-3  # there was something to get wrong


@pytest.mark.slow
def test_two_devices_train_as_one(two_devices, whole_run, start):
    folder, found = two_devices
    assert_same_course(found["reports"], whole_run.reports)
    assert_same_weights(folder, whole_run, start)


def test_only_several_devices_speak_to_each_other(two_devices, whole_run):
    assert two_devices[1]["collective"]
    collectives = re.findall(r"all-\w+|collective-\w+", whole_run.programs[0].as_text())
    assert not collectives


def test_two_processes_that_were_interrupted_train_as_one(two_processes, whole_run, start):
    folders, outcomes = two_processes
    for found in outcomes:
        assert_same_course(found["reports"], whole_run.reports)
    assert_same_weights(folders[0], whole_run, start)
    np.testing.assert_allclose(outcomes[0]["code_mean"], whole_run.prior.code_mean, atol=1e-4)


def test_only_the_first_process_writes(two_processes):
    folders = two_processes[0]
    assert [r.step for r in training.read_metrics(folders[0])] == [2, 4, 5]
    assert not folders[1].exists()


def test_all_processes_refuse_what_the_first_one_finds(two_processes):
    for found in two_processes[1]:
        assert "training run of other settings" in found["refusal"]


def test_the_noise_of_a_code_is_that_of_its_place_in_the_whole_batch():
    @jax.jit
    def draw(step):
        part = lambda _: training._noise(step, 100, config, "batch")  # noqa: E731
        parts = jax.vmap(part, axis_name="batch")(jnp.arange(2))
        return training._noise(step, 200, config, None), jnp.concatenate(parts)

    config = tiny_training.CONFIG
    whole, parts = draw(3)
    np.testing.assert_array_equal(parts, whole)
    assert len(np.unique(whole)) > 0.99 * whole.size
    np.testing.assert_allclose(np.std(whole), 1, rtol=0.1)
    assert np.mean(draw(4)[0] == whole) < 0.01


def test_a_batch_that_devices_cannot_share_is_refused(dataset, tmp_path, monkeypatch):
    monkeypatch.setattr(jax, "device_count", lambda: 3)
    with pytest.raises(ValueError, match="batch of 4 cannot be divided among 3 devices"):
        next(training.train(tmp_path, dataset, tiny_training.CONFIG))


@pytest.mark.parametrize("given", [("host:1", None, None), ("host:1", 2, None), (None, 2, 0)])
def test_half_an_invitation_to_join_is_refused(given):
    with pytest.raises(ValueError, match=r"^Without (coordinator|process).* give coordinator"):
        join_processes(*given)


def test_without_a_cluster_the_processes_must_be_named(monkeypatch):
    def initialize(*_, **__):
        raise ValueError("coordinator_address should be defined.")

    monkeypatch.setattr(jax.distributed, "initialize", initialize)
    with pytest.raises(ValueError, match="no cluster that JAX knows"):
        join_processes()
