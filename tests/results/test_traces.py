"""Traces on disk, and the sentences where there is none."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxshape.results.traces import TraceError, read_search, read_trace, restarts, write_trace
from jaxshape.search.refiner import Distribution, Trace
from jaxshape.search.restarts import with_restarts
from jaxshape.search.stopping import Tolerances


def make_trace(iterations=7, dim=3):
    rng = np.random.default_rng(0)
    row = lambda *shape: rng.random((iterations, *shape)).astype(np.float32)  # noqa: E731
    drawn = Distribution(row(), row(dim), np.sort(row(dim)))
    return Trace(row(), row(), row(), np.arange(1, iterations + 1, dtype=np.int32), drawn)


@pytest.mark.parametrize("drawn", [True, False])
def test_a_trace_reads_back_as_it_was(tmp_path, drawn):
    trace = make_trace() if drawn else make_trace()._replace(distribution=None)
    write_trace(tmp_path / "trace.npz", trace)
    jax.tree.map(np.testing.assert_array_equal, read_trace(tmp_path / "trace.npz"), trace)
    assert [path.name for path in tmp_path.iterdir()] == ["trace.npz"]


def write_folder(folder, result):
    (folder / "result.json").write_text(json.dumps(result))
    write_trace(folder / "trace.npz", make_trace())


def test_a_search_is_named_by_its_folder(tmp_path):
    folder = tmp_path / "demo"
    folder.mkdir()
    write_folder(folder, {"method": "cma"})
    search = read_search(folder)
    assert search.name == "demo" and search.result == {"method": "cma"}
    assert len(search.trace.loss) == 7


def add_objects(folder):
    arrays = make_trace(2)._asdict() | {"loss": np.array([{}, {}]), "distribution": 1}
    np.savez(folder / "trace.npz", **arrays, allow_pickle=True)


@pytest.mark.parametrize(
    "damage, said",
    [
        (lambda folder: (folder / "result.json").unlink(), "is not a result folder"),
        (lambda folder: (folder / "result.json").write_text("{"), "is damaged"),
        (lambda folder: (folder / "result.json").write_text('{"method": "encoder"}'), "encoder's"),
        (lambda folder: (folder / "trace.npz").unlink(), "an earlier version, which wrote none"),
        (lambda folder: (folder / "trace.npz").write_bytes(b""), "cannot be read"),
        (lambda folder: (folder / "trace.npz").write_bytes(b"PK noise"), "cannot be read"),
        (lambda folder: np.savez(folder / "trace.npz", other=np.zeros(2)), "cannot be read"),
        (add_objects, "cannot be read"),
    ],
)
def test_a_folder_without_a_trace_says_why(tmp_path, damage, said):
    write_folder(tmp_path, {"method": "cma"})
    damage(tmp_path)
    with pytest.raises(TraceError, match=said) as refusal:
        read_search(tmp_path)
    assert str(refusal.value).endswith(".")


def test_restarts_are_those_the_search_counted():
    refiner = with_restarts(
        "ipop", dim=3, sigma0=0.3, population=6, tolerances=Tolerances(tolfun=1e-2, tolfunhist=1e-2)
    )
    sphere = lambda point: jnp.sum(point**2)  # noqa: E731

    @jax.jit
    def search(key):
        state, _ = refiner.init(key, jnp.ones(3), jnp.float32(3))
        keys = jax.random.split(key, 150)
        return jax.lax.scan(lambda state, key: refiner.step(key, state, sphere), state, keys)

    state, trace = jax.device_get(search(jax.random.key(0)))
    found = restarts(trace)
    assert len(found) == state.restarts >= 2
    np.testing.assert_allclose(trace.distribution.sigma[found], 0.3, rtol=1e-6)
    assert np.all(trace.distribution.sigma[found - 1] < 0.3)


def test_a_search_without_a_distribution_never_restarts():
    assert len(restarts(make_trace()._replace(distribution=None))) == 0
