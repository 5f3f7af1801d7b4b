import numpy as np
import pytest
import trimesh
from scipy.spatial.distance import cdist

from jaxshape.results.metrics import boundary_points, bounds, chamfer_l1, f_score, shape_scores
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
