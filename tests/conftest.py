"""Shape priors small enough for tests: a tiny network, and a linear one that compiles at once."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import settings
from known_shape import install, known_shape
from orbit_recording import Recording, record

from jaxshape import cli
from jaxshape.data.boxes import read_box
from jaxshape.data.sequences import open_sequence
from jaxshape.mapping.config import MappingConfig, TrackingConfig
from jaxshape.mapping.finding import find_start
from jaxshape.mapping.incremental import build_mapper
from jaxshape.mapping.recording import follow
from jaxshape.mapping.segmentation import Prompt
from jaxshape.model.autoencoder import initialize
from jaxshape.model.config import Architecture
from jaxshape.model.weights import ShapePrior
from jaxshape.search import objective, reconstruction, run
from jaxshape.search.config import RefineConfig
from jaxshape.search.reconstruction import refiner_for

# The same examples each time, without deadlines: what fails, fails for the change that broke it.
settings.load_profile("ci")


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
    return ShapePrior(params, jnp.zeros(10), jnp.eye(10))


@pytest.fixture(scope="module")
def linear_prior():
    """The network is replaced by a linear one, for tests of what goes on around it."""

    def encode(params, grid):
        return jnp.einsum("...xyz,dxyz->...d", grid.astype(jnp.float32), params) / 32

    def decode(params, code):
        return jnp.einsum("...d,dxyz->...xyz", code, params) - 1

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reconstruction, "encode", encode)
        patch.setattr(reconstruction, "decode", decode)
        patch.setattr(objective, "decode", decode)
        patch.setattr(run, "decode", decode)
        patch.setattr(run, "prepare_decoder", lambda params: params)
        params = jax.random.normal(jax.random.key(5), (10, 32, 32, 32))
        yield ShapePrior(params, jnp.zeros(10), jnp.eye(10))


@pytest.fixture(scope="session")
def walk() -> Recording:
    """A walk around a chair in a corner, with a Kinect's noise."""
    return record()


@pytest.fixture(scope="session")
def known_prior(walk) -> ShapePrior:
    return known_shape(walk.chair, walk.box.size)


@pytest.fixture(scope="module")
def known(known_prior):
    """The network is replaced by one that knows the chair of the walk."""
    with pytest.MonkeyPatch.context() as patch:
        install(patch.setattr, known_prior)
        yield known_prior


@pytest.fixture(scope="session")
def session_mapper(known_prior):
    """Compiled once; to be used where the network is replaced."""
    search = RefineConfig(iterations=2)
    mapping = MappingConfig(keyframe_iterations=2, keyframe_angle=14.0)  # eight keyframes at most
    refiner = refiner_for("cma", known_prior, search)
    return build_mapper(known_prior, refiner, search, mapping, TrackingConfig())


@pytest.fixture(scope="module")
def mapper(known, session_mapper):
    return session_mapper


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
