import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from analytic_room import CHAIR, CRATE, FLOOR, TABLE, WALLS, K, room
from scipy import ndimage

from jaxshape.data.boxes import Box
from jaxshape.geometry import distance, fusion, grid
from jaxshape.geometry.camera import Intrinsics, intrinsics_of
from jaxshape.geometry.grids import binary
from jaxshape.mapping.config import MappingConfig, TrackingConfig
from jaxshape.mapping.map.mapper import build_mapper
from jaxshape.mapping.map.state import assemble, fused_anew, grids_of
from jaxshape.mapping.tracking import registration, surfels
from jaxshape.mapping.tracking.keyframes import DepthImage, PreparedFrame, keyframe_of, place_of
from jaxshape.mapping.tracking.views import view_of
from jaxshape.search.config import RefineConfig
from jaxshape.search.reconstruction import refiner_for

LENS = intrinsics_of(K)
FURNITURE = (FLOOR, WALLS, CHAIR, TABLE, CRATE)
T_WORLD_OBJECT = np.eye(4)
T_WORLD_OBJECT[:3, 3] = 0, 0.49, 0
BOX = Box(T_WORLD_OBJECT, np.array([0.5, 0.96, 0.5]))

prepare = jax.jit(view_of)


def seen_from(azimuth, seed=0):
    angle = np.deg2rad(azimuth + 30)
    return room(FURNITURE, (2 * np.sin(angle), 1.4, 2 * np.cos(angle)), seed=seed)


def shot(depth):
    return PreparedFrame(prepare(jnp.float32(depth), LENS), jnp.ones(depth.shape, bool))


def as_pose(T):
    return jaxlie.SE3.from_matrix(jnp.float32(T))


ROOMS = [seen_from(azimuth, seed=i) for i, azimuth in enumerate((0, 4, 12, 24, 36))]
SHOTS = [shot(one.depth) for one in ROOMS]
POSES = [as_pose(one.T_world_camera) for one in ROOMS]


@pytest.fixture(scope="module")
def build(shy_prior):
    """Builds mappers that share what is compiled."""
    search = RefineConfig(iterations=2, population=4)
    settings = MappingConfig(
        keyframe_iterations=2, keyframe_distance=0.15, fusion="points", min_hits=1
    )
    refiner = refiner_for("cma", shy_prior, search)
    return lambda: build_mapper(shy_prior, refiner, search, settings, TrackingConfig())


@pytest.fixture(scope="module")
def shy_prior(linear_prior):
    """Its shapes are all but empty, so that they do not disturb the tracking."""
    shy = 0.01 * linear_prior.params["components"]
    return linear_prior._replace(params=linear_prior.params | {"components": shy})


@pytest.fixture(scope="module")
def mapper(build):
    return build()


def follow(mapper, shots, poses=None, **settings):
    """The states after each frame, and what became of the frames."""
    states, steps = [mapper.init(shots[0], BOX, POSES[0], **settings)[0]], []
    for i, one in enumerate(shots[1:], start=1):
        state, step = mapper.step(states[-1], one, None if poses is None else poses[i])
        states.append(state)
        steps.append(step)
    return states, steps


@pytest.fixture(scope="module")
def run(mapper):
    return follow(mapper, SHOTS)


def copied(tree):
    return jax.tree.map(np.array, tree)


def assert_same(a, b):
    jax.tree.map(np.testing.assert_array_equal, copied(a), copied(b))


# ------------------------------------------------------------------ what becomes of frames


def test_frames_are_tracked_and_become_keyframes_where_they_have_moved(run):
    states, steps = run
    assert [step.status for step in steps] == ["tracked", "keyframe", "keyframe", "keyframe"]
    assert len(states[-1].keyframes) == 4
    for state, truth in zip(states[1:], POSES[1:], strict=True):
        metres, degrees = registration.displacement(state.T_world_camera, truth)
        assert metres < 0.015 and degrees < 0.3
    assert set(steps[0].seconds) == {"track"}
    assert set(steps[1].seconds) == {"track", "fuse", "refine"}
    assert set(steps[-1].seconds) == {"track", "fuse", "refine", "realign"}


def test_a_step_leaves_the_state_it_was_given_as_it_was(mapper, run):
    state = run[0][2]
    before = copied(state)
    first, _ = mapper.step(state, SHOTS[3])
    assert_same(state, before)
    second, _ = mapper.step(state, SHOTS[3])
    assert_same(first, second)
    assert_same(first, run[0][3])  # and gives the same again
    mapper.moved(state, BOX)
    mapper.finish(state)
    assert_same(state, before)


def test_the_map_is_what_all_its_keyframes_measure_at_once(run):
    """F, M and the sums of the surface, against each frame fused apart and all merged."""
    for state in run[0][2:]:
        measured = []
        for one in state.keyframes:
            T = as_pose(np.linalg.inv(T_WORLD_OBJECT)) @ one.T_world_camera
            measured.append(fuse(one.depth, one.segmented, one.intrinsics, T, state.place.frame))
        whole = fusion.merge_all(jax.tree.map(lambda *x: jnp.stack(x), *measured))
        assert_same(fusion.occupied(state.measurement), fusion.occupied(whole))
        assert_same(fusion.occluded(state.measurement), fusion.occluded(whole))
        anew = fused_anew(state)
        assert_same(anew.measurement, state.measurement)
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-2),
            anew.sums, state.sums,
        )  # fmt: skip
    assert 100 < int(fusion.occupied(run[0][-1].measurement).sum())


fuse = jax.jit(fusion.measure)


def test_by_distances_too_the_map_is_what_all_keyframes_measure(run, shy_prior):
    """And its F is the one by points, but for voxels beside the surface."""
    state = run[0][-1]
    by = MappingConfig(fusion="distance")
    mapped = assemble(shy_prior, state.place, state.keyframes, state.view, by)
    fields = []
    for one in state.keyframes:
        T = as_pose(np.linalg.inv(T_WORLD_OBJECT)) @ one.T_world_camera
        fields.append(apart(one.depth, one.segmented, one.intrinsics, T, state.place.frame))
    whole = distance.merge_all(jax.tree.map(lambda *x: jnp.stack(x), *fields))
    for ours, theirs in zip(mapped.measurement, whole, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-4)
    F = np.asarray(binary(grids_of(mapped)).occupied)
    points = np.asarray(binary(grids_of(state)).occupied)
    assert (F & ~ndimage.binary_dilation(points)).sum() < 0.05 * F.sum() and F.sum() > 100


apart = jax.jit(distance.measure)


def test_a_frame_is_fused_in_full_size_and_tracked_in_half(shy_prior):
    """Twice as many pixels of the same scene give the same F where the small ones do."""
    wide = jnp.repeat(jnp.repeat(jnp.float32(ROOMS[0].depth), 2, axis=0), 2, axis=1)
    lens = Intrinsics(*(2 * x for x in LENS))
    whole = SHOTS[0]._replace(recorded=DepthImage(wide, lens))
    by = MappingConfig(fusion="points", min_hits=1)
    hits = []
    for prepared in (SHOTS[0], whole):
        place = place_of(BOX, 32)
        keyframe = keyframe_of(prepared, place, POSES[0], None)
        assert keyframe.depth.shape == ROOMS[0].depth.shape
        state = assemble(shy_prior, place, (keyframe,), prepared.view, by)
        hits.append(np.asarray(state.measurement.hits))
    small, large = hits
    np.testing.assert_allclose(large.sum(), 4 * small.sum(), rtol=0.01)
    assert ((large > 0) >= (small > 0)).mean() > 0.999


def test_two_runs_of_two_mappers_are_the_same(build, run):
    again = follow(build(), SHOTS)
    assert_same(again[0][-1], run[0][-1])
    for a, b in zip(again[1], run[1], strict=True):
        assert (a.status, a.reason) == (b.status, b.reason)


def test_a_keyframe_costs_a_fixed_amount_of_memory(run):
    def size(tree):
        return sum(np.asarray(x).nbytes for x in jax.tree.leaves(tree))

    keyframes = run[0][-1].keyframes
    assert len({size(one) for one in keyframes}) == 1
    sizes = [size(state) - size(state.keyframes) for state in run[0][1:]]
    assert len(set(sizes)) == 1  # all else does not grow


# ------------------------------------------------------------------ frames that are no good

GARBAGE = {
    "black": np.zeros(ROOMS[0].depth.shape),
    "saturated": np.full(ROOMS[0].depth.shape, np.inf),
    "noise": np.random.default_rng(0).uniform(0.3, 5, ROOMS[0].depth.shape),
    "one wall": np.full(ROOMS[0].depth.shape, 0.6),
}


@pytest.mark.parametrize("name", GARBAGE)
def test_a_frame_of_garbage_is_lost_and_changes_nothing(mapper, run, name):
    state = run[0][2]
    after, step = mapper.step(state, shot(GARBAGE[name]))
    assert step.status == "lost" and step.reason and step.T_world_camera is None
    assert_same(after._replace(T_before_last=state.T_before_last), state)
    # The next frame is found from where the last one was.
    found, step = mapper.step(after, SHOTS[3])
    assert step.status == "keyframe"
    assert registration.displacement(found.T_world_camera, POSES[3])[0] < 0.015


def test_after_a_gap_the_camera_is_found_again(mapper, run):
    far = seen_from(52, seed=9)
    state, step = mapper.step(run[0][2], shot(far.depth))  # 40 degrees on
    assert step.status == "keyframe"
    truth = as_pose(far.T_world_camera)
    metres, degrees = registration.displacement(state.T_world_camera, truth)
    assert metres < 0.03 and degrees < 0.5


# ------------------------------------------------------------------ poses and boxes


def test_given_poses_are_kept_as_they_are(mapper):
    states, steps = follow(mapper, SHOTS, POSES, poses_are_given=True)
    assert [step.status for step in steps] == ["tracked", "keyframe", "keyframe", "keyframe"]
    assert all(step.alignment is None and "realign" not in step.seconds for step in steps)
    for keyframe, i in zip(states[-1].keyframes, (0, 2, 3, 4), strict=True):
        assert_same(keyframe.T_world_camera, POSES[i])
    finished, _ = mapper.finish(states[-1])
    assert_same(finished.keyframes, states[-1].keyframes)


def test_the_same_box_again_keeps_what_was_measured(mapper, run):
    state = run[0][-1]
    same, _ = mapper.moved(state, BOX)
    for grid_of in (fusion.occupied, fusion.occluded):  # cut out from where the cameras are now
        a, b = (np.asarray(grid_of(one.measurement)) for one in (state, same))
        assert (a != b).sum() <= 5 and a.sum() > 100
    assert_same([k.T_world_camera for k in same.keyframes],
                [k.T_world_camera for k in state.keyframes])  # fmt: skip


def test_a_box_two_voxels_further_on_shifts_the_grids(mapper, run):
    state = run[0][-1]
    voxel = np.asarray(state.place.frame.voxel_size, np.float64)
    T = T_WORLD_OBJECT.copy()
    T[0, 3] += 2 * voxel[0]
    moved, _ = mapper.moved(state, BOX._replace(T_world_object=T), room=0.5)
    wide, _ = mapper.moved(state, BOX, room=0.5)  # the same pixels, but for the rims
    a, b = (np.asarray(fusion.occupied(one.measurement)) for one in (wide, moved))
    same = a[6:-6] == b[4:-8]
    assert a[6:-6].sum() > 100 and same.mean() > 0.999


def test_cells_are_half_a_voxel_wide():
    turn = np.eye(4)
    turn[:3, :3] = jaxlie.SO3.from_y_radians(0.7).as_matrix()
    turn[:3, 3] = 3, 1, -2
    place = place_of(Box(turn, np.array([0.5, 0.9, 0.6])), 32, room=0.2)
    p = np.random.default_rng(0).uniform(-0.2, 0.2, (200, 3))
    voxel = np.asarray(grid.voxel_from_object(place.frame, jnp.float32(p)))
    cell = np.asarray(surfels.cell_of(place.lattice, jnp.float32(p @ turn[:3, :3].T + turn[:3, 3])))
    expected = np.ravel_multi_index(tuple(np.floor(2 * voxel).astype(int).T), (64,) * 3)
    assert (cell == expected).mean() > 0.99  # but for rounding
    np.testing.assert_allclose(place.cut.size, 1.2 * place.box.size)
