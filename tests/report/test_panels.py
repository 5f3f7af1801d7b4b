"""Panels show what they are given, and a picture of them is whole."""

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from made_result import observation, reconstruction, solid
from PIL import Image
from pixels import drawn, grid_of, rgb

from jaxshape.geometry.grid import GridFrame
from jaxshape.report import panels
from jaxshape.report.palette import COLORS
from jaxshape.report.panels import (
    depth_panels,
    grid_panel,
    measurement_panel,
    mesh_panel,
    write_overview,
    write_panels,
)
from jaxshape.report.pictures import render_voxels
from jaxshape.results.output import write_shape


def test_depth_panels_share_a_scale_and_show_what_is_unknown():
    first = np.linspace(1, 3, 200, dtype=np.float32).reshape(10, 20)
    second = np.full((10, 20), 2, np.float32)
    second[0], second[1] = 0, np.inf
    one, two = (panel.image.astype(int) for panel in depth_panels([first, second]))
    near, far = one[0, 2], one[-1, -3]
    assert near.sum() < far.sum()
    at_two_metres = one.reshape(-1, 3)[np.abs(first - 2).argmin()]
    assert np.abs(two[5, 5] - at_two_metres).max() <= 3
    np.testing.assert_array_equal(two[0, 0], rgb(COLORS["occluded"]))
    assert (two[1] > 235).all()


@pytest.mark.parametrize("value", [0, np.inf, 2])
def test_a_depth_image_of_one_value_is_one_colour(value):
    (panel,) = depth_panels([np.full((6, 8), value, np.float32)])
    assert panel.image.shape == (6, 8, 3)
    assert len(np.unique(panel.image.reshape(-1, 3), axis=0)) == 1


def test_fog_covers_only_what_is_occluded():
    occupied, occluded = grid_of((8, 16, 16)), grid_of((24, 16, 16))
    image = measurement_panel("F, M", occupied, occluded).image.astype(int)
    alone = render_voxels(occupied, [COLORS["measured"]], size=len(image)).astype(int)
    fog = drawn(image) & ~drawn(alone)
    assert fog.any() and np.ptp(image[fog], axis=1).max() < 20  # grey
    np.testing.assert_array_equal(image[drawn(alone)], alone[drawn(alone)])


@pytest.mark.parametrize("frames, aspect", [(0, 1), (1, 1), (4, 4 / 3), (9, 4 / 3)])
def test_an_overview_is_1600_wide_and_whole(tmp_path, frames, aspect):
    depth = [np.full((30, round(30 * aspect)), 1 + i, np.float32) for i in range(frames)]
    grid = np.random.default_rng(0).random((32, 32, 32)) < 0.05
    columns = [
        grid_panel("measured", grid, "measured"),
        grid_panel("composed", grid.astype(int) * 2, "measured", "predicted", note="IoU 0.5"),
        mesh_panel("mesh", trimesh.creation.box(), "truth"),
    ]
    path = tmp_path / "overview.png"
    write_panels(path, [depth_panels(depth), columns])
    with Image.open(path) as image:
        pixels = np.array(image.convert("RGB"))
    assert pixels.shape[1] == 1600 and 300 < len(pixels) < 900
    assert [file.name for file in tmp_path.iterdir()] == ["overview.png"]
    edges = [pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1]]
    assert all((edge == 255).all() for edge in edges)  # nothing is cut off
    first = path.read_bytes()
    write_panels(path, [depth_panels(depth), columns])
    assert path.read_bytes() == first


@pytest.mark.parametrize("known", [True, False])
def test_the_overview_shows_depth_then_grids_and_the_truth_where_it_is_known(
    tmp_path, monkeypatch, known
):
    occupied, completed = solid((4, 4, 4), (8, 28, 28)), solid((4, 4, 4), (20, 28, 28))
    frame = GridFrame(jnp.zeros(3), jnp.full(3, 0.02))
    truth, occluded = completed if known else None, solid((8, 4, 4), (28, 28, 28))
    seen = observation(occupied, occluded, truth, frame)
    found = reconstruction(seen, occupied, completed, steps=3)
    write_shape(tmp_path, seen, found, {})
    written = []
    monkeypatch.setattr(panels, "write_panels", lambda path, rows: written.append((path, rows)))
    write_overview(tmp_path, seen, found, {"iou_refined": 1.0} if known else {})
    ((path, (above, below)),) = written
    assert path == tmp_path / "overview.png" and [panel.title for panel in above] == ["depth 1"]
    titles = ["F (blue) and M", "encoder", "refined", "composed", "mesh"] + ["truth"] * known
    assert [panel.title for panel in below] == titles
    assert [panel.note for panel in below if panel.note] == ["IoU 1.00"] * known
    expected = grid_panel("", np.where(occupied, 1, 2 * completed), "measured", "predicted")
    np.testing.assert_array_equal(below[3].image, expected.image)
