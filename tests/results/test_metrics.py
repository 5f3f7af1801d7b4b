import numpy as np
import pytest
import trimesh
from scipy.spatial.distance import cdist

from jaxshape.results.metrics import (
    boundary_points,
    bounds,
    chamfer_l1,
    f_score,
    occluded_scores,
    shape_scores,
)
from jaxshape.results.surface import voxel_surface


def random_grids(*shape, seed=0, density=0.3):
    return np.random.default_rng(seed).random(shape) < density


def box(lower, upper, resolution=32):
    grid = np.zeros((resolution,) * 3, bool)
    grid[tuple(slice(a, b) for a, b in zip(lower, upper, strict=True))] = True
    return grid


def test_bounds_are_named_after_what_occluded_voxels_are_set_to():
    truth = box((0, 0, 0), (4, 2, 1))  # 8 voxels
    occupied = box((0, 0, 0), (4, 1, 1))  # 4 of them seen
    behind = box((0, 1, 0), (4, 2, 2))  # the other 4 and 4 free ones are not
    result = bounds(occupied, behind, truth)
    assert float(result.occluded_empty) == pytest.approx(4 / 8)
    assert float(result.occluded_full) == pytest.approx(8 / 12)
    everything = bounds(occupied, np.ones_like(truth), truth)  # what M hides, F cannot say
    assert float(everything.occluded_empty) == 0


def test_occluded_scores_against_loops():
    """Only voxels that are more likely unknown than not count."""
    random = np.random.default_rng(0)
    logits, M = random.normal(0, 2, (5, 5, 5)), random.random((5, 5, 5))
    truth = random_grids(5, 5, 5)
    agree, either, losses = 0, 0, []
    for voxel in np.argwhere(M > 0.5):
        logit, true = logits[tuple(voxel)], truth[tuple(voxel)]
        agree += (logit > 0) and true
        either += (logit > 0) or true
        p = 1 / (1 + np.exp(-logit))
        losses.append(-np.log(p if true else 1 - p))
    found = occluded_scores(logits > 0, logits, M, truth)
    assert float(found.iou) == pytest.approx(agree / either)
    assert float(found.cross_entropy) == pytest.approx(np.mean(losses), rel=1e-5)


def test_occluded_scores_do_not_depend_on_what_was_measured():
    logits, M = np.random.default_rng(1).normal(size=(4, 4, 4)), random_grids(4, 4, 4, seed=2)
    truth = random_grids(4, 4, 4, seed=3)
    other = occluded_scores((logits > 0) & M, np.where(M, logits, -9.0), M, truth | ~M)
    assert occluded_scores(logits > 0, logits, M, truth) == other


def test_occluded_voxels_without_surface_are_right_where_nothing_fills_them():
    nothing, hidden = np.zeros((4, 4, 4), bool), box((0, 0, 0), (2, 2, 2), 4)
    full, empty = np.full((4, 4, 4), 8.0), np.full((4, 4, 4), -8.0)
    assert float(occluded_scores(nothing, empty, hidden, nothing).iou) == 1
    assert float(occluded_scores(~nothing, full, hidden, nothing).iou) == 0
    assert occluded_scores(~nothing, full, nothing, hidden) == (1, 0)  # nothing is occluded


def test_point_distances_against_brute_force():
    random = np.random.default_rng(0)
    a, b = random.random((40, 3)), random.random((70, 3))
    distances = cdist(a, b)
    a_to_b, b_to_a = distances.min(axis=1), distances.min(axis=0)
    chamfer = (a_to_b.mean() + b_to_a.mean()) / 2 / 1.7
    assert chamfer_l1(a, b, 1.7) == pytest.approx(chamfer)
    precision, recall = (a_to_b <= 0.1).mean(), (b_to_a <= 0.1).mean()
    assert f_score(a, b, 0.1) == pytest.approx(2 * precision * recall / (precision + recall))


def test_a_shifted_plane_is_as_far_as_it_was_shifted():
    plane = np.stack(np.meshgrid(*2 * [np.linspace(0, 1, 20)], [0.0]), axis=-1).reshape(-1, 3)
    shifted = plane + [0, 0, 0.02]
    assert chamfer_l1(plane, shifted, 2.0) == pytest.approx(0.01)
    assert f_score(plane, shifted, 0.019) == 0
    assert f_score(plane, shifted, 0.021) == 1


def test_f_score_weighs_missing_parts_and_extra_parts():
    a = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]])
    assert f_score(a, a[:1], 0.1) == pytest.approx(2 * 0.25 * 1 / 1.25)
    assert f_score(a[:1], a, 0.1) == pytest.approx(2 * 0.25 * 1 / 1.25)


def test_empty_point_sets_have_finite_scores():
    points, nothing = np.ones((3, 3)), np.zeros((0, 3))
    assert chamfer_l1(points, nothing, 1.0) == chamfer_l1(nothing, points, 1.0) == 1
    assert chamfer_l1(nothing, nothing, 1.0) == 0
    assert f_score(points, nothing, 0.01) == f_score(nothing, nothing, 0.01) == 0


@pytest.mark.parametrize("density", [0.02, 0.2, 0.6])
def test_boundary_points_are_the_vertices_of_marching_cubes(density):
    occupied = random_grids(8, 8, 8, density=density)
    vertices = np.unique(np.round(2 * voxel_surface(occupied).vertices) / 16, axis=0)
    np.testing.assert_allclose(np.unique(boundary_points(occupied), axis=0), vertices)


def test_boundary_points_are_one_per_unit_of_area():
    points = boundary_points(box((3, 4, 5), (6, 8, 10)))
    assert len(points) == trimesh.creation.box((3, 4, 5)).area
    np.testing.assert_allclose(points.min(axis=0) * 32, [3, 4, 5])
    np.testing.assert_allclose(points.max(axis=0) * 32, [6, 8, 10])


def test_equal_grids_score_perfectly_and_empty_ones_worst():
    shape, nothing = random_grids(32, 32, 32, density=0.05), np.zeros((32, 32, 32), bool)
    assert shape_scores(shape, shape) == (1, 0, 1)
    assert shape_scores(nothing, shape) == (0, 1, 0)
    assert shape_scores(shape, nothing) == (0, 1, 0)
    assert shape_scores(nothing, nothing) == (1, 0, 0)


def test_scores_of_a_plate_raised_by_four_voxels():
    truth, predicted = box((0, 0, 8), (32, 32, 9)), box((0, 0, 12), (32, 32, 13))
    scores = shape_scores(predicted, truth)
    diagonal = np.sqrt(2 + 1 / 32**2)
    # top to top is 4 voxels; bottom of the upper plate to top of the lower one is 3
    assert scores.chamfer_l1 == pytest.approx(3.5 / 32 / diagonal, rel=0.05)
    assert scores.iou == scores.f_score == 0


def test_scores_fall_as_a_shape_is_moved():
    truth = box((8, 8, 8), (20, 20, 20))
    scores = [shape_scores(np.roll(truth, shift, axis=0), truth) for shift in range(4)]
    for nearer, further in zip(scores, scores[1:], strict=False):
        assert further.iou < nearer.iou
        assert further.chamfer_l1 > nearer.chamfer_l1
        assert further.f_score <= nearer.f_score
