"""Several processes share an evaluation; whichever finishes last writes what one would write."""

import json
import os
import socket
import subprocess
import sys

import jax
import pytest

from jaxshape.model.weights import save_prior
from jaxshape.results import evaluation
from jaxshape.results.journal import Share

OPTIONS = ("--frames", "1", "--methods", "encoder,gradient", "--iterations", "2", "--count", "3")


def test_a_share_is_every_nth_and_all_shares_are_everything():
    items = list("abcdefg")
    shares = [Share(i, 3).of(items) for i in range(3)]
    assert shares == [list("adg"), list("be"), list("cf")] and Share().of(items) == items


@pytest.fixture
def as_process(run, linear_weights, monkeypatch, tmp_path):
    """Evaluate as one of some processes, with scores that cost nothing, until it is killed."""
    asked = []

    def as_process(index, count, output="scores.json", killed_after=99):
        def evaluate(prior, models, config):
            for number, model in enumerate(models):
                if number == killed_after:
                    raise OSError("killed.")
                asked.append(model.name)
                scores = dict.fromkeys(config.methods, {"iou": float(len(model.name))})
                frames = {"1": scores | {"bounds": {"occluded_empty": 1.0}}}
                yield {"name": model.name, "metadata": {}, "frames": frames}

        monkeypatch.setattr(evaluation, "evaluate", evaluate)
        monkeypatch.setattr(jax, "process_index", lambda: index)
        monkeypatch.setattr(jax, "process_count", lambda: count)
        where = ("--weights", linear_weights, "--output", tmp_path / output)
        status, said, _ = run("evaluate", *OPTIONS, *where)
        return status, said, asked

    return as_process


def per_mesh(path):
    content = json.loads(path.read_text())
    return [(row["name"], row["frames"]) for row in content["per_mesh"]], content["means"]


def test_the_last_process_merges_and_a_killed_one_goes_on(as_process, tmp_path):
    path = tmp_path / "scores.json"
    assert as_process(0, 2, killed_after=1)[0] == 2
    assert as_process(1, 2)[:1] == (0,) and not path.exists()
    status, said, asked = as_process(0, 2)
    assert status == 0 and "means over 3 meshes" in said and len(asked) == 3
    assert list(tmp_path.iterdir()) == [path]
    as_process(0, 1, output="alone.json")
    assert per_mesh(path) == per_mesh(tmp_path / "alone.json")


def test_another_number_of_processes_goes_on_with_what_is_there(as_process, tmp_path):
    status, said, _ = as_process(0, 2)
    assert status == 0 and "1 meshes are left to the other processes" in said
    assert as_process(0, 1)[0] == 0
    assert len(as_process(0, 1, output="alone.json")[2]) == 3 + 3
    assert list(per_mesh(tmp_path / "scores.json")) == list(per_mesh(tmp_path / "alone.json"))


@pytest.mark.slow
def test_two_processes_write_what_one_writes(linear_prior, tmp_path):
    weights = tmp_path / "weights.safetensors"
    save_prior(weights, linear_prior, {})
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"

    def begin(output, *machines):
        command = [sys.executable, "-m", "jaxshape", "evaluate", *OPTIONS]
        command += ["--weights", weights, "--output", tmp_path / output, *machines]
        settings = {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1", "JAX_PLATFORMS": "cpu"}
        return subprocess.Popen([str(x) for x in command], env=os.environ | settings)

    both = ("--coordinator", address, "--processes", 2, "--process")
    processes = [begin("both.json", *both, i) for i in range(2)] + [begin("one.json")]
    assert [process.wait(timeout=500) for process in processes] == [0, 0, 0]
    (names, means), (expected, expected_means) = (
        per_mesh(tmp_path / name) for name in ("both.json", "one.json")
    )
    assert [name for name, _ in names] == [name for name, _ in expected]
    for method, scores in expected_means["1"].items():
        assert means["1"][method] == pytest.approx(scores, rel=1e-3, abs=1e-3)
    assert sorted(path.suffix for path in tmp_path.iterdir()) == [".json", ".json", ".safetensors"]
