"""Readers against damaged inputs: those that once broke one, and some hundred new ones for each.

`make fuzz` tries many more, led by what they reach.
"""

import warnings
import zlib
from pathlib import Path

import numpy as np
import pytest
from harnesses import HARNESSES, survives
from mutations import mutated

CORPUS = Path(__file__).parent / "corpus"

COUNTS = {"recording": 150, "mesh": 100, "weights": 40, "result": 60}
"""Mutations that are tried, of the slow readers."""


@pytest.fixture(autouse=True)
def quiet():
    """Readers of damaged numbers may warn."""
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        yield


@pytest.mark.parametrize("name", HARNESSES)
def test_seeds_are_taken(name, tmp_path):
    """Or nothing would be tried behind the first check."""
    for seed in HARNESSES[name].seeds():
        assert survives(HARNESSES[name], seed, tmp_path)


@pytest.mark.parametrize(
    "path", sorted(CORPUS.glob("*/*")), ids=lambda path: str(path.relative_to(CORPUS))
)
def test_what_once_broke_a_reader_does_no_more(path, tmp_path):
    survives(HARNESSES[path.parent.name], path.read_bytes(), tmp_path)


@pytest.mark.parametrize("name", HARNESSES)
def test_damaged_inputs_are_taken_or_refused(name, tmp_path):
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    seeds = HARNESSES[name].seeds()
    for number in range(COUNTS.get(name, 300)):
        content = mutated(seeds[number % len(seeds)], rng)
        try:
            survives(HARNESSES[name], content, tmp_path)
        except Exception as fault:
            raise AssertionError(f"{name} broke on {content!r}") from fault
