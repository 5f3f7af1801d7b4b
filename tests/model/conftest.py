from typing import Any, NamedTuple

import pytest
import tiny_training

from jaxshape.model import training
from jaxshape.model.weights import load_prior, save_prior


@pytest.fixture(scope="module", autouse=True)
def quickly(compile_quickly):
    """All of these tests compile without optimisation."""


class Run(NamedTuple):
    """A run by one process on one device that was not interrupted."""

    folder: Any
    first_checkpoint: bytes
    reports: list
    prior: Any
    """What it led to."""
    programs: list
    """That of its steps."""


@pytest.fixture(scope="session")
def dataset():
    return tiny_training.slabs()


@pytest.fixture(scope="session")
def start(prior, tmp_path_factory):
    """The file of weights to start from."""
    path = tmp_path_factory.mktemp("start") / "weights.safetensors"
    save_prior(path, prior, {})
    return path


@pytest.fixture(scope="session")
def whole_run(dataset, start, tmp_path_factory):
    folder, programs = tmp_path_factory.mktemp("run"), []
    with pytest.MonkeyPatch.context() as patch:
        tiny_training.make_quick(patch.setattr, programs)
        reports = training.train(folder, dataset, tiny_training.CONFIG, load_prior(start))
        first = next(reports)
        checkpoint = (folder / "checkpoint.safetensors").read_bytes()
        reports = [first, *reports]
        prior = training.finished_prior(folder, dataset, tiny_training.CONFIG)
    return Run(folder, checkpoint, reports, prior, programs)
