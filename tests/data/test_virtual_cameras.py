from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxshape.data import render
from jaxshape.data.capture import camera_distance, capture, fuse_frames, sensor_of
from jaxshape.data.chairs import random_chair
from jaxshape.data.families import TEST_SEEDS
from jaxshape.data.virtual_cameras import CAMERAS, VirtualCamera, virtual_camera
from jaxshape.geometry import camera, distance
from jaxshape.geometry.camera import Intrinsics

KINECT = CAMERAS["kinect"]


@pytest.fixture(scope="module")
def chair():
    return random_chair(TEST_SEEDS + 1)


def orbit(mesh, device, count=3):
    return camera.orbit(count, camera_distance(mesh, device), step=40.0)


def longest_side(depth):
    rows, columns = np.nonzero(np.isfinite(depth))
    return max(np.ptp(rows), np.ptp(columns)) + 1


def test_a_kinect_puts_some_240_pixels_on_a_chair():
    sides = []
    for seed in range(TEST_SEEDS, TEST_SEEDS + 6):
        mesh = random_chair(seed)
        seen = capture(mesh, orbit(mesh, KINECT), noise=False, seed=0, camera=KINECT)
        sides += [longest_side(depth) for depth in seen.depth]
    assert 220 < np.mean(sides) < 260


@pytest.mark.parametrize("name", ["kinect", "realsense", "iphone-lidar"])
def test_the_window_is_a_piece_of_the_whole_image(chair, name):
    device = CAMERAS[name]
    T = orbit(chair, device)
    lens, size = render.window(device, chair, T)
    piece, _ = render.render_depth(chair, T, lens, size)
    middle = np.array([device.width, device.height]) / 2
    left, top = (middle - [float(lens.cx), float(lens.cy)]).round().astype(int)
    whole_lens = Intrinsics(lens.fx, lens.fy, *jnp.float32(middle))
    whole, _ = render.render_depth(chair, T, whole_lens, (device.height, device.width))
    inside = whole[:, top : top + size[0], left : left + size[1]]
    np.testing.assert_allclose(piece, inside, atol=1e-5)
    assert np.isfinite(whole).sum() == np.isfinite(piece).sum() > 0


def test_windows_of_different_objects_have_the_same_size(chair):
    slab = trimesh.creation.box((2.0, 0.1, 1.0))
    sizes = {render.window(KINECT, mesh, orbit(mesh, KINECT))[1] for mesh in (chair, slab)}
    assert len(sizes) == 1


def test_no_ray_that_hits_is_left_out(chair, monkeypatch):
    T = orbit(chair, KINECT)
    lens, size = render.window(KINECT, chair, T)
    few, _ = render.render_depth(chair, T, lens, size)
    every = lambda mesh, poses, lens, size: np.ones((len(poses), *size), bool)  # noqa: E731
    monkeypatch.setattr(render, "_may_hit", every)
    all_rays, _ = render.render_depth(chair, T, lens, size)
    np.testing.assert_array_equal(few, all_rays)


def test_most_rays_that_hit_nothing_are_never_cast(chair):
    T = orbit(chair, KINECT)
    lens, size = render.window(KINECT, chair, T)
    cast = render._may_hit(chair, np.asarray(T.as_matrix()), lens, size).mean()
    hit = np.isfinite(render.render_depth(chair, T, lens, size)[0]).mean()
    assert hit < cast < 2.5 * hit


def test_fusing_frames_one_by_one_is_merging_their_measurements(chair):
    device = VirtualCamera(64, 64, None)
    seen = capture(chair, orbit(chair, device, 4), noise=True, seed=0, camera=device)
    fused = jax.jit(fuse_frames, static_argnums=1)(seen, (1, 3))

    @jax.jit
    def each(depth, T):
        one = lambda depth, T: distance.measure(  # noqa: E731
            depth, jnp.isfinite(depth), seen.intrinsics, T, seen.frame
        )
        return distance.merge_cumulative(jax.vmap(one)(depth, T))

    merged = each(jnp.asarray(seen.depth[:3]), jax.tree.map(lambda x: x[:3], seen.T_object_camera))
    for x, y in zip(fused, merged, strict=True):
        np.testing.assert_allclose(x, y[np.array([0, 2])], atol=1e-4)


def test_a_sensor_is_as_exact_as_the_camera_it_belongs_to():
    """The deviation of what noise adds to a wall 2 m away."""
    wall = np.full((1, 100, 100), 2.0, np.float32)
    for device in CAMERAS.values():
        noisy = render.add_sensor_noise(
            wall + np.linspace(0, 0.05, 100, dtype=np.float32),
            np.ones_like(wall),
            np.random.default_rng(0),
            replace(device.noise, dropout=0.0),
        )
        error = (noisy - wall - np.linspace(0, 0.05, 100))[:, 2:-2, 2:-2]
        np.testing.assert_allclose(error.std(), 4 * sensor_of(device).axial, rtol=0.12)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ((0, 10, None), "width is 0"),
        ((20, 10, None), "field_of_view is None; give degrees, or as many rows"),
        ((20, 10, 200.0), "field_of_view is 200.0"),
        ((20, 20, None, 0.4), "distance is 0.4"),
    ],
)
def test_impossible_cameras_are_refused(wrong, said):
    with pytest.raises(ValueError, match=said):
        VirtualCamera(*wrong)


def test_cameras_go_by_name(unchecked_types):
    assert virtual_camera("kinect") is KINECT
    with pytest.raises(ValueError, match="camera is 'xtion'; give 'paper' or 'kinect'"):
        virtual_camera("xtion")
