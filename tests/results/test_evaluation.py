"""Scores of methods on meshes: what goes into the results file, and that it is well defined."""

import json
from dataclasses import asdict, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from marks import slow

from jaxshape.data.capture import camera_distance, capture, measure_frames
from jaxshape.data.chairs import random_chair
from jaxshape.data.dataset import hash_seed
from jaxshape.data.meshes import Model, Skipped
from jaxshape.geometry import camera, fusion
from jaxshape.geometry.grids import Grids, binary
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
AS_IN_THE_PAPER = replace(CONFIG, camera="paper")
IOUS = {"iou", "iou_composed", "iou_occluded"}
NATS = {"cross_entropy_occluded", "objective"}
SCORES = IOUS | NATS | {"chamfer_l1", "f_score"}


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
                assert all(0 <= methods[method][s] <= 1 for s in SCORES - NATS)
                assert all(0 < methods[method][s] < 10 for s in NATS)
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


@pytest.mark.slow
def test_a_search_finds_the_same_for_a_mesh_alone_and_in_company(linear_prior, scores, models):
    config = replace(CONFIG, methods=("cma",))
    (alone,) = evaluate(linear_prior, models[1:2], config)  # the second of its batch in company
    for k in ("1", "2"):
        ours, theirs = alone["frames"][k]["cma"], scores[1]["frames"][k]["cma"]
        assert ours == pytest.approx(theirs, rel=1e-4)


@pytest.mark.slow
def test_frames_are_the_first_of_the_orbit(models):
    """More frames leave less occluded, and what one frame measured stays measured."""
    case = observe(models[0], AS_IN_THE_PAPER)
    F, M, _ = case.grids
    assert F.shape == (2, 32, 32, 32) and F.dtype == bool
    assert np.all(F[1][F[0]])
    assert np.all(M[0][M[1]])
    assert M[1].sum() < M[0].sum()
    np.testing.assert_array_equal(case.surface[0], case.surface[1])
    swapped = observe(models[0], replace(AS_IN_THE_PAPER, frames=(2, 1)))
    jax.tree.map(lambda x, y: np.testing.assert_array_equal(x[::-1], y), case, swapped)
    low, _ = bounds(F, M, case.surface)
    assert np.all(np.diff(low) > 0)


def test_points_are_those_that_all_frames_together_measure(models):
    """Frames are fused one at a time, and come to the paper's Eq. 6 of all of them."""
    config = replace(AS_IN_THE_PAPER, noise=True, fusion="points", frames=(3,))
    case = observe(models[0], config)
    seed = hash_seed(config.seed, *models[0].name.encode())
    poses = camera.orbit(3, camera_distance(models[0].mesh))
    captured = capture(models[0].mesh, poses, noise=True, seed=seed)
    merged = fusion.merge_all(measure_frames(captured))
    np.testing.assert_array_equal(case.grids.occupied[0], fusion.occupied(merged))
    np.testing.assert_array_equal(case.grids.occluded[0], fusion.occluded(merged))


@pytest.mark.parametrize("name", ["kinect", slow("realsense"), slow("iphone-lidar")])
def test_noisy_frames_are_fused_as_distances(models, name):
    """F and M are soft, as many frames know more than one, and they agree with the truth."""
    case = observe(models[0], replace(CONFIG, camera=name, frames=(1, 4)))
    F, M, _ = case.grids
    assert F.dtype == np.float32 and 0.01 < np.mean((M > 0.1) & (M < 0.9))
    assert M[1].mean() < M[0].mean()
    first, last = iou(binary(case.grids).occupied, case.surface)
    assert 0.2 < first < last


def test_noise_depends_on_the_seed_and_the_name(models):
    noisy, clean = CONFIG, replace(CONFIG, noise=False)
    first, again, other = (
        observe(models[0]._replace(name=name), noisy).grids.occupied
        for name in ("chair", "chair", "another")
    )
    np.testing.assert_array_equal(first, again)
    assert np.any(first != other)
    assert np.any(first != observe(models[0]._replace(name="chair"), clean).grids.occupied)


def test_any_name_and_a_mesh_of_any_size_can_be_observed():
    """A file in millimetres shows the same as one in metres."""
    box = trimesh.creation.box((0.48, 0.8, 0.36))
    case, thousandfold = (
        observe(
            Model("Möbel/椅子 3", box.copy().apply_scale(scale), {}), replace(CONFIG, frames=(1,))
        )
        for scale in (1, 1000)
    )
    assert (case.grids.occupied > 0.5).any() and case.surface.any()
    np.testing.assert_array_equal(case.surface, thousandfold.surface)
    np.testing.assert_allclose(case.grids.occupied, thousandfold.grids.occupied, atol=1e-3)


def test_a_mesh_no_pixel_meets_is_skipped_with_a_reason(linear_prior, models):
    triangle = trimesh.Trimesh(1e-6 * np.eye(3), [[0, 1, 2]], process=False)
    speck = trimesh.util.concatenate([triangle, triangle.copy().apply_translation([0, 0, 1.0])])
    config = replace(CONFIG, frames=(1,), methods=("encoder",))
    speck, chair = evaluate(linear_prior, [Model("speck", speck, {}), models[0]], config)
    assert speck.reason == "nothing measured" and chair["name"] == "chair-0"


def test_a_mesh_that_cannot_be_read_any_more_is_passed_on(linear_prior, models):
    gone = Skipped("gone", "unreadable", "No such file.")
    config = replace(CONFIG, frames=(1,), methods=("encoder",))
    # Three rows as well: programs for other numbers of rows round differently.
    chair, *_ = evaluate(linear_prior, models[:1] * 3, config)
    assert list(evaluate(linear_prior, [gone, models[0], gone], config)) == [gone, gone, chair]


def test_what_methods_have_in_common_is_computed_once(linear_prior):
    """The encoder's answer costs nothing beside a search from it."""

    def flops(*methods):
        run = by_each_method(linear_prior, replace(CONFIG, methods=methods))
        grid = jax.ShapeDtypeStruct((2, 32, 32, 32), bool)
        keys = jax.random.split(jax.random.key(0), 2)
        return run.lower(keys, linear_prior, Grids(grid, grid)).compile().cost_analysis()["flops"]

    both, search, encoder = flops("encoder", "gradient"), flops("gradient"), flops("encoder")
    assert both - search < 0.1 * encoder


def test_an_unknown_method_is_refused_before_anything_is_compiled(linear_prior):
    with pytest.raises(ValueError, match="no method 'magic'"):
        by_each_method(linear_prior, replace(CONFIG, methods=("encoder", "magic")))
