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
from jaxshape.data.dataset import Dataset, pack, pack_measured
from jaxshape.geometry.grids import Grids
from jaxshape.model import autoencoder, training
from jaxshape.model.config import Architecture, TrainConfig
from jaxshape.model.weights import load_prior
from jaxshape.process import join_processes

OBJECTS, PATHS, NUMBERS = 7, 2, 3
CONFIG = TrainConfig(
    Architecture((4, 4, 8, 8), (8, 8, 4), 10),
    InputConfig(complete=0.2, warp=0.2),
    steps=5,
    batch=4,
    optimizer="adam",
    learning_rate=1e-3,
    schedule="constant",
    average=0.0,
    occluded_weight=1.0,
    code_noise=0.5,
    code_weight=10.0,
    report_every=2,
)


def slabs() -> Dataset:
    """Random slabs along two paths each, and measurements that each hold a random half of one."""
    rng = np.random.default_rng(0)
    surface = np.zeros((OBJECTS, PATHS, 32, 32, 32), bool)
    for i in range(OBJECTS):
        for j in range(PATHS):
            surface[i, j, 4 * i : 4 * i + 6, 5:27, 5 + j : 27] = True
    seen = rng.random((OBJECTS, PATHS, NUMBERS, 32, 32, 32)) < 0.5
    measured = pack_measured(Grids(surface[:, :, None] & seen, ~seen))
    names = [f"object {i}" for i in range(OBJECTS)]
    halves = lambda x: [x[:4], x[4:]]  # noqa: E731
    row = [(i // 4, i % 4) for i in range(OBJECTS)]
    return Dataset(names, halves(pack(surface)), halves(measured), row)


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
