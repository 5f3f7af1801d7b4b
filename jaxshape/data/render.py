"""The virtual depth camera of the paper (section 2.3), and what a real one adds to it. [host]

Each pixel casts one ray through its centre; the first triangle it meets hides all others, and the
depth is that of the ray's intersection with the plane of that triangle.
"""

from dataclasses import dataclass

import jax.numpy as jnp
import jaxlie
import numpy as np
import trimesh
from jaxtyping import Bool, Float

from jaxshape import checks
from jaxshape.geometry import camera, sensor
from jaxshape.geometry.camera import Intrinsics

IMAGE_SIZE = 96
"""Pixels along each side of the virtual camera's square images."""

DISTANCE = 1.5
"""How far the camera stands from the object's centre, in diagonals of its bounding box."""


@dataclass(frozen=True)
class SensorNoise:
    """The faults of a structured-light sensor such as the first Kinect.

    Standard deviations and steps grow with the square of depth, see `jaxshape.geometry.sensor`.
    """

    axial: float = sensor.AXIAL
    """Standard deviation along the ray, in metres at 1 m; grows with the square of depth."""
    lateral: float = 0.3
    """Standard deviation across the image, in pixels (0.8 of the Kinect's, which are smaller)."""
    quantization: float = sensor.STEP
    """Step of the measured depth, in metres at 1 m; grows with the square of depth."""
    dropout: float = 0.3
    """Probability that a pixel at a depth edge is lost."""
    grazing: float = 80.0
    """Surfaces seen at more than this angle, in degrees, from their normal are lost."""

    def __post_init__(self) -> None:
        checks.at_least("axial", self.axial, 0)
        checks.at_least("lateral", self.lateral, 0)
        checks.positive("quantization", self.quantization, "metres")
        checks.within("dropout", self.dropout, 0, 1)
        checks.within("grazing", self.grazing, 0, 180)


def fit_intrinsics(
    mesh: trimesh.Trimesh, T_object_camera: jaxlie.SE3, image_size: int = IMAGE_SIZE
) -> Intrinsics:
    """The longest lens with which every view sees the mesh's whole bounding box."""
    corners = _corners(mesh, np.asarray(T_object_camera.as_matrix()))
    reach = np.abs(corners[..., :2] / corners[..., 2:]).max()
    focal = (image_size / 2 - 1) / reach
    center = image_size / 2
    return Intrinsics(*jnp.array([focal, focal, center, center], jnp.float32))


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
    pixels = camera.unproject(intrinsics, jnp.ones((image_size, image_size)))
    rays = np.asarray(pixels).reshape(-1, 3)  # z is 1, so the ray parameter is the depth
    poses = np.asarray(T_object_camera.as_matrix())
    view, pixel = np.nonzero(_may_hit(mesh, poses, rays))
    directions = (rays @ poses[:, :3, :3].swapaxes(1, 2))[view, pixel]
    origins = poses[view, :3, 3]

    triangle = mesh.ray.intersects_first(origins, directions)
    hit = triangle >= 0
    view, pixel, triangle, directions = view[hit], pixel[hit], triangle[hit], directions[hit]
    normal = mesh.face_normals[triangle]
    facing = np.sum(normal * directions, axis=1)
    facing = np.where(np.abs(facing) > 1e-9, facing, np.nan)  # the ray lies in the plane
    to_plane = np.sum(normal * (mesh.triangles[triangle, 0] - origins[hit]), axis=1)

    depth = np.full((len(poses), len(rays)), np.inf, np.float32)
    cosine = np.ones_like(depth)
    depth[view, pixel] = np.nan_to_num(to_plane / facing, nan=np.inf)
    cosine[view, pixel] = np.nan_to_num(np.abs(facing)) / np.linalg.norm(directions, axis=1)
    shape = (-1, image_size, image_size)
    return depth.reshape(shape), cosine.reshape(shape)


def _corners(
    mesh: trimesh.Trimesh, poses: Float[np.ndarray, "views 4 4"]
) -> Float[np.ndarray, "views 8 3"]:
    """The corners of the mesh's bounding box in the frame of each camera."""
    offsets = trimesh.bounds.corners(mesh.bounds) - poses[:, None, :3, 3]
    return offsets @ poses[:, :3, :3]  # the inverse of a rotation is its transpose


def _may_hit(
    mesh: trimesh.Trimesh, poses: Float[np.ndarray, "views 4 4"], rays: Float[np.ndarray, "n 3"]
) -> Bool[np.ndarray, "views n"]:
    """Rays inside the rectangle that the mesh's bounding box covers in each image, or all."""
    corners = _corners(mesh, poses)
    slopes = corners[..., :2] / corners[..., 2:]
    low, high = slopes.min(axis=1)[:, None], slopes.max(axis=1)[:, None]
    inside = ((rays[:, :2] >= low) & (rays[:, :2] <= high)).all(axis=-1)
    # A box that reaches behind the camera covers no rectangle.
    return inside | np.any(corners[..., 2] <= 0, axis=1, keepdims=True)


def add_sensor_noise(
    depth: Float[np.ndarray, "views h w"],
    cosine: Float[np.ndarray, "views h w"],
    rng: np.random.Generator,
    noise: SensorNoise = SensorNoise(),
) -> Float[np.ndarray, "views h w"]:
    """What a real sensor would have reported; lost pixels become 0, nothing known."""
    noisy, (h, w) = depth.copy(), depth.shape[1:]
    # Only edges show jitter across the image; elsewhere it would act as axial noise.
    edges = view, row, column = np.nonzero(_is_edge(depth))
    jitter = np.rint(rng.normal(0, noise.lateral, (2, len(view)))).astype(int)
    row, column = np.clip(row + jitter[0], 0, h - 1), np.clip(column + jitter[1], 0, w - 1)
    noisy[edges] = depth[view, row, column]

    seen = np.nonzero(np.isfinite(noisy))
    z = noisy[seen].astype(np.float64)
    z += rng.normal(0, noise.axial, z.shape) * z**2
    z = 1 / (noise.quantization * np.rint(1 / (noise.quantization * z)))  # steps of disparity
    grazing = cosine[seen] < np.cos(np.deg2rad(noise.grazing))
    noisy[seen] = np.where(grazing, 0, z)
    lost = rng.random(len(view)) < noise.dropout
    noisy[tuple(index[lost] for index in edges)] = 0
    return noisy


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
