"""Point clouds are read as they were written, from PLY and every kind of PCD."""

import struct

import numpy as np
import pytest
import trimesh

from jaxshape.data.clouds import MAX_POINTS, Cloud, moved, offset_of, read_cloud
from jaxshape.data.pcd import parse_pcd

POINTS = np.round(np.random.default_rng(0).normal(size=(300, 3)), 4).astype(np.float32)
NORMALS = (POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)).astype(np.float32)


def packed(content):
    """LZF: each byte as it is, and a run of one byte as a reference to what it repeats."""
    out, i = bytearray(), 0
    while i < len(content):
        run = 1
        while i + run < len(content) and content[i + run] == content[i] and run < 260:
            run += 1
        out += bytes([0, content[i]])
        i += 1
        if run >= 4:  # the run without its first byte, one byte back
            length = run - 1 - 2
            out += bytes([length << 5, 0]) if length < 7 else bytes([7 << 5, length - 7, 0])
            i += run - 1
    return bytes(out)


def write_pcd(path, how, points=POINTS, normals=NORMALS, viewpoint="0 0 0 1 0 0 0"):
    table = np.hstack([points, normals, np.zeros((len(points), 1))]).astype("<f4")
    header = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z normal_x normal_y normal_z curvature\n"
        "SIZE 4 4 4 4 4 4 4\nTYPE F F F F F F F\nCOUNT 1 1 1 1 1 1 1\n"
        f"WIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT {viewpoint}\nPOINTS {len(points)}\nDATA {how}\n"
    )
    if how == "ascii":
        body = "\n".join(" ".join(map(repr, row)) for row in table.astype(float).tolist()).encode()
    elif how == "binary":
        body = table.tobytes()
    else:
        columns = table.T.tobytes()
        block = packed(columns)
        body = struct.pack("<II", len(block), len(columns)) + block
    path.write_bytes(header.encode() + body)


@pytest.mark.parametrize("how", ["ascii", "binary", "binary_compressed"])
def test_every_kind_of_pcd_gives_its_points(tmp_path, how):
    write_pcd(tmp_path / "scan.pcd", how, viewpoint="1 2 -3 1 0 0 0")
    cloud = read_cloud(tmp_path / "scan.pcd")
    np.testing.assert_array_equal(cloud.points, POINTS)
    np.testing.assert_allclose(cloud.normals, NORMALS, atol=1e-6)
    np.testing.assert_array_equal(cloud.sensor, [1, 2, -3])
    write_pcd(tmp_path / "scan.pcd", how)
    assert read_cloud(tmp_path / "scan.pcd").sensor is None


def test_all_rows_of_an_organised_pcd_are_read_or_it_is_refused(tmp_path):
    file = tmp_path / "scan.pcd"
    header = "# café\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 100\n{}DATA binary\n"
    file.write_bytes(header.format("HEIGHT 3\nVIEWPOINT nan 0 0\n").encode() + POINTS.tobytes())
    cloud = read_cloud(file)
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert cloud.sensor is None
    file.write_bytes(header.format("HEIGHT 3\nPOINTS 200\n").encode() + POINTS.tobytes())
    with pytest.raises(ValueError, match="3600 bytes follow its header; expected 2400"):
        read_cloud(file)


def test_a_viewpoint_within_the_points_is_not_used(tmp_path):
    """A cloud that was moved to its centre, with the place from where it was measured before."""
    middle = " ".join(map(str, POINTS.mean(axis=0)))
    write_pcd(tmp_path / "scan.pcd", "binary", viewpoint=f"{middle} 1 0 0 0")
    assert read_cloud(tmp_path / "scan.pcd").sensor is None


def test_references_that_overlap_repeat_what_they_write():
    header = b"FIELDS x y z\nSIZE 1 1 1\nTYPE U U U\nWIDTH 9\nDATA binary_compressed\n"
    block = bytes([2, 1, 2, 3]) + bytes([7 << 5, 24 - 2 - 7, 2])  # 1 2 3, then 24 bytes 3 back
    columns = parse_pcd(header + struct.pack("<II", len(block), 27) + block).values
    assert [columns[axis].tolist() for axis in "xyz"] == [[1.0, 2, 3] * 3] * 3


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("with_normals", [False, True])
def test_ply_points_and_normals(tmp_path, kind, with_normals):
    names = ("x", "y", "z") + ("nx", "ny", "nz") * with_normals
    table = np.hstack([POINTS, NORMALS])[:, : len(names)]
    header = f"ply\nformat {kind} 1.0\nelement vertex {len(POINTS)}\n"
    header += "".join(f"property float {name}\n" for name in names) + "end_header\n"
    order = ">f4" if kind.endswith("big_endian") else "<f4"
    body = table.astype(order).tobytes()
    if kind == "ascii":
        body = "\n".join(" ".join(map(repr, row)) for row in table.tolist()).encode() + b"\n"
    (tmp_path / "scan.ply").write_bytes(header.encode() + body)
    cloud = read_cloud(tmp_path / "scan.ply")
    np.testing.assert_allclose(cloud.points, POINTS, atol=1e-6)
    assert (cloud.normals is not None) == with_normals
    if cloud.normals is not None:
        np.testing.assert_allclose(cloud.normals, NORMALS, atol=1e-6)


def test_triangles_become_points_with_their_normals(tmp_path):
    trimesh.creation.icosphere(radius=2.0, subdivisions=4).export(tmp_path / "ball.ply")
    cloud = read_cloud(tmp_path / "ball.ply")
    assert len(cloud.points) == MAX_POINTS
    np.testing.assert_allclose(np.linalg.norm(cloud.points, axis=1), 2, atol=0.01)
    along = np.sum(cloud.normals * cloud.points, axis=1) / 2
    assert along.min() > 0.98  # all of them outwards


HEADER = "ply\n{}element vertex 300\nproperty float x\nproperty float y\nproperty float z\n{}"


def test_a_ply_cloud_is_whole_or_refused(tmp_path):
    """Text that ends early, and what other readers misread: a comment above the format, the grid of
    a range scan, triangles beside polygons of more corners."""
    file = tmp_path / "scan.ply"
    half = "\n".join(" ".join(map(repr, row)) for row in POINTS[:150].tolist())
    file.write_text(HEADER.format("format ascii 1.0\n", "end_header\n") + half)
    with pytest.raises(ValueError, match="ends before all 300 of 'vertex'"):
        read_cloud(file)
    listed = "element {} {}\nproperty list uchar int vertex_indices\nend_header\n"
    big = HEADER.format("comment a scan\nformat binary_big_endian 1.0\n", listed)
    points = POINTS.astype(">f4").tobytes()
    grid = b"".join(struct.pack(">Bi", 1, i) if i % 3 else b"\0" for i in range(400))
    file.write_bytes(big.format("range_grid", 400).encode() + points + grid)
    np.testing.assert_array_equal(read_cloud(file).points, POINTS)
    faces = struct.pack(">B4i", 4, 0, 1, 2, 3) + struct.pack(">B3i", 3, 0, 4, 5)
    file.write_bytes(big.format("face", 2).encode() + points + faces)
    assert len(read_cloud(file).points) == MAX_POINTS


@pytest.mark.parametrize("unmeasured", [(1.0, np.nan, 1.0), (0.0, 0.0, 0.0)])
def test_points_that_are_not_measured_are_left_out(tmp_path, unmeasured):
    points, normals = POINTS.copy(), NORMALS.copy()
    points[::3], normals[::3] = unmeasured, 0
    write_pcd(tmp_path / "scan.pcd", "binary", points=points, normals=normals)
    cloud = read_cloud(tmp_path / "scan.pcd")
    np.testing.assert_array_equal(cloud.points, POINTS[np.arange(300) % 3 > 0])
    assert len(cloud.normals) == 200


@pytest.mark.parametrize(
    "name, content, said",
    [
        ("scan.las", b"LASF", "expected .ply or .pcd"),
        ("scan.ply", b"", "cannot be read as a point cloud"),
        ("scan.ply", b"ply\nformat ascii 1.0\nelement vertex 9999999999\nend_header\n", "cannot"),
        ("scan.pcd", b"FIELDS x y z\n", "header does not end"),
        (
            "scan.pcd",
            b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 9\nDATA ascii\n1 2",
            "2 numbers",
        ),
        ("scan.pcd", b"FIELDS x y\nSIZE 4 4\nTYPE F F\nWIDTH 1\nDATA ascii\n1 2", "no field z"),
        ("scan.pcd", b"FIELDS x x\nSIZE 4 4\nTYPE F F\nWIDTH 9\nDATA ascii\n", "field twice"),
        ("scan.pcd", b"FIELDS x\nSIZE 3\nTYPE F\nWIDTH 9\nDATA ascii\n", "of type F3; expected"),
        ("scan.pcd", b"FIELDS x\nSIZE 4\nTYPE F F\nWIDTH 9\nDATA ascii\n", "than of fields"),
        ("scan.pcd", b"FIELDS x\nSIZE 4\nTYPE F\nWIDTH -4\nDATA binary\n", "-4 points"),
        (
            "scan.pcd",
            b"FIELDS x\nSIZE 1\nTYPE U\nWIDTH 40\nDATA binary_compressed\n"
            + struct.pack("<II", 3, 40)
            + bytes([255, 255, 255]),
            "before its start",
        ),
        ("scan.pcd", b"FIELDS x\nSIZE 4\nTYPE F\nWIDTH 8\nDATA lzma\n", "'lzma'"),
    ],
)
def test_bad_files_end_in_one_sentence(tmp_path, name, content, said):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=said) as caught:
        read_cloud(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_too_few_points_are_no_shape(tmp_path):
    write_pcd(tmp_path / "scan.pcd", "ascii", points=POINTS[:20], normals=NORMALS[:20])
    with pytest.raises(ValueError, match="20 usable points"):
        read_cloud(tmp_path / "scan.pcd")


def test_coordinates_that_single_precision_has_rounded_are_refused(tmp_path):
    """Those of a map in metres from the equator; in double precision they keep the shape."""
    far = POINTS + [500_000.0, 5_400_000.0, 300.0]
    for kind, name in ((np.float32, "float"), (np.float64, "double")):
        header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(far)}"]
        header += [f"property {name} {axis}" for axis in "xyz"]
        content = "\n".join([*header, "end_header\n"]).encode() + far.astype(kind).tobytes()
        (tmp_path / f"{name}.ply").write_bytes(content)
    with pytest.raises(ValueError, match=r"steps of 0\.5: subtract their middle"):
        read_cloud(tmp_path / "float.ply")
    cloud = read_cloud(tmp_path / "double.ply")
    offset = offset_of(cloud)
    np.testing.assert_array_equal(offset, np.rint(offset))
    np.testing.assert_allclose(offset, [500_000, 5_400_000, 300], atol=2)
    near = moved(cloud._replace(sensor=offset + 1.0), -offset)
    np.testing.assert_allclose(near.points, far - offset)
    assert near.sensor is not None and near.sensor.tolist() == [1, 1, 1]
    assert not offset_of(Cloud(POINTS + 100.0, None, None)).any()
