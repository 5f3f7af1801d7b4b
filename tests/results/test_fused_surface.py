from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from jaxshape.data.render import fit_intrinsics, render_depth
from jaxshape.geometry import camera, distance, grid
from jaxshape.geometry.pixels import Sensor
from jaxshape.results.fused_surface import fuse_surface

SIZE = 200
CLEAN = Sensor(axial=3e-4)
NOTHING = np.full((32, 32, 32), -9.0, np.float32)


@partial(jax.jit, static_argnames="sensor")
def fused(depth, intrinsics, T, frame, sensor=CLEAN):
    one = lambda depth, T: distance.measure(  # noqa: E731
        depth, jnp.isfinite(depth), intrinsics, T, frame, sensor
    )
    return distance.merge_all(jax.vmap(one)(depth, T))


def seen(mesh, azimuth, elevation):
    T = jax.jit(camera.on_sphere, static_argnums=2)(
        jnp.array(azimuth, float), jnp.array(elevation, float), 1.5
    )
    intrinsics = fit_intrinsics(mesh, T, SIZE)
    depth, _ = render_depth(mesh, T, intrinsics, SIZE)
    frame = grid.fit_box_isotropic(*jnp.float32(mesh.bounds))
    return fused(jnp.asarray(depth), intrinsics, T, frame), frame


def logits_of(mesh, frame):
    """Sure of the voxels that hold the surface."""
    points = mesh.sample(40_000, seed=0)
    voxel = np.floor((points - np.asarray(frame.origin)) / np.asarray(frame.voxel_size)).astype(int)
    logits = np.full((32, 32, 32), -6.0, np.float32)
    logits[tuple(voxel.T)] = 6
    return logits


@pytest.fixture(scope="module")
def table():
    """A top of 3 cm on one leg."""
    top, leg = trimesh.creation.box((0.6, 0.03, 0.6)), trimesh.creation.box((0.06, 0.5, 0.06))
    top.apply_translation((0, 0.265, 0))
    return trimesh.util.concatenate([top, leg])


def test_a_sphere_seen_all_around_is_one_closed_exact_surface_without_a_cavity():
    ball = trimesh.creation.icosphere(4, 0.3)
    field, frame = seen(ball, [0, 90, 180, 270] * 2, [40] * 4 + [-40] * 4)
    found = fuse_surface(field, NOTHING, frame)
    radius = np.linalg.norm(found.mesh.vertices, axis=1)
    assert np.percentile(np.abs(radius - 0.3), 95) < 0.002
    assert found.mesh.is_watertight and found.dropped == 0
    np.testing.assert_allclose(found.mesh.volume, 4 / 3 * np.pi * 0.3**3, rtol=0.03)
    assert found.measured.mean() > 0.9


def test_thickness_is_right_to_a_few_millimetres(table):
    field, frame = seen(table, [20, 110, 200, 290] * 2, [35] * 4 + [-35] * 4)
    mesh = fuse_surface(field, NOTHING, frame).mesh
    top = mesh.vertices[(np.abs(mesh.vertices[:, [0, 2]]).max(axis=1) > 0.1)
                        & (np.abs(mesh.vertices[:, [0, 2]]).max(axis=1) < 0.25)]  # fmt: skip
    upper, lower = (np.median(top[side, 1]) for side in (top[:, 1] > 0.265, top[:, 1] < 0.265))
    assert abs(upper - lower - 0.03) < 0.003
    leg = mesh.vertices[np.abs(mesh.vertices[:, 1]) < 0.15]
    np.testing.assert_allclose(np.ptp(leg[:, [0, 2]], axis=0), 0.06, atol=0.01)


def test_what_was_not_seen_comes_from_the_decoded_shape(table):
    field, frame = seen(table, [20, 110, 200, 290], [40] * 4)  # the leg is mostly hidden
    alone = fuse_surface(field, NOTHING, frame)
    whole = fuse_surface(field, logits_of(table, frame), frame)
    below = whole.mesh.vertices[:, 1] < 0.2
    assert whole.mesh.is_watertight
    assert whole.mesh.vertices[:, 1].min() < -0.2
    assert whole.mesh.area > alone.mesh.area
    assert (~whole.measured).sum() > (~alone.measured).sum()
    assert np.abs(whole.mesh.vertices[below][:, [0, 2]]).max() < 0.31


def test_pieces_in_the_air_are_dropped_and_counted(table):
    field, frame = seen(table, [20, 110, 200, 290], [40] * 4)
    logits = logits_of(table, frame)
    field = distance.DistanceField(*(jnp.zeros_like(x) for x in field))
    with_crumb = logits.copy()
    with_crumb[2, 8:10, 2] = 6
    clean, found = fuse_surface(field, logits, frame), fuse_surface(field, with_crumb, frame)
    assert found.dropped == clean.dropped + 1
    assert len(found.mesh.vertices) == len(clean.mesh.vertices)
    assert not found.measured.any()


@pytest.mark.parametrize("resolution", [16, 64])
def test_decoded_grids_of_any_resolution_complete_it(table, resolution):
    """The same box cut into fewer or more voxels gives a whole table that agrees."""
    field, frame = seen(table, [20, 110, 200, 290], [40] * 4)
    points = table.sample(60_000, seed=0)
    coarse = frame._replace(voxel_size=frame.voxel_size * (32 / resolution))
    at = (points - np.asarray(coarse.origin)) / np.asarray(coarse.voxel_size)
    logits = np.full((resolution,) * 3, -6.0, np.float32)
    logits[tuple(np.floor(at).astype(int).T)] = 6
    found, usual = fuse_surface(field, logits, coarse), fuse_surface(
        field, logits_of(table, frame), frame
    )  # fmt: skip
    assert found.mesh.is_watertight
    np.testing.assert_allclose(found.mesh.bounds, usual.mesh.bounds, atol=0.03)
    away, _ = KDTree(usual.mesh.vertices).query(found.mesh.vertices[found.measured])
    assert np.percentile(away, 95) < 0.004


def test_what_is_measured_ends_without_a_fin_where_the_decoded_shape_is_free(table):
    """One camera sees the front of the leg; nothing stands out beside it into the unknown."""
    field, frame = seen(table, [0], [10])
    mesh = fuse_surface(field, NOTHING, frame).mesh
    leg = mesh.vertices[(mesh.vertices[:, 1] < 0.15) & (mesh.vertices[:, 1] > -0.2)]
    assert np.abs(leg[:, 0]).max() < 0.03 + 0.01 and leg[:, 2].min() > 0


def test_flags_have_no_speckles():
    """Of a sphere seen from one side, measured and predicted vertices are one piece each."""
    ball = trimesh.creation.icosphere(4, 0.3)
    field, frame = seen(ball, [0], [20])
    found = fuse_surface(field, logits_of(ball, frame), frame)
    for kind in (found.measured, ~found.measured):
        edges = found.mesh.edges[kind[found.mesh.edges].all(axis=1)]
        labels = trimesh.graph.connected_component_labels(edges, node_count=len(kind))[kind]
        assert np.bincount(labels).max() > 0.97 * kind.sum()


def test_nothing_at_all_is_an_error():
    with pytest.raises(ValueError, match="no surface"):
        frame = grid.fit_box(jnp.full(3, -0.5), jnp.full(3, 0.5))
        fuse_surface(distance.nothing_measured(), NOTHING, frame)
