"""Procedural mugs: closed, hollow, upright, with a handle along +x; and the whole in small."""

import numpy as np
import pytest
import trimesh
from PIL import Image

import mugs


@pytest.fixture(scope="module", params=range(6))
def mug(request):
    return mugs.random_mug(request.param)


def test_a_mug_is_two_closed_surfaces_facing_outwards(mug):
    body, handle = sorted(mug.split(), key=lambda part: -part.volume)
    assert len(mug.split(only_watertight=False)) == 2
    for part in (body, handle):
        assert part.is_watertight and part.is_winding_consistent and part.volume > 0
    assert handle.volume < 0.3 * body.volume


def test_a_mug_stands_upright_with_its_handle_along_x(mug):
    (x0, y0, z0), (x1, y1, z1) = mug.bounds
    assert y0 == pytest.approx(0) and 0.06 <= y1 <= 0.14
    assert x1 > 1.1 * z1 and -x0 == pytest.approx(z1) and -z0 == pytest.approx(z1)
    assert np.allclose(trimesh.bounds.corners(mug.bounds).mean(0)[2], 0)


def test_a_mug_holds_coffee(mug):
    body = max(mug.split(), key=lambda part: part.volume)
    height = body.bounds[1, 1]
    inside = body.contains([[0, 0.5 * height, 0], [0, 0.95 * height, 0], [0, 0.001, 0]])
    assert inside.tolist() == [False, False, True]
    assert body.volume < 0.6 * body.convex_hull.volume


def test_the_ends_of_the_handle_lie_in_the_wall(mug):
    """They reach into the body, but not through it to where the coffee is."""
    body, handle = sorted(mug.split(), key=lambda part: -part.volume)
    ends = [handle.vertices[:16].mean(0), handle.vertices[-16:].mean(0)]
    assert body.contains(ends).all()


def test_mugs_differ_and_repeat():
    first, again, other = (mugs.random_mug(seed) for seed in (0, 0, 1))
    assert np.array_equal(first.vertices, again.vertices)
    assert not np.allclose(first.extents, other.extents, rtol=0.01)


@pytest.mark.slow
def test_smoke(tmp_path, linear_weights):
    config = mugs.Config(
        output=tmp_path / "mugs", weights=linear_weights, picture=tmp_path / "mugs.png", smoke=True
    )
    names = mugs.main(config)
    assert sorted(path.stem for path in config.output.iterdir()) == sorted(names)
    assert len(names) == 12
    assert Image.open(config.picture).size[0] > 1000
