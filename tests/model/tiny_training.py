"""A training run of seconds; as a program, for tests that need a process or several.

    python tiny_training.py FOLDER WEIGHTS [COORDINATOR PROCESSES PROCESS]

gives up after the first report, begins again, and prints what it found as JSON.
"""

import dataclasses
import json
import sys

import jax
import jax.numpy as jnp
import numpy as np

from jaxshape.data.config import InputConfig
from jaxshape.data.dataset import Dataset, pack
from jaxshape.model import autoencoder, training
from jaxshape.model.config import Architecture, TrainConfig
from jaxshape.model.weights import load_prior
from jaxshape.process import join_processes

OBJECTS, VIEWS = 7, 4
CONFIG = TrainConfig(
    Architecture((4, 4, 8, 8), (8, 8, 4), 10),
    InputConfig(max_views=3, scale=0.2),
    steps=5,
    batch=4,
    optimizer="adam",
    learning_rate=1e-3,
    schedule="constant",
    code_noise=0.5,
    code_weight=10.0,
    report_every=2,
)


def slabs() -> Dataset:
    """Random slabs, and views that each hold a random half of one."""
    rng = np.random.default_rng(0)
    surface = np.zeros((OBJECTS, 1, 32, 32, 32), bool)
    for i in range(OBJECTS):
        surface[i, 0, 4 * i : 4 * i + 6, 5:27, 5:27] = True
    views = surface & (rng.random((OBJECTS, VIEWS, 32, 32, 32)) < 0.5)
    packed = pack(np.concatenate([surface, views], axis=1))
    names = [f"object {i}" for i in range(OBJECTS)]
    return Dataset(names, [packed[:4], packed[4:]], [(i // 4, i % 4) for i in range(OBJECTS)])


# Convolutions by the eight taps in the middle alone compile in a fraction of the time.


def quick_downsample(fine, kernel):
    b, x, y, z, channels = fine.shape
    blocks = fine.reshape(b, x // 2, 2, y // 2, 2, z // 2, 2, channels)
    return jnp.einsum("bxiyjzkf,ijkfc->bxyzc", blocks, kernel[2:4, 2:4, 2:4])


def quick_upsample(coarse, kernel):
    b, x, y, z, _ = coarse.shape
    blocks = jnp.einsum("bxyzc,ijkfc->bxiyjzkf", coarse, kernel[2:4, 2:4, 2:4])
    return blocks.reshape(b, 2 * x, 2 * y, 2 * z, -1)


def make_quick(setattr, programs):
    """Use them; and let every run of `CONFIG` share one program, left in a list to be looked at."""
    make_step = training._parallel_step

    def parallel_step(config, mesh):
        step = make_step(config, mesh)

        def run(*arguments):
            if not programs:
                programs.append(step.lower(*arguments).compile())
            return programs[0](*arguments)

        return run

    setattr(autoencoder, "downsample", quick_downsample)
    setattr(autoencoder, "upsample", quick_upsample)
    setattr(training, "_parallel_step", parallel_step)


def main(folder, weights, *machines):
    if machines:
        coordinator, *numbers = machines
        join_processes(coordinator, *map(int, numbers))
    programs = []
    make_quick(setattr, programs)
    start = load_prior(weights)
    reports = [next(training.train(folder, slabs(), CONFIG, start))]
    reports += training.train(folder, slabs(), CONFIG, start)
    found = {"reports": reports, "collective": "all-reduce" in programs[0].as_text()}
    try:
        list(training.train(folder, slabs(), dataclasses.replace(CONFIG, seed=1), start))
    except ValueError as problem:
        found["refusal"] = str(problem)
    if jax.process_index() == 0:
        prior = training.finished_prior(folder, slabs(), CONFIG)
        found["code_mean"] = np.asarray(prior.code_mean).tolist()
    print(json.dumps(found))


if __name__ == "__main__":
    main(*sys.argv[1:])
