"""What `jaxshape doctor` says of a machine."""

import json

import jax
import pytest

from jaxshape.cli import doctor
from jaxshape.process import Processor, processor


def test_the_answer_is_json_of_this_machine(run):
    status, out, _ = run("doctor", "--json")
    found = json.loads(out)
    assert status == 0
    assert found["packages"]["jax"] == jax.__version__
    assert len(found["devices"]) == jax.device_count()
    assert found["processor"] == processor().name


def test_the_table_holds_the_versions(run):
    status, out, _ = run("doctor")
    assert status == 0 and f"jax {jax.__version__}" in " ".join(out.split())


@pytest.mark.parametrize(
    ("features", "said"), [({"avx2"}, True), ({"avx2", "amx_bf16"}, False), (set(), False)]
)
def test_bfloat16_is_advised_against_where_it_is_known_to_be_slow(features, said, monkeypatch):
    monkeypatch.setattr("jaxshape.process.processor", lambda: Processor("x", frozenset(features)))
    assert any("bfloat16" in sentence for sentence in doctor.advice("cpu")) == said


def test_a_missing_ray_tracer_is_named(monkeypatch):
    monkeypatch.setattr(doctor, "find_spec", lambda name: None)
    assert any("embreex" in sentence for sentence in doctor.advice("cpu"))
