"""`jaxshape inspect`: a table or JSON of what is there, and warnings that end well."""

import json
import sys
from typing import get_args

import numpy as np
import pytest
from PIL import Image

from jaxshape import cli
from jaxshape.cli.inspecting import LayoutName
from jaxshape.data.sequences import LAYOUTS


@pytest.fixture
def inspect(monkeypatch, capsys):
    """Run the command in this process; returns its exit status, its answer and its complaint."""
    monkeypatch.setattr(cli, "prepare_process", lambda: None)
    monkeypatch.setenv("COLUMNS", "200")

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["jaxshape", "inspect", *map(str, arguments)])
        try:
            cli.main()
            status = 0
        except SystemExit as stop:
            status = stop.code or 0
        out, err = capsys.readouterr()
        return status, " ".join(out.split()), " ".join(err.split())

    return run


@pytest.fixture
def folder(tmp_path):
    """Four frames of a slope; one number is missing."""
    depth = np.linspace(1000, 3000, 48 * 64).reshape(48, 64).astype(np.uint16)
    for number in (0, 1, 2, 4):
        Image.fromarray(depth).save(tmp_path / f"frame-{number}.depth.png")
        np.savetxt(tmp_path / f"frame-{number}.pose.txt", np.eye(4))
    K = [[60, 0, 32], [0, 60, 24], [0, 0, 1]]
    np.savetxt(tmp_path / "camera-intrinsics.txt", K)
    return tmp_path


def test_a_table_and_warnings(inspect, folder):
    status, out, err = inspect(folder)
    assert status == 0 and not err
    for said in (
        "7-scenes",
        "4, frame-0 to frame-4, 64 x 48 pixels",
        "fx 60.0, fy 60.0, cx 32.0, cy 24.0 (camera-intrinsics.txt)",
        "1000 units a metre: median 2.00 m; 0% invalid, 0% saturated (4 frames read)",
        "4 of 4 frames, a path of 0.00 m; too little motion to tell whether they fit",
        "1 after frame-2",
        "warning missing frames: 1, the most (1) between frame-2 and frame-4. Tracking may",
    ):
        assert said in out, said


def test_json_is_one_object_with_the_same_figures(inspect, folder):
    status, out, _ = inspect(folder, "--json")
    found = json.loads(out)
    assert status == 0 and found["layout"] == "7-scenes" and found["frames"] == 4
    assert found["intrinsics"] == {"fx": 60, "fy": 60, "cx": 32, "cy": 24}
    assert found["gaps"] == [{"after": "frame-2", "before": "frame-4", "missing": 1}]
    assert found["poses"]["pairs"] == 0 and found["rate"] is None
    (warning,) = found["warnings"]
    assert set(warning) == {"evidence", "advice"}


def test_a_wrong_depth_scale_is_a_warning(inspect, folder):
    status, out, _ = inspect(folder, "--depth-scale", 1)
    assert status == 0 and "2 km at depth scale 1" in out
    assert "Is --depth-scale 1000 meant?" in out


def test_what_cannot_be_read_is_refused(inspect, folder, tmp_path):
    status, out, err = inspect(tmp_path / "nowhere")
    assert status == 2 and not out and "is not a folder" in err
    (tmp_path / "empty").mkdir()
    status, out, err = inspect(tmp_path / "empty")
    assert status == 2 and not out and "holds no recording but nothing" in err
    for path in folder.glob("*.depth.png"):
        path.write_bytes(b"")
    status, out, err = inspect(folder)
    assert status == 2 and not out and "cannot be read as an image" in err


def test_every_layout_can_be_asked_for():
    assert get_args(LayoutName) == tuple(LAYOUTS)
