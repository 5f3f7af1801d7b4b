"""Which camera tells most about a shape: properties, and rays marched one by one."""

from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

import jaxshape as js
from jaxshape.mapping.views.gain import next_views
from jaxshape.mapping.views.seeing import hidden, pack, unpacked

N, RADIUS = 16, 2.0
FRAME = js.GridFrame(jnp.full(3, -0.4), jnp.full(3, 0.8 / N))
CAMERA = js.Intrinsics(*jnp.float32([200, 200, 100, 100]))
rank = jax.jit(partial(next_views, shape=(200, 200)))


def views(**how) -> jaxlie.SE3:
    return js.reachable_views(RADIUS, -0.4, azimuths=8, elevations=3, **how)


def plate(z: int) -> np.ndarray:
    """A wall across the grid that hides what is behind it, at a depth."""
    grid = np.zeros((N, N, N), bool)
    grid[2:14, 2:14, z] = True
    return grid


def walled() -> tuple[np.ndarray, js.Grids]:
    """Two shapes that differ only behind a measured wall, and their F and M."""
    front = plate(12)
    shapes = np.stack([front | plate(3), front | plate(6)])
    occluded = np.zeros((N, N, N), bool)
    occluded[2:14, 2:14, :12] = True
    return np.where(shapes, 6.0, -6.0).astype(np.float32), js.Grids(front, occluded)


def test_what_differs_behind_is_looked_at_from_behind():
    logits, grids = walled()
    found = rank(jnp.asarray(logits), grids, FRAME, views(), CAMERA)
    eyes = np.asarray(found.T_object_camera.translation())
    best = eyes[found.ranking[0]]
    assert best[2] < -0.5 * RADIUS
    in_front = (eyes[:, 2] > 0.9 * RADIUS) & (abs(eyes[:, 0]) < 0.1)
    assert in_front.any() and float(np.max(found.gain[in_front])) < 0.3 * found.gain.max()


def test_a_measured_object_has_nothing_to_tell():
    logits, grids = walled()
    grids = grids._replace(occluded=np.zeros_like(grids.occluded))
    found = rank(jnp.asarray(logits), grids, FRAME, views(), CAMERA)
    assert float(found.entropy) == 0 and not np.asarray(found.gain).any()


def test_a_certain_shape_has_nothing_to_tell():
    logits, grids = walled()
    same = jnp.asarray(np.repeat(logits[:1], 4, axis=0)) * 20
    assert float(rank(same, grids, FRAME, views(), CAMERA).entropy) < 1e-3


def test_rays_find_what_marching_one_by_one_finds():
    rng = np.random.default_rng(0)
    shapes = rng.random((5, N, N, N)) < 0.02
    voxels = rng.integers(0, N, (40, 3))
    eyes = np.array([[40.0, 9, 3], [-30, 20, 8], [8, 45, 9], [25, 30, -20]], np.float32)
    bits = hidden(pack(jnp.asarray(shapes)), N, jnp.asarray(voxels), jnp.asarray(eyes))
    found = np.asarray(unpacked(bits, len(shapes)))
    for s, shape in enumerate(shapes):
        for v, eye in enumerate(eyes):
            for k, voxel in enumerate(voxels):
                assert found[s, v, k] == _is_hidden(shape, voxel, eye)
    assert 0.1 < found.mean() < 0.9


def _is_hidden(shape: np.ndarray, voxel: np.ndarray, eye: np.ndarray) -> bool:
    way = eye - (voxel + np.float32(0.5))
    step = way / np.abs(way).max()
    for i in range(1, N):
        at = voxel + np.float32(0.5) + np.float32(i) * step
        if ((at < 0) | (at >= N)).any():
            return False
        if shape[tuple(at.astype(int))]:
            return True
    return False


def test_gains_turn_with_the_object():
    """A quarter turn of shapes and cameras together changes no gain."""
    logits, grids = walled()
    logits[:, 4:7, 8:12, 4] = 1.0  # nothing of it is symmetric
    quarter = jaxlie.SE3.from_rotation(jaxlie.SO3.from_y_radians(jnp.pi / 2))
    turn = partial(np.rot90, axes=(-1, -3))  # z to x
    turned = js.Grids(*map(turn, grids[:2]))
    before = rank(jnp.asarray(logits), grids, FRAME, views(), CAMERA)
    T = quarter @ views()
    after = rank(jnp.asarray(turn(logits).copy()), turned, FRAME, T, CAMERA)
    assert np.allclose(before.gain, after.gain, rtol=0.06, atol=1)
    assert np.ptp(before.gain) > 100


def test_the_order_of_the_cameras_does_not_matter():
    logits, grids = walled()
    order = np.random.default_rng(0).permutation(24)
    T = views()
    mixed = jax.tree.map(lambda x: x[order], T)
    before, after = (rank(jnp.asarray(logits), grids, FRAME, one, CAMERA) for one in (T, mixed))
    assert np.allclose(np.asarray(before.gain)[order], after.gain)


def test_of_equal_cameras_the_nearer_one_comes_first():
    logits, grids = walled()
    for side in (1.0, -1.0):
        here = jnp.array([side, 0, 0.0]) * RADIUS
        found = rank(jnp.asarray(logits), grids, FRAME, views(), CAMERA, here=here)
        eyes, best = np.asarray(found.T_object_camera.translation()), int(found.ranking[0])
        other = np.argmin(np.linalg.norm(eyes - eyes[best] * [-1, 1, 1], axis=1))
        assert side * eyes[best, 0] >= 0
        assert found.score[best] >= found.score[other]


def test_farther_cameras_tell_less():
    logits, grids = walled()
    gains = [
        rank(jnp.asarray(logits), grids, FRAME,
             js.reachable_views(r, -0.4, azimuths=8, elevations=1, heights=(0.4, 0.4)),
             CAMERA).gain.max()
        for r in (2.0, 4.0)
    ]  # fmt: skip
    assert gains[1] < 0.8 * gains[0]


def test_samples_are_checked():
    logits, grids = walled()
    with pytest.raises(ValueError, match="samples of one object"):
        next_views(jnp.asarray(logits[:, 1:]), grids, FRAME, views(), CAMERA, (200, 200))
    with pytest.raises(ValueError, match="33 samples"):
        many = jnp.zeros((33, N, N, N))
        next_views(many, grids, FRAME, views(), CAMERA, (200, 200))
