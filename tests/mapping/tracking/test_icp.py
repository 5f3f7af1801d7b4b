import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from analytic_room import CHAIR, CRATE, FLOOR, TABLE, WALLS, room
from analytic_room import K as ROOM_K
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from jaxshape.geometry.camera import Intrinsics
from jaxshape.mapping.tracking import icp
from jaxshape.mapping.tracking.icp import Cloud, Matches
from jaxshape.mapping.tracking.views import DepthView, view_of

SIGMA = 0.002
"""Standard deviation, in metres, claimed for all points here."""

LENS = Intrinsics(*jnp.float32([ROOM_K[0, 0], ROOM_K[1, 1], ROOM_K[0, 2], ROOM_K[1, 2]]))


class Planes:
    """Points of a box corner, 2 m away, each of which is matched with the plane it was taken from;
    so the answer is a least-squares problem that NumPy and SciPy can solve."""

    def __init__(self, faces=(0, 1, 2), count=300, seed=0):
        rng = np.random.default_rng(seed)
        self.points = rng.uniform(-0.3, 0.3, (count, 3))
        face = np.resize(faces, count)
        self.points[np.arange(count), face] = 0.3
        turn = Rotation.from_rotvec([0.5, 0.6, 0.2]).as_matrix()
        self.points = self.points @ turn.T + [0.1, -0.2, 2.0]
        self.normals = np.eye(3)[face] @ turn.T

    def moved(self, T):
        """The cloud that lies on the planes once it is moved by T."""
        R = T[:3, :3]
        points, normals = (self.points - T[:3, 3]) @ R, self.normals @ R
        deviation = np.full(len(points), SIGMA)
        return Cloud(*(jnp.float32(x) for x in (points, normals, deviation)))

    def match(self, points, normals, distance):
        del points, normals, distance
        q, n = jnp.float32(self.points), jnp.float32(self.normals)
        return Matches(q, n, jnp.zeros(len(q)), jnp.ones(len(q), bool))

    def cost(self, cloud, motion, center, tolerance):
        """Tukey's robust cost after a small motion: translation, and rotation about a point."""
        p = np.asarray(cloud.points, np.float64)
        moved = (p - center) @ Rotation.from_rotvec(motion[3:]).as_matrix().T + center + motion[:3]
        variance = SIGMA**2 + tolerance**2
        residual = np.sum((moved - self.points) * self.normals, axis=1)
        share = np.minimum(residual**2 / variance / icp.CUTOFF**2, 1)
        return np.sum(icp.CUTOFF**2 / 6 * (1 - (1 - share) ** 3))


def motion(seed, degrees=8.0, metres=0.05):
    """A rigid motion that turns about a random axis, as a matrix."""
    rng = np.random.default_rng(seed)
    axis, shift = rng.normal(size=(2, 3))
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(np.deg2rad(degrees) * axis / np.linalg.norm(axis)).as_matrix()
    T[:3, 3] = metres * shift / np.linalg.norm(shift)
    return T


def as_pose(T):
    return jaxlie.SE3.from_matrix(jnp.float32(T))


def error(T, expected):
    """Metres and degrees between a pose and a matrix."""
    difference = np.linalg.inv(expected) @ np.asarray(T.as_matrix(), np.float64)
    angle = np.linalg.norm(Rotation.from_matrix(difference[:3, :3]).as_rotvec())
    return float(np.linalg.norm(difference[:3, 3])), float(np.degrees(angle))


def aligner(match, **settings):
    settings = {"distance": 0.3, "tolerance": 0.0, "iterations": 40} | settings
    return jax.jit(lambda cloud, T: icp.align(cloud, match, T, **settings))


CORNER, ONE_PLANE = Planes(), Planes(faces=(0,))
ROUGH = 0.05  # metres: a tolerance that includes the first residuals
align_corner = aligner(CORNER.match)
align_corner_roughly = aligner(CORNER.match, tolerance=ROUGH)

# ------------------------------------------------------------------ the motion is found


def cobbles(count=500):
    """Oriented points all over a bumpy closed surface, whose shape no motion leaves as it is."""
    golden = np.arange(count) * np.pi * (3 - np.sqrt(5))
    z = 1 - (2 * np.arange(count) + 1) / count
    around = np.sqrt(1 - z**2)
    p = np.stack([around * np.cos(golden), around * np.sin(golden), z], axis=1) * (0.3, 0.45, 0.25)
    normals = p / np.square((0.3, 0.45, 0.25))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return p + 0.03 * (p[:, 1:2] > 0.2) + (0, 0, 2.0), normals


def match_nearest(reference, reference_normals):
    q, q_normals = jnp.float32(reference), jnp.float32(reference_normals)

    def match(points, normals, distance):
        squared = jnp.sum((points[:, None] - q) ** 2, axis=-1)
        nearest = jnp.argmin(squared, axis=1)
        n = q_normals[nearest]
        fits = (squared.min(axis=1) < distance**2) & (jnp.sum(n * normals, axis=1) > icp.AGREEING)
        return Matches(q[nearest], n, jnp.where(fits, SIGMA, jnp.inf), fits)

    return match


def test_a_cloud_finds_back_from_random_motions_and_from_their_inverses():
    points, normals = cobbles()
    align = jax.jit(jax.vmap(lambda cloud: icp.align(
        cloud, match_nearest(points, normals), jaxlie.SE3.identity(), distance=0.2, tolerance=0.03,
        iterations=60,
    )))  # fmt: skip
    motions = [motion(seed) for seed in range(6)]
    motions += [np.linalg.inv(T) for T in motions]

    def cloud(T):  # which T brings back
        R = T[:3, :3]
        moved = ((points - (0, 0, 2)) - T[:3, 3]) @ R + (0, 0, 2), normals @ R
        return Cloud(*map(jnp.float32, (*moved, np.full(len(points), SIGMA))))

    found = align(jax.tree.map(lambda *x: jnp.stack(x), *map(cloud, motions)))
    for i, T in enumerate(motions):
        expected = np.eye(4)  # about the middle of the cloud, 2 m away
        expected[:3, :3] = T[:3, :3]
        expected[:3, 3] = T[:3, 3] + (0, 0, 2) - T[:3, :3] @ (0, 0, 2)
        metres, degrees = error(jaxlie.SE3(found.T_reference_source.wxyz_xyz[i]), expected)
        assert metres < 1e-3 and degrees < 0.03
        assert found.converged[i] and found.inlier_fraction[i] > 0.99 and found.rmse[i] < 1e-4


def two_rooms():
    """A room seen from two places, 20 cm and 6 degrees apart."""
    eyes = (0.9, 1.4, 1.8), (0.7, 1.4, 1.9)
    furniture = [FLOOR, WALLS, CHAIR, TABLE, CRATE]
    rooms = [room(furniture, eye, seed=i) for i, eye in enumerate(eyes)]
    return rooms, [jax.jit(view_of)(one.depth, LENS) for one in rooms]


def test_one_frame_finds_the_pose_of_another_and_the_reverse():
    rooms, views = two_rooms()
    expected = np.linalg.inv(rooms[0].T_world_camera) @ rooms[1].T_world_camera
    for reference, moving, truth in (
        (*views, expected), (*views[::-1], np.linalg.inv(expected))
    ):  # fmt: skip
        found = align_views(reference, moving)
        metres, degrees = error(found.T_reference_source, truth)
        assert metres < 0.002 and degrees < 0.05
        assert found.converged and found.inlier_fraction > 0.9 and found.overlap > 0.7
        assert found.rmse < 0.012  # noise of 1.4 mm at 1 m; the floor's end is 4 m away


@jax.jit
def align_views(reference: DepthView, moving: DepthView):
    match = icp.match_view(reference, jaxlie.SE3.identity())
    cloud = icp.cloud_of(moving, stride=2)
    start = jaxlie.SE3.identity()
    for tolerance in (0.03, 0.0):
        found = icp.align(cloud, match, start, distance=0.2, tolerance=tolerance, iterations=40)
        start = found.T_reference_source
    return found


# ------------------------------------------------------------------ the equations


def test_a_step_is_that_of_least_squares():
    """Against NumPy's in double precision; a wide tolerance makes all weights nearly one."""
    cloud = CORNER.moved(motion(3, degrees=0.5, metres=0.004))
    p = np.asarray(cloud.points, np.float64)
    center = p.mean(axis=0)
    J = np.concatenate([CORNER.normals, np.cross(p - center, CORNER.normals)], axis=1)
    residual = np.sum((p - CORNER.points) * CORNER.normals, axis=1)
    variance = SIGMA**2 + ROUGH**2
    root = (1 - residual**2 / variance / icp.CUTOFF**2) / np.sqrt(variance)  # of Tukey's weight
    step = np.linalg.lstsq(root[:, None] * J, -root * residual, rcond=None)[0]
    expected = np.eye(4)
    expected[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix()
    expected[:3, 3] = step[:3] + center - expected[:3, :3] @ center
    one_step = aligner(CORNER.match, tolerance=ROUGH, iterations=1)
    found = one_step(cloud, jaxlie.SE3.identity())
    assert int(found.iterations) == 1
    metres, degrees = error(found.T_reference_source, expected)
    assert metres < 2e-5 and degrees < 5e-4  # of a step of 4 mm and 0.5 degrees


def with_strays(cloud, share=0.3, by=0.08):
    """Some of the points moved all together, as what an occluder shows."""
    count = int(share * len(cloud.points))
    return cloud._replace(points=cloud.points.at[:count].add(jnp.array([by, by, -by])))


def test_the_robust_cost_is_least_at_the_solution():
    """Against SciPy's minimiser of the cost, written out, from the same first guess."""
    rng = np.random.default_rng(4)
    cloud = with_strays(CORNER.moved(motion(4, degrees=1.0, metres=0.01)))
    cloud = cloud._replace(points=cloud.points + SIGMA * rng.normal(size=cloud.points.shape))
    found = align_corner_roughly(cloud, jaxlie.SE3.identity())
    center = np.asarray(cloud.points, np.float64).mean(axis=0)

    def cost(x):  # in mm and mrad
        return CORNER.cost(cloud, 1e-3 * x, center, ROUGH)

    best = 1e-3 * minimize(cost, np.zeros(6), method="BFGS", options={"gtol": 1e-7}).x
    expected = np.eye(4)
    expected[:3, :3] = Rotation.from_rotvec(best[3:]).as_matrix()
    expected[:3, 3] = best[:3] + center - expected[:3, :3] @ center
    metres, degrees = error(found.T_reference_source, expected)
    assert metres < 2e-4 and degrees < 0.01
    assert found.converged


def test_the_information_is_the_curvature_of_the_cost():
    T = motion(5, degrees=3.0, metres=0.02)
    cloud = CORNER.moved(T)
    found = align_corner_roughly(cloud, as_pose(T))
    on_planes = cloud._replace(points=CORNER.points)
    h = 1e-4
    steps = h * np.eye(6)

    def cost(x):
        return CORNER.cost(on_planes, x, np.zeros(3), ROUGH)

    expected = np.array([[
        (cost(a + b) - cost(a - b) - cost(b - a) + cost(-a - b)) / (4 * h**2) for b in steps
    ] for a in steps])  # fmt: skip
    np.testing.assert_allclose(found.information, expected, rtol=2e-3, atol=2e-4 * expected.max())


# ------------------------------------------------------------------ what is free, what is wrong


def test_a_plane_leaves_three_motions_free_and_they_stay_as_they_are():
    normal = ONE_PLANE.normals[0]
    T = np.eye(4)
    T[:3, 3] = 0.02 * normal
    cloud = ONE_PLANE.moved(T)
    along = np.cross(normal, [0, 1, 0])
    start = np.eye(4)
    start[:3, 3] = 0.05 * along / np.linalg.norm(along)
    found = aligner(ONE_PLANE.match, tolerance=0.02)(cloud, as_pose(start))
    assert found.conditioning < 1e-5 and found.converged
    shift = np.asarray(found.T_reference_source.translation()) - start[:3, 3]
    np.testing.assert_allclose(shift, 0.02 * normal, atol=1e-4)
    assert error(found.T_reference_source, T + start - np.eye(4))[1] < 0.01
    assert align_corner(CORNER.moved(np.eye(4)), jaxlie.SE3.identity()).conditioning > 0.02


def test_a_third_of_the_points_on_something_that_moves_is_ignored():
    T = motion(6, degrees=1.0, metres=0.004)
    still = CORNER.moved(T)
    found = align_corner(with_strays(still), align_corner_roughly(still, as_pose(np.eye(4)))[0])
    metres, degrees = error(found.T_reference_source, T)
    assert metres < 1e-4 and degrees < 0.005
    assert found.inlier_fraction == pytest.approx(0.7, abs=0.01)


@pytest.mark.parametrize("missing", ["points", "matches"])
def test_nothing_to_align_is_a_result_and_not_a_number_less(missing):
    cloud, match = CORNER.moved(np.eye(4)), CORNER.match
    if missing == "points":
        cloud = Cloud(*(0 * x for x in cloud[:2]), jnp.full(len(cloud.points), jnp.inf))
    else:
        nothing = Matches(
            *(0 * x for x in cloud[:2]), *(jnp.full(300, x) for x in (jnp.inf, False))
        )
        match = lambda *_: nothing  # noqa: E731
    start = as_pose(motion(7))
    found = aligner(match)(cloud, start)
    assert not found.converged and found.inlier_fraction == 0 and found.conditioning == 0
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(found))
    np.testing.assert_allclose(found.T_reference_source.as_matrix(), start.as_matrix(), atol=1e-6)


def test_many_guesses_at_once_are_each_as_one_by_one():
    cloud = CORNER.moved(motion(8, degrees=2, metres=0.01))
    starts = [as_pose(motion(seed, degrees=1, metres=0.01)) for seed in range(3)]
    starts.append(as_pose(motion(0, degrees=170)))  # hopeless
    together = jax.jit(jax.vmap(lambda T: align_corner_roughly(cloud, T)))(
        jaxlie.SE3(jnp.stack([T.wxyz_xyz for T in starts]))
    )
    for i, T in enumerate(starts):
        alone = align_corner_roughly(cloud, T)
        for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(a[i], b, rtol=1e-3, atol=1e-4 * max(1, np.abs(b).max()))


# ------------------------------------------------------------------ clouds and matches of views


def test_a_cloud_holds_every_so_many_pixels_of_those_segmented():
    view = jax.jit(view_of)(room([FLOOR, CHAIR]).depth, LENS)
    segmented = np.zeros(view.depth.shape, bool)
    segmented[30:90, 40:] = True
    cloud = icp.cloud_of(view, jnp.asarray(segmented), stride=3)
    known = segmented & np.asarray(icp.is_oriented(view))
    kept = known[1::3, 1::3].ravel()
    np.testing.assert_array_equal(np.isfinite(cloud.deviation), kept)
    np.testing.assert_array_equal(cloud.points[kept], view.points[1::3, 1::3].reshape(-1, 3)[kept])


def test_points_match_what_a_view_shows_at_their_pixel():
    """Against a loop; the view has gaps and rays that met nothing, and is not at the origin."""
    rng = np.random.default_rng(0)
    depth = room([FLOOR, CHAIR], noise=0.0).depth
    depth[rng.random(depth.shape) < 0.1] = 0
    view, T = jax.jit(view_of)(depth, LENS), motion(9, degrees=20, metres=0.5)
    pixel = rng.uniform((-20, -20), (180, 140), (800, 2))
    column, row = np.clip(pixel.astype(int), 0, [[159, 119]]).T
    shown = np.where(np.isfinite(depth[row, column]), depth[row, column], 2)
    z = shown * rng.choice([0.99, 1.0, 1.01, 1.3, -1.0], 800)
    p = np.concatenate([pixel, np.ones((800, 1))], axis=1) @ np.linalg.inv(ROOM_K).T * z[:, None]
    normals = np.asarray(view.normals)[row, column] + 0.5 * rng.normal(size=(800, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    world = [jnp.float32(x) for x in (p @ T[:3, :3].T + T[:3, 3], normals @ T[:3, :3].T)]
    found = jax.jit(lambda *x: icp.match_view(view, as_pose(T))(*x, 0.05))(*world)
    matched = 0
    for i in range(800):
        column, row = np.floor(pixel[i]).astype(int)
        if z[i] <= 0 or not (0 <= column < 160 and 0 <= row < 120):
            assert np.isinf(found.deviation[i]) and not found.in_reach[i]
            continue
        q, n = (np.asarray(x)[row, column] for x in (view.points, view.normals))
        is_near = np.linalg.norm(p[i] - q) < 0.05 and n @ normals[i] > icp.AGREEING
        assert np.isfinite(found.deviation[i]) == is_near
        seen = depth[row, column]
        assert found.in_reach[i] == (seen > 0 and z[i] < seen + 0.05)
        if is_near:
            matched += 1
            np.testing.assert_allclose(found.points[i], q @ T[:3, :3].T + T[:3, 3], atol=1e-5)
            np.testing.assert_allclose(found.normals[i], n @ T[:3, :3].T, atol=1e-5)
    assert 50 < matched < 400


def test_several_references_agree_on_one_pose_and_count_each_point_once():
    cloud = CORNER.moved(motion(10, degrees=1, metres=0.005))
    both = aligner(icp.match_all(CORNER.match, CORNER.match), tolerance=ROUGH)
    one, two = (
        align_corner_roughly(cloud, jaxlie.SE3.identity()),
        both(cloud, jaxlie.SE3.identity()),
    )
    for name in ("inlier_fraction", "overlap", "rmse", "conditioning"):
        np.testing.assert_allclose(getattr(one, name), getattr(two, name), rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(2 * one.information, two.information, rtol=1e-3, atol=1.0)


# ------------------------------------------------------------------ another implementation


def test_small_gicp_finds_the_same_pose():
    small_gicp = pytest.importorskip("small_gicp")
    _, views = two_rooms()
    target, source = (np.float64(v.points[np.asarray(icp.is_oriented(v))]) for v in views)
    settings = {"registration_type": "GICP", "max_correspondence_distance": 0.2}
    theirs = small_gicp.align(target, source, downsampling_resolution=0.03, **settings)
    metres, degrees = error(align_views(*views).T_reference_source, theirs.T_target_source)
    assert metres < 0.005 and degrees < 0.1
