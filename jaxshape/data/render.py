"""The virtual depth camera of the paper (section 2.3), and what a real one adds to it. [host]

Each pixel casts one ray through its centre; the first triangle it meets hides all others, and the
depth is that of the ray's intersection with the plane of that triangle.
"""

from typing import NamedTuple

import jaxlie
import numpy as np
import trimesh
from jaxtyping import Float

from jaxshape.geometry import camera
from jaxshape.geometry.camera import Intrinsics

IMAGE_SIZE = 96
"""Pixels along each side of the virtual camera's square images."""

DISTANCE = 1.5
"""How far the camera stands from the object's centre, in diagonals of its bounding box."""


class SensorNoise(NamedTuple):
    """The faults of a structured-light sensor such as the first Kinect.

    Standard deviations grow with depth as Khoshelham and Elberink (Sensors, 2012) and Nguyen, Izadi
    and Lovell (3DIMPVT, 2012) measured; depths come in steps that grow with its square.
    """

    axial: float = 1.4e-3
    """Standard deviation along the ray, in metres at 1 m; grows with the square of depth."""
    lateral: float = 0.3
    """Standard deviation across the image, in pixels (0.8 of the Kinect's, which are smaller)."""
    quantization: float = 2.8e-3
    """Step of the measured depth, in metres at 1 m; grows with the square of depth."""
    dropout: float = 0.3
    """Probability that a pixel at a depth edge is lost."""
    grazing: float = 80.0
    """Surfaces seen at more than this angle, in degrees, from their normal are lost."""


def fit_intrinsics(
    mesh: trimesh.Trimesh, T_object_camera: jaxlie.SE3, image_size: int = IMAGE_SIZE
) -> Intrinsics:
    """The longest lens with which every view sees the mesh's whole bounding box."""
    T_camera_object = np.asarray(T_object_camera.inverse().as_matrix(), np.float64)
    corners = trimesh.bounds.corners(mesh.bounds)
    seen = corners @ T_camera_object[:, :3, :3].swapaxes(1, 2) + T_camera_object[:, None, :3, 3]
    x, y, z = np.moveaxis(seen, -1, 0)
    focal = (image_size / 2 - 1) / max(np.abs(x / z).max(), np.abs(y / z).max())
    return Intrinsics(*np.float32([focal, focal, image_size / 2, image_size / 2]))


def render_depth(
    mesh: trimesh.Trimesh,
    T_object_camera: jaxlie.SE3,
    intrinsics: Intrinsics,
    image_size: int = IMAGE_SIZE,
) -> tuple[Float[np.ndarray, "views h w"], Float[np.ndarray, "views h w"]]:
    """Depth images of a mesh, in metres, and the cosine at which each pixel meets its surface.

    Depth is infinite where the ray meets nothing; the cosine is 1 there. `T_object_camera` holds
    one pose per view. True visibility: among all triangles on a ray the nearest counts.
    """
    pixels = camera.unproject(intrinsics, np.ones((image_size, image_size), np.float32))
    rays = np.asarray(pixels).reshape(-1, 3)  # z is 1, so the ray parameter is the depth
    poses = np.asarray(T_object_camera.as_matrix())
    directions = (rays @ poses[:, :3, :3].swapaxes(1, 2)).reshape(-1, 3)
    origins = np.repeat(poses[:, :3, 3], len(rays), axis=0)

    triangle = mesh.ray.intersects_first(origins, directions)
    (hit,) = np.nonzero(triangle >= 0)
    normal = mesh.face_normals[triangle[hit]]
    to_plane = mesh.triangles[triangle[hit], 0] - origins[hit]
    facing = np.sum(normal * directions[hit], axis=1)
    facing = np.where(np.abs(facing) > 1e-9, facing, np.nan)  # the ray lies in the plane

    depth = np.full(len(origins), np.inf, np.float32)
    cosine = np.ones(len(origins), np.float32)
    depth[hit] = np.nan_to_num(np.sum(normal * to_plane, axis=1) / facing, nan=np.inf)
    cosine[hit] = np.nan_to_num(np.abs(facing)) / np.linalg.norm(directions[hit], axis=1)
    shape = (-1, image_size, image_size)
    return depth.reshape(shape), cosine.reshape(shape)


def add_sensor_noise(
    depth: Float[np.ndarray, "views h w"],
    cosine: Float[np.ndarray, "views h w"],
    rng: np.random.Generator,
    noise: SensorNoise = SensorNoise(),
) -> Float[np.ndarray, "views h w"]:
    """What a real sensor would have reported; lost pixels become 0, nothing known."""
    rows, columns = np.indices(depth.shape[1:])
    jitter = np.rint(rng.normal(0, noise.lateral, (2, *depth.shape))).astype(int)
    rows = np.clip(rows + jitter[0], 0, depth.shape[1] - 1)
    columns = np.clip(columns + jitter[1], 0, depth.shape[2] - 1)
    edge = _is_edge(depth)
    # Only edges show the jitter across the image; elsewhere it would act as axial noise.
    views = np.arange(len(depth))[:, None, None]
    noisy = np.where(edge, depth[views, rows, columns], depth)

    seen = np.isfinite(noisy)
    z = np.where(seen, noisy, 1.0)
    z = z + rng.normal(0, 1, z.shape) * noise.axial * z**2
    step = noise.quantization * z**2
    z = np.rint(z / step) * step

    lost = edge & (rng.random(depth.shape) < noise.dropout)
    lost |= seen & (cosine < np.cos(np.deg2rad(noise.grazing)))
    return np.where(lost, 0.0, np.where(seen, z, np.inf)).astype(np.float32)


def _is_edge(depth: Float[np.ndarray, "views h w"]) -> np.ndarray:
    """True where a neighbour's depth differs by more than 5 %, or is of the background."""
    inverse = 1 / depth
    edge = np.zeros(depth.shape, bool)
    for axis in (1, 2):
        ahead = np.abs(np.diff(inverse, axis=axis)) > 0.05 * inverse.max(axis=(1, 2), keepdims=True)
        before, after = [(0, 0)] * 3, [(0, 0)] * 3
        before[axis], after[axis] = (1, 0), (0, 1)
        edge |= np.pad(ahead, before) | np.pad(ahead, after)
    return edge
