import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from analytic_room import CHAIR, CRATE, FLOOR, TABLE, WALLS, K, room
from marks import slow
from scipy.spatial.transform import Rotation

from jaxshape.geometry.camera import intrinsics_of
from jaxshape.mapping.config import TrackingConfig
from jaxshape.mapping.tracking import icp, registration
from jaxshape.mapping.tracking.icp import Alignment
from jaxshape.mapping.tracking.views import view_of

LENS = intrinsics_of(K)
CENTER = np.array([0.0, 0.45, 0.0])
FURNITURE = (FLOOR, WALLS, CHAIR, TABLE, CRATE)

prepare = jax.jit(view_of)


@jax.jit
def register(view, segmented, reference, T):
    return registration.register(
        view, segmented, icp.match_view(reference, jaxlie.SE3.identity()), T
    )


@jax.jit
def register_from(view, segmented, reference, T):
    match = icp.match_view(reference, jaxlie.SE3.identity())
    return registration.register_from(view, segmented, match, T)


def seen_from(azimuth, groups=FURNITURE, *, seed):
    """The room from a place on a circle about the chair, in degrees."""
    angle = np.deg2rad(azimuth + 30)
    return room(groups, (2 * np.sin(angle), 1.4, 2 * np.cos(angle)), seed=seed)


FIRST = seen_from(0, seed=0)
REFERENCE = prepare(FIRST.depth, LENS)
ALL = jnp.ones(FIRST.depth.shape, bool)
STILL = jaxlie.SE3.identity()


def as_pose(T):
    return jaxlie.SE3.from_matrix(jnp.float32(T))


def relative(second):
    return as_pose(np.linalg.inv(FIRST.T_world_camera) @ second.T_world_camera)


# ------------------------------------------------------------------ registration


@pytest.mark.parametrize("azimuth", [slow(0.5), -10, 10, 20])
def test_steps_of_up_to_twenty_degrees_are_found(azimuth):
    second = seen_from(azimuth, seed=1)
    found = register(prepare(second.depth, LENS), ALL, REFERENCE, STILL)
    metres, degrees = registration.displacement(found.T_reference_source, relative(second))
    assert metres < 0.006 and degrees < 0.1
    assert found.converged and found.inlier_fraction > 0.8 and found.conditioning > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("azimuth", [45, -45])
def test_a_wide_step_needs_many_guesses(azimuth):
    second = seen_from(azimuth, seed=1)
    view, truth = prepare(second.depth, LENS), relative(second)
    alone = register(view, ALL, REFERENCE, STILL)
    assert registration.displacement(alone.T_reference_source, truth)[0] > 0.1
    center = jnp.float32(np.linalg.inv(FIRST.T_world_camera) @ [*CENTER, 1])[:3]
    found = register_from(view, ALL, REFERENCE, registration.guesses(STILL, center))
    metres, degrees = registration.displacement(found.T_reference_source, truth)
    assert metres < 0.01 and degrees < 0.15
    assert registration.score(found) > registration.score(alone)


@pytest.mark.parametrize("by", [0.3, 0.6])
def test_something_that_walks_through_the_picture_moves_the_pose_by_millimetres(by):
    walked = [((low[0] + by, *low[1:]), (high[0] + by, *high[1:])) for low, high in CRATE]
    second = seen_from(-5, (*FURNITURE[:-1], walked), seed=1)
    found = register(prepare(second.depth, LENS), ALL, REFERENCE, STILL)
    metres, degrees = registration.displacement(found.T_reference_source, relative(second))
    assert metres < 0.01 and degrees < 0.1


def test_only_the_segmented_pixels_count():
    """What else the frame shows does not matter, where the object turns before a still camera."""
    second = seen_from(5, seed=1)
    chair = jnp.asarray(second.label == FURNITURE.index(CHAIR))
    rng = np.random.default_rng(0)
    elsewhere = np.where(chair, second.depth, rng.uniform(0.5, 4, second.depth.shape))
    view = prepare(second.depth, LENS)
    other = view._replace(
        depth=jnp.float32(elsewhere),
        points=jnp.where(chair[..., None], view.points, 3 * view.points),
    )
    found = [register(one, chair, REFERENCE, STILL) for one in (view, other)]
    jax.tree.map(np.testing.assert_array_equal, *found)
    assert registration.displacement(found[0].T_reference_source, relative(second))[0] < 0.03


@pytest.mark.parametrize("content", ["unknown", "empty"])
def test_a_frame_that_shows_nothing_is_doubted(content):
    depth = np.full(FIRST.depth.shape, 0 if content == "unknown" else np.inf, np.float32)
    for search, T in (
        (register, STILL),
        (register_from, registration.guesses(STILL, CENTER_AHEAD)),
    ):
        found = search(prepare(depth, LENS), ALL, REFERENCE, T)
        assert not found.converged
        assert registration.doubt(found, STILL, TrackingConfig()) is not None
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(found))


CENTER_AHEAD = jnp.array([0.0, 0.0, 2.2])

# ------------------------------------------------------------------ guesses


def test_guesses_start_with_the_pose_itself_and_keep_their_distance():
    T = as_pose(FIRST.T_world_camera)
    many = registration.guesses(T, jnp.float32(CENTER), count=24, reach=40.0)
    np.testing.assert_allclose(many.wxyz_xyz[0], T.wxyz_xyz, atol=1e-6)
    offsets = np.asarray(many.translation()) - CENTER
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=1), np.linalg.norm(offsets[0]),
                               rtol=1e-5)  # fmt: skip
    # The point they turn about stays where it was in the picture.
    ahead = jax.vmap(lambda one: one.inverse() @ jnp.float32(CENTER))(many)
    np.testing.assert_allclose(ahead, np.broadcast_to(ahead[0], ahead.shape), atol=1e-5)
    turned = [registration.displacement(T, jaxlie.SE3(x))[1] for x in many.wxyz_xyz]
    assert 39.9 < max(turned) < 43 and len(turned) == 25


def test_displacement_is_that_of_the_relative_pose():
    rng = np.random.default_rng(0)
    for _ in range(10):
        A, B = np.eye(4), np.eye(4)
        for T in (A, B):
            T[:3, :3], T[:3, 3] = Rotation.random(random_state=rng).as_matrix(), rng.normal(size=3)
        metres, degrees = registration.displacement(as_pose(A), as_pose(B))
        D = np.linalg.inv(A) @ B
        assert metres == pytest.approx(np.linalg.norm(D[:3, 3]), rel=1e-4)
        angle = np.linalg.norm(Rotation.from_matrix(D[:3, :3]).as_rotvec())
        assert degrees == pytest.approx(np.degrees(angle), abs=0.05)


# ------------------------------------------------------------------ belief

GOOD = Alignment(
    T_reference_source=STILL,
    inlier_fraction=jnp.float32(0.9),
    overlap=jnp.float32(0.8),
    rmse=jnp.float32(0.002),
    information=jnp.eye(6),
    conditioning=jnp.float32(0.1),
    converged=jnp.bool_(True),
    iterations=jnp.int32(3),
)


@pytest.mark.parametrize(
    "change, reason",
    [
        ({}, None),
        ({"T_reference_source": jaxlie.SE3(jnp.full(7, jnp.nan))}, "no pose was found"),
        ({"overlap": jnp.float32(0.1)}, "only 10% of it is seen again"),
        ({"inlier_fraction": jnp.float32(0.4)}, "only 40% of what is seen again agrees"),
        (
            {"T_reference_source": jaxlie.SE3.from_translation(jnp.array([0.6, 0, 0]))},
            "the camera jumped by 0.60 m and 0 degrees",
        ),
        (
            {"T_reference_source": jaxlie.SE3.from_rotation(jaxlie.SO3.from_y_radians(1.0))},
            "the camera jumped by 0.00 m and 57 degrees",
        ),
    ],
)
def test_a_doubtful_pose_has_a_reason(change, reason):
    assert registration.doubt(GOOD._replace(**change), STILL, TrackingConfig()) == reason


def test_the_score_prefers_what_explains_more():
    worse = [{"overlap": jnp.float32(0.5)}, {"inlier_fraction": jnp.float32(0.7)}]
    for change in worse:
        assert registration.score(GOOD._replace(**change)) < registration.score(GOOD)
    # What should have been seen and was not counts against a pose.
    assert registration.score(GOOD._replace(inlier_fraction=jnp.float32(0.2))) < 0
