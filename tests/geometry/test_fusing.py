"""Both ways of fusing frames keep the laws of merging, and agree with what they stand for."""

from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from jaxshape.geometry import camera, distance, fusion
from jaxshape.geometry.camera import Intrinsics
from jaxshape.geometry.evidence import soft_grids
from jaxshape.geometry.fusing import Distances, Points, fuse, fusion_named
from jaxshape.geometry.grid import fit_box

SIZE = 24
CAMERA = Intrinsics(*jnp.float32([30, 30, SIZE / 2, SIZE / 2]))
POSES = camera.orbit(3, 2.0)


def frame_of(resolution):
    return fit_box(jnp.full(3, -0.4), jnp.full(3, 0.4), resolution=resolution)


def a_wall():
    """Three images of a plate of half a metre that faces each camera, with nothing behind it."""
    row, column = np.indices((SIZE, SIZE))
    inside = np.maximum(abs(row - SIZE / 2 + 0.5), abs(column - SIZE / 2 + 0.5)) < 5
    return jnp.float32(np.stack([np.where(inside, 1.8 + 0.1 * i, np.inf) for i in range(3)]))


@pytest.mark.parametrize("fusing", [Points(16), Points(16, 2), Distances(16, 32)])
def test_fused_grids_do_not_depend_on_the_order_of_frames(fusing):
    depth = a_wall()
    seen = jnp.isfinite(depth)

    def grids(order):
        poses = jax.tree.map(lambda x: x[order], POSES)
        state = fuse(fusing, depth[order], seen[order], CAMERA, poses, frame_of(16))
        return fusing.grids(state)

    there, back = grids(jnp.array([0, 1, 2])), grids(jnp.array([2, 1, 0]))
    assert there.occupied.shape == (16, 16, 16)
    assert float((there.occupied > 0.5).sum()) > 20
    np.testing.assert_allclose(there.occupied, back.occupied, atol=1e-5)
    np.testing.assert_allclose(there.occluded, back.occluded, atol=1e-5)


@pytest.mark.parametrize("fusing", [Points(8), Distances(8, 32)])
def test_no_frames_leave_everything_unknown(fusing):
    grids = jax.jit(fusing.grids)(fusing.nothing())
    assert not np.asarray(grids.occupied).any()
    assert np.asarray(grids.occluded).all()


def test_points_are_those_of_the_paper():
    depth, T = a_wall()[0], jaxlie.SE3(POSES.wxyz_xyz[0])
    one = (depth, jnp.isfinite(depth), CAMERA, T, frame_of(16))
    found = jax.jit(lambda *one: Points(16, 2).grids(Points(16, 2).measure(*one)))(*one)
    expected = jax.jit(partial(fusion.measure, resolution=16))(*one)
    np.testing.assert_array_equal(found.occupied, fusion.occupied(expected, 2))
    np.testing.assert_array_equal(found.occluded, fusion.occluded(expected, 2))


def test_distances_cover_the_same_box_at_every_resolution():
    depth, T = a_wall()[0], jaxlie.SE3(POSES.wxyz_xyz[0])
    seen = jnp.isfinite(depth)
    coarse, fine = (
        jax.jit(Distances(n, 64).measure)(depth, seen, CAMERA, T, frame_of(n)) for n in (16, 32)
    )
    boxes = [frame_of(n).voxel_size * n for n in (16, 32)]
    np.testing.assert_allclose(boxes[0], boxes[1], rtol=0.2)  # margins are voxels
    measure = jax.jit(partial(distance.measure, resolution=64))
    at_32 = measure(depth, seen, CAMERA, T, frame_of(32))
    np.testing.assert_array_equal(fine.weight, at_32.weight)
    assert soft_grids(coarse, 16).occupied.shape == (16, 16, 16)


def test_names_and_their_refusals(unchecked_types):
    assert fusion_named("points", 16, 3) == Points(16, 3)
    assert fusion_named("distance", 16) == Distances(16)
    with pytest.raises(ValueError, match="fusion"):
        fusion_named("tsdf")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="multiple"):
        Distances(32, 100)
    with pytest.raises(ValueError, match="min_hits"):
        Points(32, 0)
