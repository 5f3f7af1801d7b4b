"""Film one object with a virtual camera: depth frames, measurements, ground truth. [host]"""

import math
from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import trimesh
from jaxtyping import Array, Bool, Float

from jaxshape.data import meshes, render
from jaxshape.data.virtual_cameras import CAMERAS, VirtualCamera
from jaxshape.geometry import fusion, grid
from jaxshape.geometry.camera import Intrinsics
from jaxshape.geometry.distance import DistanceField
from jaxshape.geometry.fusing import Distances, Fusion, fuse_in_stages
from jaxshape.geometry.fusion import Measurement
from jaxshape.geometry.grid import GridFrame
from jaxshape.geometry.grids import Grids
from jaxshape.geometry.pixels import Sensor

SURFACE_SAMPLES = 50_000
"""Points sampled on a CAD model to find its surface voxels: about 15 for each voxel."""

PAPER = CAMERAS["paper"]

GRID_MARGIN = grid.RESOLUTION / (grid.RESOLUTION - 2 * grid.MARGIN) - 1
"""Margin of the object's grid around the object, as a share of the object's size."""


class Capture(NamedTuple):
    """Depth frames of an object from known poses, and its true surface.

    Attributes:
        depth: Depth images `[views h w]`, in metres; 0 for missing depth, infinite where the ray
            hit nothing.
        intrinsics: The camera of all frames.
        T_object_camera: Pose of each frame in the object frame `[views]`.
        frame: Voxel frame of the object's grids.
        surface: True in voxels that hold a point of the CAD model's surface `[x y z]`: the ground
            truth **Y**.
    """

    depth: Float[Array | np.ndarray, "views h w"]
    intrinsics: Intrinsics
    T_object_camera: jaxlie.SE3
    frame: GridFrame
    surface: Bool[Array | np.ndarray, "x y z"]


def capture(
    mesh: trimesh.Trimesh,
    T_object_camera: jaxlie.SE3,
    *,
    noise: bool,
    seed: int,
    camera: VirtualCamera = PAPER,
    resolution: int = grid.RESOLUTION,
) -> Capture:
    """Film a mesh from given poses, and find its surface voxels (paper, section 2.3). [host]

    The ground truth is computed from points on the CAD model, not from the depth frames, so that it
    is complete.

    Args:
        mesh: A mesh in the canonical object frame: +y up, front along +z, box centred at the
            origin, in metres.
        T_object_camera: Poses of the camera `[views]`, usually at the distance `camera_distance`.
        noise: Whether the images have the faults of the camera's sensor.
        seed: Seed of the noise and of the surface samples, 0 or more.
        camera: The depth camera. Only the window of its images that can show the object's grid is
            kept.
        resolution: Voxels along each axis of the object's grids.

    Returns:
        The depth images, the voxel frame and the true surface voxels.
    """
    intrinsics, size = render.window(camera, mesh, T_object_camera, GRID_MARGIN)
    depth, cosine = render.render_depth(mesh, T_object_camera, intrinsics, size)
    if noise:
        rng = np.random.default_rng(seed)
        depth = render.add_sensor_noise(depth, cosine, rng, camera.noise)
    frame = grid.fit_box(*jnp.float32(mesh.bounds), resolution=resolution)
    surface = true_surface(mesh, frame, seed, resolution)
    return Capture(depth, intrinsics, T_object_camera, frame, surface)


def true_surface(
    mesh: trimesh.Trimesh, frame: GridFrame, seed: int, resolution: int
) -> Bool[Array, "x y z"]:
    """Surface voxels of a CAD model: the ground truth **Y**.

    Args:
        mesh: The mesh, in the object frame.
        frame: Voxel frame of the grid.
        seed: Seed of the surface samples, 0 or more.
        resolution: Voxels along each axis of the grid.
    """
    points = meshes.sample_surface(mesh, SURFACE_SAMPLES, seed).astype(np.float32)
    return discretize(points, frame, resolution)


def camera_distance(mesh: trimesh.Trimesh, camera: VirtualCamera = PAPER) -> float:
    """Distance of a virtual camera from the object's centre, in metres.

    Args:
        mesh: The object, in metres.
        camera: The camera; the paper's by default.

    Returns:
        Metres.
    """
    return camera.distance * float(mesh.scale)


@partial(jax.jit, static_argnums=2)
def discretize(
    points: Float[Array, "n 3"], frame: GridFrame, resolution: int = grid.RESOLUTION
) -> Bool[Array, "x y z"]:
    """Surface voxels of object-frame points: `D(P)` of the paper."""
    return fusion.count_points(grid.voxel_from_object(frame, points), resolution) > 0


@jax.jit
def measure_frames(captured: Capture) -> Measurement:
    """Measure each frame of a capture alone; every pixel that hit something shows the object.

    Compiled by `jax.jit`.

    Args:
        captured: Depth frames of an object, from `capture`.

    Returns:
        One measurement for each frame `[views x y z]`; `merge_all` merges them.
    """
    depth = jnp.asarray(captured.depth)
    measure = partial(
        fusion.measure,
        intrinsics=captured.intrinsics,
        frame=captured.frame,
        resolution=captured.surface.shape[-1],
    )
    one = lambda depth, T: measure(depth, jnp.isfinite(depth), T_object_camera=T)  # noqa: E731
    return jax.vmap(one)(depth, captured.T_object_camera)


def sensor_of(camera: VirtualCamera) -> Sensor:
    """Depth noise of a camera, including its quantisation.

    Args:
        camera: The camera whose frames are fused.
    """
    step = camera.noise.quantization / math.sqrt(12)  # the deviation of a uniform distribution
    return Sensor(axial=math.hypot(camera.noise.axial, step))


@partial(jax.jit, static_argnames=("fusing", "numbers", "sensor"))
def fused_grids(
    captured: Capture, fusing: Fusion, numbers: tuple[int, ...], sensor: Sensor = Sensor()
) -> Grids:
    """F and M of the first k frames of a capture, for each k of an increasing tuple.

    Frames are added one at a time; every pixel that hit something shows the object. Compiled by
    `jax.jit`.

    Args:
        captured: Depth frames of an object, from `capture`.
        fusing: The fusion method.
        numbers: Increasing numbers of frames, 1 or more each.
        sensor: Noise of the camera (`sensor_of`); the first Kinect's by default.

    Returns:
        Grids `[len(numbers) x y z]`.
    """
    states = _stages(captured, fusing, numbers, sensor)
    return jax.tree.map(lambda *x: jnp.stack(x), *map(fusing.grids, states))


def _stages(
    captured: Capture, fusing: Fusion, numbers: tuple[int, ...], sensor: Sensor
) -> Iterator[Any]:
    """States of the first frames of a capture; every pixel that hit something shows the object."""
    depth, T = jnp.asarray(captured.depth), captured.T_object_camera
    seen, intrinsics = jnp.isfinite(depth), captured.intrinsics
    return fuse_in_stages(fusing, numbers, depth, seen, intrinsics, T, captured.frame, sensor)


@partial(jax.jit, static_argnames=("fusing", "sensor"))
def fused_frames(captured: Capture, fusing: Fusion, sensor: Sensor = Sensor()) -> tuple[Any, Grids]:
    """All frames of a capture as one state, and its F and M. Compiled by `jax.jit`.

    Args:
        captured: Depth frames of an object, from `capture`.
        fusing: The fusion method.
        sensor: Noise of the camera (`sensor_of`); the first Kinect's by default.
    """
    (state,) = _stages(captured, fusing, (len(captured.depth),), sensor)
    return state, fusing.grids(state)


def fuse_frames(
    captured: Capture, frames: tuple[int, ...], sensor: Sensor = Sensor()
) -> DistanceField:
    """Signed distances fused from the first k frames, for each k of an increasing tuple.

    Frames are added one at a time, so that memory holds one field and the returned ones; every
    pixel that hit something shows the object.

    Args:
        captured: Depth frames of an object, from `capture`.
        frames: Increasing numbers of frames, 1 or more each.
        sensor: Noise of the camera (`sensor_of`); the first Kinect's by default.

    Returns:
        One field for each number of frames `[len(frames) n n n]`.
    """
    fields = _stages(captured, Distances(captured.surface.shape[-1]), frames, sensor)
    return jax.tree.map(lambda *x: jnp.stack(x), *fields)
