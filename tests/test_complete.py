"""`jaxshape complete`, and `reconstruct --list`, from files to files."""

import json

import numpy as np
import pytest
import trimesh
from PIL import Image
from scene import write_scene
from scipy.spatial import KDTree

from jaxshape.data.chairs import random_chair
from jaxshape.data.meshes import sample_surface


@pytest.fixture
def scan(tmp_path):
    """Points on a chair, in a file whose up is z and whose front is x, with its corner at 1 2 3."""
    points = sample_surface(random_chair(2), 5000, 0)[:, [2, 0, 1]] + [1, 2, 3]
    trimesh.PointCloud(points).export(tmp_path / "scan.ply")
    return tmp_path / "scan.ply"


def test_complete_writes_a_mesh_where_the_cloud_lies(run, scan, tmp_path, linear_weights):
    axes = ("--up", "z", "--front", "x", "--sensor", "4", "2", "4")
    options = ("--method", "encoder", "--weights", linear_weights, "--output", tmp_path / "out")
    status, out, err = run("complete", scan, *axes, *options)
    assert status == 0, err
    assert "5000 points" in out and "z is up" in out
    assert "Neither the sensor" not in err
    for name in ("mesh.ply", "mesh.glb", "result.json", "overview.png", "report.html"):
        assert (tmp_path / "out" / name).stat().st_size > 0
    result = json.loads((tmp_path / "out/result.json").read_text())
    assert result["quality"]["explained"] > 0.9 and 0.3 < result["quality"]["measured"] < 0.9
    assert f"verdict: {result['verdict']}" in out and result["verdict"] != "failed"
    assert result["points"] == 5000 and result["up"] == "z" and result["metres_in_a_unit"] == 1
    points = np.asarray(trimesh.load(scan).vertices)
    mesh = trimesh.load(tmp_path / "out/mesh.ply")
    near = KDTree(sample_surface(mesh, 50_000, 0)).query(points)[0]
    assert np.median(near) < 0.03  # what was measured is in the mesh, in the frame of the file


def test_large_coordinates_and_unseen_parts_are_said(run, tmp_path, linear_weights):
    """The upper half of a chair in centimetres, in the coordinates of a map, as doubles."""
    points = sample_surface(random_chair(2), 5000, 0)
    points = 100 * points[points[:, 1] > 0] + [500_000, 5_400_000, 300]
    header = ["ply", "format ascii 1.0", f"element vertex {len(points)}"]
    header += [f"property double {axis}" for axis in "xyz"] + ["end_header"]
    rows = [" ".join(f"{x:.3f}" for x in row) for row in points]
    (tmp_path / "scan.ply").write_text("\n".join([*header, *rows, ""]))
    options = ("--method", "encoder", "--weights", linear_weights, "--output", tmp_path / "out")
    axes = ("--up", "y", "--front", "z", "--unit", "cm")
    status, _, err = run("complete", tmp_path / "scan.ply", *axes, *options)
    assert status in (0, 3), err
    assert "The coordinates are large" in err and "taken as cm" not in err
    result = json.loads((tmp_path / "out/result.json").read_text())
    assert result["metres_in_a_unit"] == pytest.approx(0.01)
    mesh = trimesh.load(tmp_path / "out/mesh.ply")
    points = points - result["offset"]
    assert np.abs(points).max() < 100
    near = KDTree(sample_surface(mesh, 50_000, 0)).query(points)[0]
    assert np.median(near) < 3


def test_what_cannot_be_completed_is_refused(run, scan, tmp_path, linear_weights):
    options = ("--weights", linear_weights, "--output", tmp_path / "out")
    for arguments, said in (
        ((tmp_path / "none.ply",), "There is no file"),
        ((scan, "--up", "y", "--front", "-y"), "must be perpendicular"),
        ((scan, "--sensor", "nan", "0", "0"), "not finite"),
    ):
        status, out, err = run("complete", *arguments, *options)
        assert status == 2 and not out and said in err
    assert not (tmp_path / "out").exists()


def test_a_cloud_is_not_overwritten_by_its_completion(run, scan, linear_weights):
    cloud = scan.rename(scan.with_name("mesh.ply"))
    content = cloud.read_bytes()
    options = ("--weights", linear_weights, "--output", cloud.parent)
    status, out, err = run("complete", cloud, *options)
    assert status == 2 and not out and "would be overwritten" in err
    assert cloud.read_bytes() == content


def test_a_list_of_objects_numbers_them_on_a_picture(run, tmp_path, linear_weights):
    write_scene(tmp_path / "frames", random_chair(2, style="side chair"), frames=1)
    options = ("--weights", linear_weights, "--output", tmp_path / "out")
    status, out, err = run("reconstruct", tmp_path / "frames", "--list", *options)
    assert status == 0, err
    assert out.startswith("1: ") and "--object" in out
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["objects.png"]
    with Image.open(tmp_path / "out/objects.png") as image:
        assert image.width >= 640 and len(image.getcolors(1 << 24)) > 10
    status, _, err = run("reconstruct", tmp_path / "frames", "--object", 9, *options)
    assert status == 2 and "number 9" in err
