"""Scores of methods on meshes: what goes into the results file, and that it is well defined."""

import json
from dataclasses import asdict, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxshape.data.chairs import random_chair
from jaxshape.data.meshes import Model
from jaxshape.geometry.overlap import iou
from jaxshape.results import evaluation
from jaxshape.results.evaluation import (
    EvaluateConfig,
    by_each_method,
    evaluate,
    observe,
    summarize,
)
from jaxshape.results.metrics import bounds
from jaxshape.search.config import RefineConfig

CONFIG = EvaluateConfig((1, 2), refine=RefineConfig(iterations=2, population=4), seed=3)
SCORES = {"iou", "iou_composed", "chamfer_l1", "f_score", "objective"}


@pytest.fixture(scope="module")
def models():
    return [Model(f"chair-{i}", random_chair(i), {"number": str(i)}) for i in range(3)]


@pytest.fixture(scope="module")
def scores(linear_prior, models):
    """Two batches, the second of which has to be filled up."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluation, "OBJECTS_AT_A_TIME", 4)
        return list(evaluate(linear_prior, models, CONFIG))


def test_each_mesh_has_all_scores_of_all_methods(scores, models):
    assert [s["name"] for s in scores] == [m.name for m in models]
    assert [s["metadata"] for s in scores] == [m.metadata for m in models]
    for mesh in scores:
        assert list(mesh["frames"]) == ["1", "2"]
        for methods in mesh["frames"].values():
            assert list(methods) == ["encoder", "gradient", "cma", "bounds"]
            assert set(methods["bounds"]) == {"occluded_empty", "occluded_full"}
            for method in CONFIG.methods:
                assert set(methods[method]) == SCORES
                assert all(0 <= methods[method][s] <= 1 for s in SCORES - {"objective"})
            assert methods["cma"]["objective"] <= methods["encoder"]["objective"] + 1e-6
            assert methods["gradient"]["objective"] <= methods["encoder"]["objective"] + 1e-6


def test_the_ceiling_is_a_bound_whatever_was_seen(linear_prior, models, monkeypatch):
    """Of each mesh's own surface: here one that is shifted by a voxel."""
    monkeypatch.setattr(evaluation, "fit_surface", lambda prior, surface: jnp.roll(surface, 1, 1))
    config = replace(CONFIG, methods=("encoder",), ceiling=True)
    for mesh, model in zip(evaluate(linear_prior, models[:2], config), models, strict=False):
        surface = observe(model, config).surface[0]
        expected = float(iou(jnp.roll(surface, 1, 0), surface))
        ceilings = [frame["bounds"]["ceiling"] for frame in mesh["frames"].values()]
        assert ceilings == pytest.approx([expected, expected]) and 0 < expected < 1


def test_means_are_means(scores):
    means = summarize(scores, CONFIG)
    assert list(means) == ["1", "2"]
    for k, methods in means.items():
        for method, values in methods.items():
            for score, value in values.items():
                each = [mesh["frames"][k][method][score] for mesh in scores]
                assert value == pytest.approx(sum(each) / 3)


def test_results_are_json(scores):
    content = {"config": asdict(CONFIG), "per_mesh": scores, "means": summarize(scores, CONFIG)}
    again = json.loads(json.dumps(content, allow_nan=False))
    assert again["per_mesh"] == scores and again["config"]["refine"]["iterations"] == 2


def test_a_mesh_scores_the_same_alone_and_in_company(linear_prior, scores, models):
    """Also with another number of rows, so only up to rounding; `encoder` draws no numbers."""
    config = replace(CONFIG, methods=("encoder",))
    (alone,) = evaluate(linear_prior, models[2:], config)
    for k in ("1", "2"):
        for score, value in scores[2]["frames"][k]["encoder"].items():
            assert alone["frames"][k]["encoder"][score] == pytest.approx(value, rel=1e-4)
        assert alone["frames"][k]["bounds"] == scores[2]["frames"][k]["bounds"]


def test_a_search_finds_the_same_for_a_mesh_alone_and_in_company(linear_prior, scores, models):
    config = replace(CONFIG, methods=("cma",))
    (alone,) = evaluate(linear_prior, models[1:2], config)  # the second of its batch in company
    for k in ("1", "2"):
        ours, theirs = alone["frames"][k]["cma"], scores[1]["frames"][k]["cma"]
        assert ours == pytest.approx(theirs, rel=1e-4)


def test_frames_are_the_first_of_the_orbit(models):
    """More frames leave less occluded, and what one frame measured stays measured."""
    case = observe(models[0], CONFIG)
    assert case.occupied.shape == (2, 32, 32, 32)
    assert np.all(case.occupied[1][case.occupied[0]])
    assert np.all(case.occluded[0][case.occluded[1]])
    assert case.occluded[1].sum() < case.occluded[0].sum()
    np.testing.assert_array_equal(case.surface[0], case.surface[1])
    swapped = observe(models[0], replace(CONFIG, frames=(2, 1)))
    jax.tree.map(lambda x, y: np.testing.assert_array_equal(x[::-1], y), case, swapped)
    low, _ = bounds(case.occupied, case.occluded, case.surface)
    assert np.all(np.diff(low) > 0)


def test_noise_depends_on_the_seed_and_the_name(models):
    noisy = replace(CONFIG, noise=True)
    clean, first, again = observe(models[0], CONFIG), *(observe(models[0], noisy) for _ in "ab")
    other = observe(models[0]._replace(name="another"), noisy)
    np.testing.assert_array_equal(first.occupied, again.occupied)
    for different in (clean, other):
        assert np.any(first.occupied != different.occupied)


def test_any_name_and_a_mesh_of_any_size_can_be_observed():
    box = trimesh.creation.box((30.0, 50.0, 20.0))
    case = observe(Model("Möbel/椅子 3", box, {}), replace(CONFIG, frames=(1,)))
    assert case.occupied.any() and case.surface.any()


def test_a_mesh_no_pixel_meets_is_skipped_with_a_reason(linear_prior, models):
    triangle = trimesh.Trimesh(1e-6 * np.eye(3), [[0, 1, 2]], process=False)
    speck = trimesh.util.concatenate([triangle, triangle.copy().apply_translation([0, 0, 1.0])])
    config = replace(CONFIG, frames=(1,), methods=("encoder",))
    speck, chair = evaluate(linear_prior, [Model("speck", speck, {}), models[0]], config)
    assert speck.reason == "nothing measured" and chair["name"] == "chair-0"


def test_what_methods_have_in_common_is_computed_once(linear_prior):
    """The encoder's answer costs nothing beside a search from it."""

    def flops(*methods):
        run = by_each_method(linear_prior, replace(CONFIG, methods=methods))
        grid = jax.ShapeDtypeStruct((2, 32, 32, 32), bool)
        keys = jax.random.split(jax.random.key(0), 2)
        return run.lower(keys, linear_prior, grid, grid).compile().cost_analysis()["flops"]

    both, search, encoder = flops("encoder", "gradient"), flops("gradient"), flops("encoder")
    assert both - search < 0.1 * encoder


def test_an_unknown_method_is_refused_before_anything_is_compiled(linear_prior):
    with pytest.raises(ValueError, match="no method 'magic'"):
        by_each_method(linear_prior, replace(CONFIG, methods=("encoder", "magic")))
