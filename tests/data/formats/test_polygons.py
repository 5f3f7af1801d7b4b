"""Polygons are covered by triangles that have their area and their side, convex or not."""

import numpy as np
import pytest

from jaxshape.data.formats.obj import read_obj
from jaxshape.data.formats.off import read_off
from jaxshape.data.formats.ply import read_ply
from jaxshape.data.formats.polygons import triangulate

L = np.array([[0, 0], [3, 0], [3, 1], [1, 1], [1, 3], [0, 3]], float)
"""Six corners, one of which turns the other way; an area of 5."""

ARROW = np.array([[0, 0], [2, 1], [0, 2], [1, 1]], float)
"""Four corners, one of which turns the other way; an area of 1."""


def covered(vertices, faces):
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return np.cross(b - a, c - a).sum(axis=0) / 2, np.linalg.norm(
        np.cross(b - a, c - a), axis=1
    ) / 2


@pytest.mark.parametrize(("outline", "area"), [(L, 5), (ARROW, 1)])
@pytest.mark.parametrize("start", range(4))
@pytest.mark.parametrize("plane", [(0, 1, 2), (1, 2, 0), (0, 2, 1)])
def test_a_polygon_with_a_notch_keeps_its_area_and_its_side(outline, area, start, plane):
    flat = np.append(np.roll(outline, start, axis=0), np.zeros((len(outline), 1)), axis=1)
    vertices = flat[:, plane]
    count = len(vertices)
    faces = triangulate(vertices, np.arange(count), np.array([count]))
    vector, areas = covered(vertices, faces)
    assert len(faces) == count - 2 and areas.sum() == pytest.approx(area)  # no overlaps
    normal = np.cross(vertices, np.roll(vertices, -1, axis=0)).sum(axis=0) / 2
    np.testing.assert_allclose(vector, normal, atol=1e-12)


def test_polygons_of_all_sizes_come_in_their_order():
    angles = np.linspace(0, 2 * np.pi, 7, endpoint=False)
    disc = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    vertices = np.concatenate([disc, np.append(L, np.zeros((6, 1)), axis=1)])
    indices = np.array([0, 1, 2, 7, 8, 9, 10, 11, 12, 0, 1, 2, 3, 4, 5, 6, 0, 1, 2, 3, 4])
    faces = triangulate(vertices, indices, np.array([3, 6, 7, 2, 3]))
    assert faces[0].tolist() == [0, 1, 2] and faces[-1].tolist() == [2, 3, 4]
    assert (faces[1:5] >= 7).all() and (faces[5:10] < 7).all() and len(faces) == 11
    areas = covered(vertices, faces)[1]
    assert areas[1:5].sum() == pytest.approx(5)
    assert areas[5:10].sum() == pytest.approx(3.5 * np.sin(2 * np.pi / 7))


CORNERS = "\n".join(f"{x:g} {y:g} 0" for x, y in L)
PLY = (
    "ply\nformat {} 1.0\nelement vertex 6\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 2\nproperty list uchar int vertex_indices\nproperty uchar red\nend_header\n"
)


def test_every_format_with_polygons_reads_them_the_same():
    """An L of six corners and a triangle: an area of 6.5."""
    obj = "\n".join(f"v {row}" for row in CORNERS.split("\n")) + "\nf 1 2 3 4 5 6\nf 1 2 5\n"
    off = f"OFF\n6 2 0\n{CORNERS}\n6 0 1 2 3 4 5 0.5 0.5 0.5\n3 0 1 4\n"
    ply = PLY.format("ascii") + f"{CORNERS}\n6 0 1 2 3 4 5 9\n3 0 1 4 9\n"
    parts = [read_obj(obj.encode()), read_off(off.encode()), read_ply(ply.encode())]
    for order, name in (("<", "binary_little_endian"), (">", "binary_big_endian")):
        rows = [np.append(L, np.zeros((6, 1)), axis=1).astype(order + "f4").tobytes()]
        for face in ([0, 1, 2, 3, 4, 5], [0, 1, 4]):
            rows.append(bytes([len(face)]) + np.array(face, order + "i4").tobytes() + b"\x09")
        parts.append(read_ply(PLY.format(name).encode() + b"".join(rows)))
    for (part,) in parts:
        assert covered(part.vertices, part.faces)[1].sum() == pytest.approx(5 + 4.5)
