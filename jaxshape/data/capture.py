"""One object seen by the virtual camera: depth frames, measurements, ground truth. [host]"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import trimesh
from jaxtyping import Array, Bool, Float

from jaxshape.data import meshes, render
from jaxshape.geometry import fusion, grid
from jaxshape.geometry.camera import Intrinsics
from jaxshape.geometry.fusion import Measurement
from jaxshape.geometry.grid import GridFrame

SURFACE_SAMPLES = 50_000
"""Points sampled on a CAD model to find its surface voxels: some 15 for each of them."""


class Capture(NamedTuple):
    """Depth frames of an object from known poses, and its true surface.

    Attributes:
        depth: Depth images `[views h w]`, in metres; 0 where nothing is known, infinite where the
            ray met nothing.
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
    image_size: int = render.IMAGE_SIZE,
    resolution: int = grid.RESOLUTION,
) -> Capture:
    """Look at a mesh from some poses, and find its surface voxels (paper, section 2.3). [host]

    The ground truth comes straight from points on the CAD model, not through the depth frames, so
    that it is complete.

    Args:
        mesh: A mesh in the canonical object frame: +y up, front along +z, box centred at the
            origin, in metres.
        T_object_camera: Poses of the camera `[views]`.
        noise: Whether to add the faults of a structured-light sensor.
        seed: Seed of the noise and of the surface samples, 0 or more.
        image_size: Pixels along each side of the square images.
        resolution: Voxels along each axis of the object's grids.
    """
    intrinsics = render.fit_intrinsics(mesh, T_object_camera, image_size)
    depth, cosine = render.render_depth(mesh, T_object_camera, intrinsics, image_size)
    if noise:
        depth = render.add_sensor_noise(depth, cosine, np.random.default_rng(seed))
    frame = grid.fit_box(*jnp.float32(mesh.bounds), resolution=resolution)
    points = meshes.sample_surface(mesh, SURFACE_SAMPLES, seed).astype(np.float32)
    return Capture(depth, intrinsics, T_object_camera, frame, discretize(points, frame, resolution))


def camera_distance(mesh: trimesh.Trimesh) -> float:
    """Distance of the virtual camera from the object's centre, in metres."""
    return render.DISTANCE * float(mesh.scale)


@partial(jax.jit, static_argnums=2)
def discretize(
    points: Float[Array, "n 3"], frame: GridFrame, resolution: int = grid.RESOLUTION
) -> Bool[Array, "x y z"]:
    """Surface voxels of object-frame points: `D(P)` of the paper."""
    return fusion.count_points(grid.voxel_from_object(frame, points), resolution) > 0


@jax.jit
def measure_frames(captured: Capture) -> Measurement:
    """Measure each frame of a capture on its own; every pixel that hit something shows the object.

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
