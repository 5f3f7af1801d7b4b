"""The harness, the rivals' agreement with us, and what can be known without timing anything."""

import importlib
import inspect
import itertools
import time

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import tyro
from rich.console import Console

import jaxshape as js
from benchmarks import NAMES, __main__, decode, fusion, harness, problems
from benchmarks.harness import Metric
from benchmarks.rivals import numpy_fusion
from jaxshape.model.completion import COMPLETION, initialize
from jaxshape.model.config import Architecture, Completion, TrainConfig
from jaxshape.model.families import COMPLETIONS, Batch

IMAGE = (48, 64)


@pytest.fixture(scope="module")
def frame():
    """Random depths about a cube of voxels, with gaps, background and pixels of other things."""
    rng = np.random.default_rng(0)
    depth = rng.uniform(1.5, 2.5, IMAGE).astype(np.float32)
    depth[rng.random(IMAGE) < 0.1], depth[rng.random(IMAGE) < 0.1] = 0, np.inf
    intrinsics = js.Intrinsics(*jnp.array([60.0, 58.0, 32.0, 24.0]))
    pose = jaxlie.SE3(js.orbit(3, 2.0).wxyz_xyz[1])
    cube = js.GridFrame(jnp.full(3, -0.5), jnp.full(3, 1 / 32))
    segmented = jnp.asarray(rng.random(IMAGE) < 0.7)
    return fusion.Frame(jnp.asarray(depth), segmented, intrinsics, pose, cube)


@pytest.fixture(scope="module")
def ours(frame):
    return jax.jit(js.measure)(*frame)


@pytest.mark.parametrize("name", NAMES)
def test_every_benchmark_is_a_function_of_quick(name):
    signature = inspect.signature(importlib.import_module(f"benchmarks.{name}").run)
    assert list(signature.parameters) == ["quick"]
    assert signature.return_annotation == list[Metric]


def test_functions_take_turns_and_a_slower_one_measures_slower():
    calls = []

    def sleeper(name, seconds):
        return lambda: (calls.append(name), time.sleep(seconds))

    a, b = 0.04, 0.08  # longer than a burst, so that a turn is one call
    seconds = harness.alternate({"a": sleeper("a", a), "b": sleeper("b", b)}, budget=0, at_least=2)
    assert calls == ["a", "b"] * 3  # the first of each is not counted
    assert 1.5 < harness.speedup(seconds, "a", "b") < 2.5
    assert [len(x) for x in seconds.values()] == [2, 2]


def test_a_fresh_process_answers_or_says_what_went_wrong():
    assert harness.in_fresh_process("math:hypot", 3, 4) == 5
    with pytest.raises(RuntimeError, match="math domain error|nonnegative"):
        harness.in_fresh_process("math:sqrt", -1)


def test_a_rival_that_is_not_installed_is_left_out():
    assert harness.optional("no_such_rival") is None
    assert harness.optional("numpy_fusion") is numpy_fusion


def test_the_command_exits_with_one_where_a_metric_is_worse(monkeypatch, tmp_path):
    measured = Metric("fusion/speedup", 2.0, "x", "higher", tolerance=0.1, target=10.0)
    monkeypatch.setattr(fusion, "run", lambda quick: [measured] if quick else [])
    monkeypatch.setattr(__main__.gate, "BASELINE", tmp_path / "baseline.json")
    monkeypatch.setattr(__main__.gate.read, "__defaults__", (tmp_path / "baseline.json",))

    def status(speedup):
        kind, here = __main__.gate.kind_of(harness.machine()), harness.machine()
        better = Metric("fusion/speedup", speedup, "x", "higher")
        __main__.gate.update(here, [better], tmp_path / "baseline.json")
        assert __main__.gate.read(kind)["metrics"] == {"fusion/speedup": speedup}
        command = ["--quick", "--gate", "--only", "fusion", "--output", str(tmp_path / "out.json")]
        console = Console(quiet=True)
        return __main__.main(tyro.cli(__main__.Options, args=command), console)

    assert status(2.1) == 0 and status(3.0) == 1
    assert '"fusion/speedup"' in (tmp_path / "out.json").read_text()


def test_useful_operations_are_those_of_taps_inside_the_grid():
    """Against counting every pair of a coarse voxel and a tap, layer by layer."""
    architecture = Architecture((4, 4, 8, 8), (8, 6, 4), 10)
    fine_channels, coarse_channels = (8, 6, 4, 1), (10, 8, 6, 4)
    pairs = [4]  # the single voxel's taps 1 to 4
    for n in (4, 8, 16):
        fine = (2 * i + k - 2 for i, k in itertools.product(range(n), range(5)))
        pairs.append(sum(0 <= x < 2 * n for x in fine))
    layers = zip(pairs, coarse_channels, fine_channels, strict=True)
    assert decode.useful_flops(architecture) == sum(2 * n**3 * i * o for n, i, o in layers)


@pytest.mark.parametrize("add_at", [False, True])
def test_fusion_in_numpy_is_ours(frame, ours, add_at):
    hits, seen_through = fusion.numpy_measure(frame)(add_at=add_at)
    assert hits.sum() > 300 and 1000 < seen_through.sum() < 30_000
    np.testing.assert_array_equal(hits, ours.hits)
    np.testing.assert_array_equal(seen_through, ours.seen_through)


def test_open3d_finds_our_occupied_voxels_and_carves_only_what_we_see_through(frame):
    open3d = harness.optional("open3d_fusion")
    if open3d is None:
        pytest.skip("Open3D is not installed")
    # It interpolates depth at the corners of a voxel: on a wall that is what its centre sees.
    column = np.broadcast_to(np.arange(IMAGE[1], dtype=np.float32), IMAGE)
    frame = frame._replace(depth=jnp.asarray(2 + 0.1 * np.sin(column / 10)))
    ours = jax.jit(js.measure)(*frame)
    occupied, carved = fusion.open3d_measure(open3d, frame)()
    np.testing.assert_array_equal(occupied, ours.hits > 0)
    assert 0.7 * ours.seen_through.sum() < carved.sum() and ours.seen_through[carved].all()


def test_decoding_and_scoring_in_pytorch_is_ours(prior):
    pytorch = pytest.importorskip("benchmarks.rivals.pytorch")
    rng = np.random.default_rng(0)
    codes = rng.normal(size=(2, 3, 10)).astype(np.float32)
    target = js.Target(*rng.random((2, 2, 32, 32, 32), np.float32))
    score = lambda codes, target: jax.vmap(js.objective(prior, target))(codes)  # noqa: E731
    losses = jax.jit(jax.vmap(score))(codes, target)
    decoder = pytorch.from_jaxshape(prior.params).decoder
    for last, size in itertools.product((False, True), (None, 2)):
        score = pytorch.scorer(decoder, *target, channels_last=last, at_a_time=size)
        np.testing.assert_allclose(score(codes), losses, rtol=1e-5)
    rough = pytorch.scorer(decoder, *target, bfloat16="autocast")(codes)
    np.testing.assert_allclose(rough, losses, rtol=0.05)


def test_the_conditional_network_in_pytorch_is_ours():
    """Completing, the objective of codes, and the loss of a training step."""
    rival = pytest.importorskip("benchmarks.rivals.pytorch_completion")
    config = TrainConfig(
        Completion((16, 24, 32), 2, 10), batch=2, occupied_weight=1.0, occluded_weight=1.0
    )
    params = jax.jit(initialize, static_argnums=1)(jax.random.key(0), config.architecture)
    params = jax.tree.map(_stirred, params)
    rng = np.random.default_rng(0)
    occupied, occluded = rng.random((2, 2, 32, 32, 32), np.float32)
    grids, surface = js.Grids(occupied, occluded), rng.random(occupied.shape) < 0.1
    seen = problems.channels_first(grids)
    network = rival.from_jaxshape(params)

    prepared = jax.jit(COMPLETION.prepare, static_argnums=2)(params, grids, "float32")
    logits = jax.jit(COMPLETION.decode)(prepared, jnp.zeros((2, 10)))
    assert float(jnp.std(logits)) > 0.1
    for last in (False, True):
        theirs = rival.completer(network, channels_last=last)(seen)
        np.testing.assert_allclose(theirs, logits, atol=1e-4)

    prior = js.ShapePrior(COMPLETION, params, jnp.zeros(10), jnp.eye(10))
    codes = rng.normal(size=(3, 10)).astype(np.float32)
    target = js.Target(*rng.random((2, 32, 32, 32), np.float32))
    one = jax.tree.map(lambda x: x[0], grids)
    score = lambda codes: jax.vmap(js.objective(prior, target, grids=one))(codes)  # noqa: E731
    losses = jax.jit(score)(codes)
    for last, size in itertools.product((False, True), (None, 2)):
        score = rival.scorer(network, seen[0], *target, channels_last=last, at_a_time=size)
        np.testing.assert_allclose(score(codes), losses, rtol=1e-5)
    rough = rival.scorer(network, seen[0], *target, bfloat16="cast")(codes)
    np.testing.assert_allclose(rough, losses, rtol=0.05)

    noise = rng.normal(size=(2, 10)).astype(np.float32)
    cost = jax.jit(COMPLETIONS.cost, static_argnames=("config", "axis"))
    batch = Batch(occupied, occluded, surface)
    loss = cost({"params": params}, batch, noise, config=config, axis=None).loss
    theirs = rival.trainer(network)(seen, surface, noise)
    np.testing.assert_allclose(theirs, loss, rtol=1e-5)


def _stirred(x):
    """Parameters among which none is zero."""
    return x + 0.1 * np.random.default_rng(x.size).normal(size=x.shape).astype(np.float32)


def test_the_flax_decoder_is_ours(prior):
    rival = pytest.importorskip("benchmarks.rivals.evosax_flax")
    codes = jax.random.normal(jax.random.key(0), (2, 10))
    theirs = jax.jit(rival.decoder(prior.params))(codes)
    np.testing.assert_allclose(theirs, jax.jit(js.decode)(prior, codes), atol=1e-4)


def test_pycma_searches_the_same_space_one_at_a_time_batched_and_together():
    pycma = pytest.importorskip("benchmarks.rivals.pycma")
    rng = np.random.default_rng(0)
    codes, root = rng.normal(size=(2, 4)), np.tril(rng.normal(size=(4, 4))) + 2 * np.eye(4)
    bowl = lambda x: np.sum((x - 1.0) ** 2, axis=-1)  # noqa: E731
    settings = {"iterations": 60, "population": 8, "sigma0": 0.5}
    one, batched = (
        pycma.search(bowl, codes[0], root, one_at_a_time=one, **settings) for one in (True, False)
    )
    together = pycma.search_together(bowl, codes, root, **settings)
    assert one == batched and max(batched, *together) < 1e-3
