"""The set is frozen: its hash stands in the code, and the script that made it still does."""

import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from jaxshape.bench import problem_set as sets
from jaxshape.bench.config import FRAMES, KINDS
from jaxshape.bench.problems import WEIGHTS, problems
from jaxshape.data.dataset import load_object, pack_measured, unpack
from jaxshape.data.families import TEST_SEEDS, procedural_objects
from jaxshape.model.weights import fingerprint, load_prior
from jaxshape.results.evaluation import observe

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def packaged():
    return sets.packaged_set()


def test_the_packaged_set_is_the_one_that_entries_name(packaged):
    assert sets.fingerprint(packaged) == sets.SHA256
    assert len(packaged.keys()) == 24 * len(FRAMES) * len(KINDS) == len(packaged.best)
    assert {one["licence"] for one in packaged.objects if "licence" in one} == {"CC0"}


def test_one_voxel_makes_another_set(packaged):
    noisy = packaged.measured["noisy"].copy()
    noisy[3, 1, 1000] ^= 1
    other = packaged._replace(measured=packaged.measured | {"noisy": noisy})
    assert sets.fingerprint(other) != sets.fingerprint(packaged)


def test_a_set_that_was_written_is_the_same(packaged, tmp_path):
    sets.write_set(tmp_path, packaged)
    assert sets.fingerprint(sets.read_set(tmp_path / packaged.name)) == sets.SHA256


def test_the_script_measures_what_is_stored(packaged):
    """Up to voxels that rounding decides, which may differ between processors.

    The noise is drawn edge by edge: one pixel more that rounding takes for an edge gives all later
    pixels of this chair other noise. So noisy grids are the same for most chairs, not for each.
    """
    sys.path.insert(0, str(ROOT / "experiments"))
    import bench_set

    names = [one["name"] for one in packaged.objects]
    chairs = [*map(load_object, procedural_objects("chair", 3, TEST_SEEDS))]
    rows = [names.index(chair.name) for chair in chairs]
    other = {kind: [] for kind in bench_set.KINDS}
    for chair, row in zip(chairs, rows, strict=True):
        for kind, config in bench_set.KINDS.items():
            case = observe(chair, config)
            stored = packaged.measured[kind][row]
            other[kind].append(np.mean(pack_measured(case.grids) != stored))
        assert np.mean(unpack(packaged.surfaces[row]) != case.surface[0]) < 1e-3
    assert np.max(other["clean"]) < 1e-3
    assert np.median(other["noisy"]) < 1e-3


def test_problems_belong_to_their_weights(packaged, tiny_set, linear_prior):
    with pytest.raises(ValueError, match="other weights"):
        problems(prior=linear_prior)


@pytest.mark.parametrize(
    "asked",
    [
        {"frames": (2,)},
        {"frames": (4, 5)},
        {"frames": 4},
        {"frames": ()},
        {"kinds": "clean"},
        {"kinds": ("clean", "dirty")},
        {"objects": 1.5},
        {"objects": 0},
        {"objects": 2},
    ],
)
def test_no_part_of_a_choice_is_dropped(unchecked_types, tiny_set, linear_prior, asked):
    with pytest.raises(ValueError, match="frames among 1, 4, 8"):
        problems(**asked, problem_set=tiny_set, prior=linear_prior)


def test_a_problem_is_an_objective_of_codes(two, linear_prior):
    for one in two:
        assert jnp.isclose(one.objective(one.first_code), one.first_objective, rtol=1e-5)
        assert 0 <= float(one.iou(one.first_code)) <= 1
        lower, upper = one.bounds
        assert jnp.all((lower < one.first_code) & (one.first_code < upper))
    clean, noisy = two
    assert set(np.unique(clean.grids.occluded)) == {0, 1} < set(np.unique(noisy.grids.occluded))


@pytest.mark.slow
def test_the_lowest_objectives_are_lower_than_the_first_codes(packaged):
    prior = load_prior(WEIGHTS)
    assert fingerprint(prior) == packaged.weights
    assert all(one.best_objective < float(one.first_objective) for one in problems())
