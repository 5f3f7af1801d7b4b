"""One object seen by the virtual camera: depth frames, measurements, ground truth. [host]"""

import math
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import trimesh
from jaxtyping import Array, Bool, Float

from jaxshape.data import meshes, render
from jaxshape.data.virtual_cameras import CAMERAS, VirtualCamera
from jaxshape.geometry import distance, fusion, grid
from jaxshape.geometry.camera import Intrinsics
from jaxshape.geometry.distance import DistanceField
from jaxshape.geometry.fusion import Measurement
from jaxshape.geometry.grid import GridFrame
from jaxshape.geometry.pixels import Sensor

SURFACE_SAMPLES = 50_000
"""Points sampled on a CAD model to find its surface voxels: some 15 for each of them."""

PAPER = CAMERAS["paper"]

GRID_MARGIN = grid.RESOLUTION / (grid.RESOLUTION - 2 * grid.MARGIN) - 1
"""By how much the object's grid is larger than the object, as a share of its size."""


class Capture(NamedTuple):
    """An object, and depth frames of it."""

    depth: Float[Array | np.ndarray, "views h w"]
    """Metres; 0 where nothing is known, infinite where the ray met nothing."""
    intrinsics: Intrinsics
    T_object_camera: jaxlie.SE3
    frame: GridFrame
    surface: Bool[Array | np.ndarray, "x y z"]
    """Voxels that hold a point of the CAD model's surface: the ground truth **Y**."""


def capture(
    mesh: trimesh.Trimesh,
    T_object_camera: jaxlie.SE3,
    *,
    noise: bool,
    seed: int,
    camera: VirtualCamera = PAPER,
) -> Capture:
    """Look at a canonical mesh from some poses, and find its surface voxels.

    The ground truth comes straight from points on the CAD model, not through the depth frames, so
    that it is complete (paper, section 2.3).

    Args:
        mesh: In the object frame, centred, metres.
        T_object_camera: One pose per view; `camera_distance` says how far away the camera stands.
        noise: Whether the images have the faults of the camera's sensor.
        seed: Of the noise, and of the points on the surface.
        camera: Of its images, the window that can show the object's grid is kept.

    Returns:
        The depth images, and the grid's frame and true surface voxels.
    """
    intrinsics, size = render.window(camera, mesh, T_object_camera, GRID_MARGIN)
    depth, cosine = render.render_depth(mesh, T_object_camera, intrinsics, size)
    if noise:
        rng = np.random.default_rng(seed)
        depth = render.add_sensor_noise(depth, cosine, rng, camera.noise)
    frame = grid.fit_box(*jnp.float32(mesh.bounds))
    points = meshes.sample_surface(mesh, SURFACE_SAMPLES, seed).astype(np.float32)
    return Capture(depth, intrinsics, T_object_camera, frame, discretize(points, frame))


def camera_distance(mesh: trimesh.Trimesh, camera: VirtualCamera = PAPER) -> float:
    """How far from the object's centre the virtual camera stands, in metres."""
    return camera.distance * float(mesh.scale)


@jax.jit
def discretize(points: Float[Array, "n 3"], frame: GridFrame) -> Bool[Array, "x y z"]:
    """Surface voxels of object-frame points: `D(P)` of the paper."""
    return fusion.count_points(grid.voxel_from_object(frame, points)) > 0


@jax.jit
def measure_frames(captured: Capture) -> Measurement:
    """One measurement per frame; every pixel that hit something shows the object."""
    depth = jnp.asarray(captured.depth)
    measure = partial(fusion.measure, intrinsics=captured.intrinsics, frame=captured.frame)
    one = lambda depth, T: measure(depth, jnp.isfinite(depth), T_object_camera=T)  # noqa: E731
    return jax.vmap(one)(depth, captured.T_object_camera)


def sensor_of(camera: VirtualCamera) -> Sensor:
    """How well a camera measures depth: its noise, and the steps in which depths come."""
    step = camera.noise.quantization / math.sqrt(12)  # the deviation of a uniform distribution
    return Sensor(axial=math.hypot(camera.noise.axial, step))


def fuse_frames(
    captured: Capture, frames: tuple[int, ...], sensor: Sensor = Sensor()
) -> DistanceField:
    """Signed distances fused from the first k frames, for each k of an increasing tuple.

    Frames are added one at a time, so that one field at a time is in memory, besides those asked
    for; every pixel that hit something shows the object.
    """

    def add(field: DistanceField, frame: tuple[Array, jaxlie.SE3]) -> tuple[DistanceField, None]:
        depth, T = frame
        seen = jnp.isfinite(depth)
        one = distance.measure(depth, seen, captured.intrinsics, T, captured.frame, sensor)
        return distance.merge(field, one), None

    all_frames = jnp.asarray(captured.depth), captured.T_object_camera
    field, found = distance.nothing_measured(), []
    for chosen in (slice(*ends) for ends in pairwise((0, *frames))):
        some = jax.tree.map(lambda x, chosen=chosen: x[chosen], all_frames)
        field, _ = jax.lax.scan(add, field, some)
        found.append(field)
    return jax.tree.map(lambda *x: jnp.stack(x), *found)
