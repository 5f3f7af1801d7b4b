"""The comparison of procedural and real chairs: its estimators, and the whole of it in small."""

import json

import numpy as np
import pytest
import trimesh
from drawn import is_drawn

import procedural_vs_real as experiment


def box(low, high):
    return trimesh.creation.box(bounds=[low, high])


def table(size=(0.5, 0.9, 0.5), *, back=False, arms=False, leg=0.05):
    """A chair with its seat at half its height, as a mesh on four square legs."""
    x, y, z = np.array(size) / 2
    pieces = [box((-x, -0.05, -z), (x, 0, z))]
    pieces += [box((a, -y, b), (a + leg, 0, b + leg)) for a in (-x, x - leg) for b in (-z, z - leg)]
    if back:
        pieces.append(box((-x, 0, -z), (x, y, -z + 0.06)))
    if arms:
        pieces += [box((a, 0.2, -z), (a + 0.04, 0.24, z)) for a in (-x, x - 0.04)]
    return trimesh.util.concatenate(pieces)


def measured(*meshes):
    source = [(str(i), mesh) for i, mesh in enumerate(meshes)]
    return experiment.measure(source, "test")


def test_statistics_of_a_chair_of_known_sizes():
    seats = measured(table((0.5, 0.9, 0.6), back=True), table((0.5, 0.9, 0.6), back=True, leg=0.09))
    numbers = experiment.grid_statistics(seats)
    assert numbers["width / height"] == pytest.approx(0.5 / 0.9)
    assert numbers["depth / height"] == pytest.approx(0.6 / 0.9)
    assert numbers["seat height / height"] == pytest.approx(0.5, abs=0.04)
    assert numbers["leg thickness / height"] == pytest.approx([0.05 / 0.9, 0.09 / 0.9], abs=2e-3)
    assert numbers["back thickness / height"] == pytest.approx(0.06 / 0.9, abs=2e-3)
    assert (numbers["filled share of the back"] > 0.95).all()


def test_parts_are_told_apart():
    ottoman = box((-0.4, 0, -0.4), (0.4, 0.4, 0.4))
    found = experiment.parts(
        measured(table((0.5, 0.9, 0.5), back=True), table(back=True, arms=True), ottoman)
    )
    assert found["back"].tolist() == [True, True, False]
    assert found["arms"].tolist() == [False, True, False]
    assert found["four feet"].tolist() == [True, True, False]
    assert found["one foot"].tolist() == [False, False, True]
    assert found["voluminous"].tolist() == [False, False, True]


def test_nearest_agrees_with_the_definition():
    random = np.random.default_rng(0)
    these, those = (random.random((n, 4, 4, 4)) < 0.4 for n in (7, 5))
    best, which = experiment.nearest(these, those, block=3)
    iou = np.array([[(a & b).sum() / (a | b).sum() for b in those] for a in these])
    assert np.allclose(best, iou.max(1)) and (which == iou.argmax(1)).all()
    assert (experiment.nearest(these, these)[0] == 1).all()
    assert (experiment.nearest(these, these, same=True, block=3)[0] < 1).all()


def test_a_distribution_covers_itself_and_not_one_far_away():
    values = np.linspace(0, 1, 200)
    itself = experiment.compare(values, values)
    assert itself["covered"] >= 0.97 and itself["KS"] == itself["Wasserstein"] == 0
    assert experiment.compare(values, values + 2)["covered"] == 0


def test_boxes_become_a_mesh():
    turned = [1, 2, 3, 0.2, 0.4, 0.6, 0, 1, 0, -1, 0, 0]  # first axis along y, second along -x
    mesh = experiment.box_mesh(np.array([turned, turned], float))
    assert mesh.volume == pytest.approx(2 * 0.2 * 0.4 * 0.6)
    assert mesh.extents == pytest.approx([0.4, 0.2, 0.6])
    assert mesh.bounds.mean(0) == pytest.approx([1, 2, 3])


@pytest.mark.slow
@pytest.mark.parametrize("with_boxes", [True, False])
def test_smoke(tmp_path, with_boxes):
    (tmp_path / "cad").mkdir()
    for i, mesh in enumerate((table(), table(back=True), table(arms=True, back=True))):
        mesh.export(tmp_path / f"cad/{i}.ply")
    chair = [[0, 0.45, 0, 0.5, 0.05, 0.5, 1, 0, 0, 0, 1, 0]]
    chair += [[0, 0.7, -0.23, 0.5, 0.5, 0.04, 1, 0, 0, 0, 1, 0]]
    boxes = np.array(chair * 25) * np.random.default_rng(0).uniform(0.9, 1.1, (50, 1))
    boxes[:, 6:] = chair[0][6:]
    np.savez(tmp_path / "boxes.npz", boxes=boxes, count=np.full(25, 2))
    config = experiment.Config(
        cad=tmp_path / "cad",
        boxes=tmp_path / "boxes.npz" if with_boxes else None,
        results=tmp_path,
        smoke=True,
    )
    first = experiment.main(config)
    assert json.loads((tmp_path / "procedural_vs_real.json").read_text()) == first
    assert is_drawn(tmp_path / "procedural_vs_real.png")
    assert first["seats"] == {"procedural": 20, "CAD": 3} | ({"boxes": 25} if with_boxes else {})
    assert len(first["worst covered CAD seats"]) == 3
    again = experiment.main(config)
    assert {**again, "seconds": 0} == {**first, "seconds": 0}
