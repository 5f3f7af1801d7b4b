"""A reconstruction that was exported runs in another process as it does in this one."""

import json
import os
import subprocess
import sys

import jax
import jax.export
import numpy as np
import pytest

from jaxshape.model.weights import load_prior
from jaxshape.search.config import RefineConfig
from jaxshape.search.export import PLATFORMS, export_reconstruct
from jaxshape.search.reconstruction import reconstruct_jit, refiner_for

CONFIG = RefineConfig(iterations=3, population=4)
GRIDS = jax.random.bernoulli(jax.random.key(1), 0.3, (2, 3, 32, 32, 32))

PROGRAM = """
import json, sys
import jax
import jaxshape as js
content, weights = open(sys.argv[1], "rb").read(), sys.argv[2]
F, M = jax.random.bernoulli(jax.random.key(1), 0.3, (2, 3, 32, 32, 32))
prior = js.load_prior(weights)
jax.config.update("jax_disable_most_optimizations", True)
found = js.load_reconstruct(content)(jax.random.key(0), prior, F, M)
print(json.dumps([type(found).__name__, found.code.tolist(), found.trace.best_loss.tolist()]))
"""


@pytest.mark.usefixtures("compile_quickly")
def test_another_process_finds_the_same_in_batches(linear_prior, linear_weights, tmp_path):
    pytest.importorskip("flatbuffers")
    refiner = refiner_for("cma", linear_prior, CONFIG)
    content = export_reconstruct(linear_prior, refiner, CONFIG, objects=2, soft=False)
    assert jax.export.deserialize(bytearray(content)).platforms == PLATFORMS == ("cpu", "cuda")
    (tmp_path / "search.bin").write_bytes(content)
    command = [sys.executable, "-c", PROGRAM, tmp_path / "search.bin", linear_weights]
    answer = subprocess.run(command, env=os.environ, capture_output=True, text=True)
    assert answer.returncode == 0, answer.stderr
    name, code, best = json.loads(answer.stdout)
    rounded = load_prior(linear_weights)  # files hold weights in half precision
    expected = reconstruct_jit(refiner, CONFIG)(jax.random.key(0), rounded, *GRIDS)
    assert name == "Reconstruction"
    np.testing.assert_allclose(code, expected.code, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(best, expected.trace.best_loss, rtol=1e-4)


def test_what_is_missing_is_named(monkeypatch, linear_prior):
    monkeypatch.setitem(sys.modules, "flatbuffers", None)
    with pytest.raises(ModuleNotFoundError, match=r"flatbuffers.*pip install 'jaxshape\[export\]'"):
        export_reconstruct(linear_prior, None, CONFIG)


def test_a_number_of_objects_is_asked_for(linear_prior):
    with pytest.raises(ValueError, match="objects is 0; give a whole number, 1 or more"):
        export_reconstruct(linear_prior, None, CONFIG, objects=0)
