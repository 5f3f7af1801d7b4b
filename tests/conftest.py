"""Shape priors small enough for tests: a tiny network, and a linear one that compiles at once."""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from hypothesis import settings
from known_shape import known_shape
from orbit_recording import Recording, record

from jaxshape import cli
from jaxshape.data.boxes import read_box
from jaxshape.data.sequences import open_sequence
from jaxshape.mapping.config import MappingConfig, TrackingConfig
from jaxshape.mapping.map.mapper import build_mapper
from jaxshape.mapping.map.recording import follow
from jaxshape.mapping.placement.finding import find_start
from jaxshape.mapping.segmentation.segment import Prompt
from jaxshape.model.autoencoder import AUTOENCODER, initialize
from jaxshape.model.config import Architecture
from jaxshape.model.pca import PCA
from jaxshape.model.shapes import ShapePrior
from jaxshape.model.weights import save_prior
from jaxshape.search.config import RefineConfig
from jaxshape.search.reconstruction import refiner_for

# The same examples each time, without deadlines: what fails, fails for the change that broke it.
settings.load_profile("ci")

MAPS = Path("/proc/self/maps")
MOST_MAPS = 30_000
"""Memory maps of a process from which on compiled programs are dropped. Each program takes some,
and Linux allows 65,530: the whole suite in one process would crash."""


@pytest.fixture(scope="module", autouse=True)
def few_programs():
    yield
    if MAPS.exists() and MAPS.read_bytes().count(b"\n") > MOST_MAPS:
        jax.clear_caches()


@pytest.fixture(scope="session")
def prior() -> ShapePrior:
    """Random, with weights large enough that codes differ between grids, and grids by codes."""

    architecture = Architecture((4, 4, 8, 8), (8, 8, 4), 10)
    shapes = jax.eval_shape(lambda: initialize(jax.random.key(0), architecture))
    rng = np.random.default_rng(0)

    def fill(path, x):
        name = path[-1].key
        if name.startswith("conv") or name == "kernel":
            return jnp.asarray(rng.normal(0, 0.1 if name != "kernel" else 1, x.shape), jnp.float32)
        return jnp.full(x.shape, float(name in ("scale", "var")))

    params = jax.tree_util.tree_map_with_path(fill, shapes)
    return ShapePrior(AUTOENCODER, params, jnp.zeros(10), jnp.eye(10))


@pytest.fixture(scope="session")
def linear_prior() -> ShapePrior:
    """A basis of random grids, which compiles at once: for tests of what goes on around it."""
    params = {
        "components": jax.random.normal(jax.random.key(5), (10, 32, 32, 32)) / 200,
        "mean": jnp.full((32, 32, 32), 0.49),
        "variances": jnp.ones(10),
        "slope": jnp.float32(100.0),
        "noise": jnp.float32(1e-3),
    }
    return ShapePrior(PCA, params, jnp.zeros(10), jnp.eye(10))


@pytest.fixture(scope="session")
def linear_weights(linear_prior, tmp_path_factory) -> Path:
    """A file with these weights."""
    path = tmp_path_factory.mktemp("linear") / "weights.safetensors"
    save_prior(path, linear_prior, {})
    return path


@pytest.fixture(scope="session")
def walk() -> Recording:
    """A walk around a chair in a corner, with a Kinect's noise."""
    return record()


@pytest.fixture(scope="session")
def known(walk) -> ShapePrior:
    """A prior that knows the chair of the walk."""
    return known_shape(walk.chair, walk.box.size)


@pytest.fixture(scope="session")
def known_weights(known, tmp_path_factory) -> Path:
    """A file with these weights."""
    path = tmp_path_factory.mktemp("known") / "weights.safetensors"
    save_prior(path, known, {})
    return path


@pytest.fixture(scope="session")
def mapper(known):
    """Compiled once."""
    search = RefineConfig(iterations=2)
    mapping = MappingConfig(keyframe_iterations=2, keyframe_angle=14.0)  # eight keyframes at most
    refiner = refiner_for("cma", known, search)
    return build_mapper(known, refiner, search, mapping, TrackingConfig())


@pytest.fixture(scope="module")
def followed(known, mapper):
    """Follow a recording to its end, with its box, and finish the map; the last progress."""

    def followed(folder, *, chosen=None, use_poses=False):
        sequence, box = open_sequence(folder), read_box(folder / "box.json")
        start = find_start(sequence, known, Prompt(), box=box)
        steps = follow(sequence, start, mapper, known, chosen=chosen, use_poses=use_poses)
        last = list(steps)[-1]
        state, shape = mapper.finish(last.state)
        return last._replace(state=state, shape=shape)

    return followed


@pytest.fixture(scope="module")
def compile_quickly():
    """Compiling takes most of the time of many tests, and their arithmetic is small."""
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.fixture
def unchecked_types(monkeypatch):
    """Types are not checked while a test runs, as in a user's program."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


@pytest.fixture(name="run")
def run_command(monkeypatch, capsys):
    """Run a command in this process; returns its exit status, its answer and its complaint."""
    monkeypatch.setattr(cli, "prepare_process", lambda: None)

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["jaxshape", *map(str, arguments)])
        try:
            cli.main()
            status = 0
        except SystemExit as stop:
            status = stop.code or 0
        out, err = capsys.readouterr()
        return status, out, " ".join(err.split())

    return run
