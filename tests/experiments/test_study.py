"""Contestants are compared on the same cases, chair by chair, whatever the batches."""

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxshape.data.chairs import random_chair
from jaxshape.results.evaluation import evaluate
from jaxshape.results.journal import Journal
from jaxshape.search.config import RefineConfig
from study import (
    SEEN,
    TestSet,
    by_method,
    column,
    compare,
    groups,
    mean_low_high,
    measurement,
    subjects,
)

FRAMES = (1, 2)
SEARCH = RefineConfig(iterations=2, population=4, symmetry=False)


@pytest.fixture(scope="module")
def meshes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("seats")
    for i in range(3):
        random_chair(i).export(folder / f"seat-{i}.ply")
    return folder


@pytest.fixture(scope="module")
def test_set(meshes):
    return TestSet(chairs=3, seats=2, meshes=meshes)


def contestants(prior):
    return {
        "encoder": by_method("encoder", prior, SEARCH),
        "cma": by_method("cma", prior, SEARCH),
        "F": measurement,
    }


@pytest.fixture(scope="module")
def journal(linear_prior, test_set, tmp_path_factory):
    """Three batches, the last of which has to be filled up."""
    journal = Journal(tmp_path_factory.mktemp("study") / "study.json", {})
    compare(contestants(linear_prior), linear_prior, test_set, FRAMES, journal, at_a_time=4)
    return journal


def test_a_smaller_test_set_is_part_of_a_larger_one(meshes):
    def names(chairs, seats):
        return [one.name for one in subjects(TestSet(chairs, seats, meshes))]

    large, small = names(40, 3), names(10, 1)
    assert set(small) < set(large) and [n for n in large if n in small] == small
    assert len(large) == 43 and len(set(large)) == 43
    kinds = [one.group for one in subjects(TestSet(40, 3, meshes))]
    assert kinds.count("CAD") == 3 and kinds != sorted(kinds)


def test_every_chair_has_a_row_with_every_contestants_scores(journal, test_set):
    assert list(journal.rows) == [one.name for one in subjects(test_set)]
    assert groups(journal) == ["procedural", "CAD"]
    for row in journal.rows.values():
        for k in ("1", "2"):
            assert set(row[k]["cma"]) == {"iou", "iou_composed", "objective", "seconds"}
            assert row[k]["cma"]["objective"] <= row[k]["encoder"]["objective"] * (1 + 1e-5)
            assert 0 < row[k]["F"]["occluded_empty"] < 1


@pytest.mark.slow
def test_scores_are_those_of_an_evaluation(journal, test_set, linear_prior):
    from jaxshape.data.dataset import load_object

    models = [load_object(one.item) for one in subjects(test_set)]
    config = replace(SEEN, frames=FRAMES, methods=("encoder", "cma"), refine=SEARCH)
    for scores in evaluate(linear_prior, models, config):
        for k in ("1", "2"):
            ours, theirs = journal.rows[scores["name"]][k], scores["frames"][k]
            for method in config.methods:
                for score in ("iou", "iou_composed", "objective"):
                    expected = pytest.approx(theirs[method][score], rel=1e-3)
                    assert ours[method][score] == expected
            expected = pytest.approx(theirs["bounds"]["occluded_full"], rel=1e-4)
            assert ours["F"]["occluded_full"] == expected


def test_a_run_goes_on_where_it_stopped(meshes, linear_prior, tmp_path):
    """With the chairs, and with the contestants, that were missing."""
    journal, seen = Journal(tmp_path / "study.json", {}), []

    def constant(name):
        def contest(keys, prior, case):
            seen.append((name, len(keys)))
            return {"iou": jnp.zeros(len(keys))}

        return {name: contest}

    few, all_of_them = TestSet(2, 1, meshes), TestSet(3, 2, meshes)
    compare(constant("a"), linear_prior, few, FRAMES, journal)
    compare(constant("a"), linear_prior, all_of_them, FRAMES, journal)
    assert seen == [("a", 3 * len(FRAMES)), ("a", 2 * len(FRAMES))]
    again = Journal(journal.path, {})
    compare(constant("a") | constant("b"), linear_prior, all_of_them, FRAMES, again)
    assert seen[2:] == [("b", 5 * len(FRAMES))]
    compare(constant("a") | constant("b"), linear_prior, all_of_them, FRAMES, again)
    assert len(seen) == 3 and set(again.rows) == {one.name for one in subjects(all_of_them)}
    assert all(set(row["1"]) == {"a", "b"} for row in again.rows.values())


def test_scores_may_be_curves(test_set, linear_prior, tmp_path):
    journal = Journal(tmp_path / "study.json", {})

    def curve(keys, prior, case):
        return {"curve": jnp.stack([jnp.arange(3.0)] * len(keys)) / 3}

    compare({"x": curve}, linear_prior, TestSet(2, 0), (1,), journal)
    values = column(journal, "procedural", 1, "x", "curve")
    assert values.shape == (2, 3)
    np.testing.assert_allclose(values[0], [0, 0.33333, 0.66667])


def test_meshes_that_cannot_be_used_are_named_and_left_out(linear_prior, tmp_path, capsys):
    (tmp_path / "broken.ply").write_bytes(b"ply")
    random_chair(0).export(tmp_path / "good.ply")
    journal = Journal(tmp_path / "study.json", {})
    test = TestSet(0, 2, tmp_path)
    compare({"F": measurement}, linear_prior, test, (1,), journal)
    assert list(journal.rows) == ["good"] and "broken is left out" in capsys.readouterr().out


def test_a_folder_without_seats_is_an_error():
    with pytest.raises(FileNotFoundError, match="no file or folder 'nowhere'"):
        subjects(TestSet(1, 1, Path("nowhere")))
    assert len(subjects(TestSet(1, 0, Path("nowhere")))) == 1


def test_a_mean_is_told_with_its_interval():
    assert mean_low_high(np.full(4, 0.25)) == [0.25, 0.25, 0.25]


def test_columns_follow_the_rows(journal):
    values = column(journal, "CAD", 2, "F", "occluded_empty")
    rows = [r for r in journal.rows.values() if r["group"] == "CAD"]
    assert values.tolist() == [r["2"]["F"]["occluded_empty"] for r in rows]
    assert jax.tree.leaves(rows)
