"""The figures of a result that need no truth, and the words for them."""

import numpy as np
import pytest
import trimesh

from jaxshape.mapping.map.doubts import unseen_of_points
from jaxshape.results.summary import verdict_in_words
from jaxshape.results.verdict import (
    Quality,
    SeenView,
    explained,
    free_violated,
    judged,
    pieces,
    quality_of,
    quality_of_cloud,
)

AXIAL = 1.6e-3
SHAPE, FOCAL = (60, 80), 60.0
T_OBJECT_CAMERA = np.array([[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 1.5], [0, 0, 0, 1]], float)
"""In front of the object, upright, looking at it."""

GOOD = Quality(0.95, 0.4, 0.2, 0.4, 0.01, (0.5, 0.9, 0.5), 0.0, 1, 6, 0)


def block(center=(0.0, 0.0, 0.0)):
    """A cube of 40 cm whose faces are a centimetre or two large."""
    cube = trimesh.creation.box((0.4, 0.4, 0.4))
    for _ in range(5):
        cube = cube.subdivide()
    return cube.apply_translation(center)


def view(front=0.2, taken=True):
    """The front of the cube, ray by ray, before a wall 1 m behind it."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]] + 0.5
    z = 1.5 - front
    x, y = (u - 40) / FOCAL * z, (v - 30) / FOCAL * z
    inside = (abs(x) < 0.2) & (abs(y) < 0.2)
    depth = np.where(inside, z, 2.5)
    return SeenView(depth, inside & taken, (FOCAL, FOCAL, 40.0, 30.0), T_OBJECT_CAMERA)


def test_points_on_the_mesh_are_explained_and_others_are_not():
    assert explained(block(), [view()], AXIAL) == 1
    assert explained(block((0, 0, 0.008)), [view()], AXIAL) == 1
    assert explained(block((0, 0, 0.03)), [view()], AXIAL) == 0
    half = block().submesh([np.flatnonzero(block().triangles_center[:, 0] > 0)], append=True)
    assert explained(half, [view()], AXIAL) == pytest.approx(0.53, abs=0.05)
    assert explained(block(), [view(taken=False)], AXIAL) == 0


def test_explained_is_the_share_within_the_nearest_of_all_faces():
    """Against the distance from every face, for points around a mesh of large triangles."""
    mesh, seen = trimesh.creation.icosphere(1, 0.3), view()
    rows, columns = np.nonzero(seen.segmented)
    z = seen.depth[rows, columns]
    p = np.stack([(columns + 0.5 - 40) / FOCAL * z, (rows + 0.5 - 30) / FOCAL * z, z], -1)
    p = p @ T_OBJECT_CAMERA[:3, :3].T + T_OBJECT_CAMERA[:3, 3]
    faces = [mesh.triangles] * len(p)
    away = [
        np.linalg.norm(
            trimesh.triangles.closest_point(t, np.tile(q, (len(t), 1))) - q, axis=1
        ).min()
        for t, q in zip(faces, p, strict=True)
    ]
    slow = np.mean(np.array(away) < np.hypot(0.01, 2 * AXIAL * z**2))
    assert 0.1 < slow < 0.9
    assert explained(mesh, [seen], AXIAL) == pytest.approx(slow, abs=0.02)


def test_a_mesh_in_free_space_is_seen_through():
    assert free_violated(block(), [view()], AXIAL) < 0.01
    beside = block((0.6, 0, 0))
    assert free_violated(beside, [view()], AXIAL) > 0.5
    behind = block((0, 0, -1.4))  # behind the wall, which hides it
    assert free_violated(behind, [view()], AXIAL) == 0


def test_pieces_without_crumbs():
    crumb = trimesh.creation.icosphere(1, 0.005)
    assert pieces(block()) == 1
    assert pieces(trimesh.util.concatenate([block(), block((1, 0, 0)), crumb])) == 2


def test_shares_of_the_area_add_up_and_the_mirror_image_counts():
    mesh = block()
    right = mesh.vertices[:, 0] > 0.05
    found = quality_of(mesh, right, [view()], axial=AXIAL, is_mirrored=True, floor=-0.2)
    assert found.measured + found.mirrored + found.predicted == pytest.approx(1)
    assert found.measured == pytest.approx(found.mirrored, abs=0.03) and found.predicted > 0.1
    alone = quality_of(mesh, right, [view()], axial=AXIAL, floor=-0.26)
    assert alone.mirrored == 0 and alone.measured == found.measured
    assert found.floor_gap == pytest.approx(0) and alone.floor_gap == pytest.approx(0.06)
    assert found.size == pytest.approx((0.4, 0.4, 0.4))
    unknown = quality_of(mesh, None, [view()], axial=AXIAL)
    assert np.isnan([unknown.measured, unknown.floor_gap]).all()
    assert judged(unknown).word == "good"


def test_keyframes_without_the_object_are_counted():
    views = [view(), view(taken=False), view()]
    found = quality_of(block(), None, views, axial=AXIAL)
    assert (found.keyframes, found.empty_keyframes) == (3, 1)


def test_a_result_in_words():
    result = {
        "verdict": "doubtful",
        "verdict_reasons": ["it leans", "it is thin"],
        "quality": {"size": [0.5, 0.914, 0.48], "explained": 0.9},
    }
    said = "verdict: doubtful because it leans; it is thin. The object is 0.50 x 0.91 x 0.48 m."
    assert verdict_in_words(result) == said
    assert verdict_in_words({}) == ""


def test_one_side_that_was_not_seen_is_the_rule():
    assert judged(GOOD._replace(unseen_faces=("bottom", "back"))).word == "good"


def test_a_completed_cloud_is_judged_by_its_points():
    mesh, rng = block(), np.random.default_rng(0)
    right = mesh.vertices[mesh.vertices[:, 0] > 0.05]
    points = right + rng.normal(0, 0.002, right.shape)
    found = quality_of_cloud(mesh, points, voxel=0.015)
    assert found.explained == 1 and judged(found).word == "good"
    assert 0.3 < found.measured < 0.5 and found.mirrored == 0
    assert quality_of_cloud(mesh, points, voxel=0.015, is_mirrored=True).mirrored > 0.2
    unseen = unseen_of_points(points, mesh.extents + [0.2, 0.0, 0.0])
    assert unseen.faces == ("left side", "right side") and unseen.below < 0.01
    partly = quality_of_cloud(mesh, points, voxel=0.015, unseen=unseen)
    assert (
        judged(partly).word == "doubtful" and "left side and right side" in judged(partly).sentence
    )
    upper = unseen_of_points(mesh.vertices[mesh.vertices[:, 1] > 0], mesh.extents)
    assert upper.faces == ("bottom",) and upper.below == pytest.approx(0.5, abs=0.1)
    away = quality_of_cloud(mesh, points + [0.0, 0.1, 0.0], voxel=0.015)
    assert away.explained == pytest.approx(0.5, abs=0.25)
    assert judged(away).word != "good"


def test_a_size_that_no_object_of_its_class_has_is_doubted():
    """Depth in millimetres that is read with 5000 units a metre makes a chair of 19 cm."""
    chair = (0.58, 0.86, 0.60)
    small = GOOD._replace(size=(0.12, 0.19, 0.12))
    assert "0.21 times as large" in judged(small, chair).sentence
    assert "--depth-scale" in judged(small, chair).sentence
    assert judged(GOOD._replace(size=(2.9, 4.0, 3.0)), chair).word == "doubtful"
    for size in [(2.0, 0.9, 1.1), (0.3, 0.45, 0.3), (2.4, 0.8, 0.5), (0.4, 0.75, 0.4)]:
        assert judged(GOOD._replace(size=size), chair).word == "good"
    assert judged(small).word == "good"  # of a class whose sizes are not known


def test_a_good_result_has_no_reasons():
    assert judged(GOOD) == ("good", ()) and judged(GOOD).sentence == "good"


@pytest.mark.parametrize(
    "change, word, said",
    [
        ({"explained": 0.7}, "doubtful", "explains only 70%"),
        ({"explained": 0.3}, "failed", "explains only 30%"),
        ({"measured": 0.05}, "doubtful", "only 5% of the mesh was measured"),
        ({"predicted": 0.72}, "doubtful", "72% of the mesh is predicted"),
        (
            {"free_violated": 0.2},
            "doubtful",
            "20% of the mesh lies in space that was measured as free: some poses or the focal "
            "length are wrong, or the object was moved",
        ),
        ({"free_violated": 0.5}, "failed", "50% of the mesh lie"),
        ({"floor_gap": 0.21}, "doubtful", "21 cm above the floor"),
        ({"floor_gap": -0.1}, "doubtful", "10 cm below the floor"),
        ({"pieces": 4}, "doubtful", "in 4 pieces"),
        ({"empty_keyframes": 2}, "doubtful", "2 of 6 keyframes added almost nothing"),
        ({"empty_keyframes": 4}, "failed", "in 4 of 6 keyframes"),
        ({"unseen_faces": ("back", "front", "top")}, "doubtful", "not seen at its back and front"),
        (
            {"unseen_faces": ("left side", "right side", "bottom", "back", "front")},
            "failed",
            "was not seen at any side",
        ),
        ({"unseen_below": 0.3}, "doubtful", "its lower 30%, for example the legs"),
        ({"unseen_below": 0.6}, "failed", "nothing was measured in its lower 60%"),
        ({"size": (0.5, 9.0, 0.5)}, "failed", "would be 9 m large"),
        ({"size": (0.01, 0.01, 0.02)}, "failed", "would be 0.02 m large"),
    ],
)
def test_each_fault_is_a_reason(change, word, said):
    verdict = judged(GOOD._replace(**change))
    assert verdict.word == word and len(verdict.reasons) == 1
    assert said in verdict.sentence and verdict.sentence.startswith(f"{word} because ")
