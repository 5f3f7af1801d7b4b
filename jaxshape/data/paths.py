"""One training path: a camera moves around an object, and its frames are fused in order. [host]

Each path draws its own camera, poses, noise and faults. The measurements after certain numbers of
frames become the training inputs.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import trimesh
from jaxtyping import Array, Bool, Float

from jaxshape.data import meshes, render
from jaxshape.data.capture import (
    GRID_MARGIN,
    camera_distance,
    sensor_of,
    true_surface,
)
from jaxshape.data.config import DatasetConfig
from jaxshape.data.faults import Frames, with_faults
from jaxshape.data.virtual_cameras import CAMERAS, VirtualCamera
from jaxshape.geometry import camera, grid
from jaxshape.geometry.camera import Intrinsics
from jaxshape.geometry.fusing import Fusion, fuse_in_stages, fusion_named
from jaxshape.geometry.grid import GridFrame
from jaxshape.geometry.grids import Grids
from jaxshape.geometry.pixels import Sensor

NEAREST, FARTHEST = 0.8, 1.3
"""Range of the distances of the cameras of a path, relative to the usual distance of the camera."""

IMAGE_STEP = 64
"""Image sizes are multiples of this number of pixels, so that few compiled programs suffice."""


class Path(NamedTuple):
    """Training input and target of one path.

    Attributes:
        surface: The true surface **Y** `[x y z]`.
        measured: Soft or binary F and M after each number of frames `[number x y z]`.
    """

    surface: Bool[Array | np.ndarray, "x y z"]
    measured: Grids


def draw_path(mesh: trimesh.Trimesh, config: DatasetConfig, seed: int) -> Path:
    """Film an object along a random path.

    Args:
        mesh: A mesh in the canonical object frame.
        config: Settings of the draws.
        seed: Seed of all draws, 0 or more.
    """
    rng = np.random.default_rng(seed)
    name = config.cameras[rng.integers(len(config.cameras))]
    kind, mesh = CAMERAS[name], meshes.in_metres(mesh)
    poses = draw_poses(mesh, kind, config, rng)
    intrinsics, size = render.window(kind, mesh, poses, GRID_MARGIN)
    depth, cosine = render.render_depth(mesh, poses, intrinsics, size)
    if rng.random() < config.noisy:
        depth = render.add_sensor_noise(depth, cosine, rng, kind.noise)
    frames = with_faults(depth, intrinsics, poses, mesh.extents, config.faults, rng)
    box = draw_box(mesh, config, rng)
    frame = grid.fit_box(*jnp.float32(box), resolution=config.resolution)
    fusing = fusion_named("points" if name == "paper" else "distance", config.resolution)
    measured = _fused(padded(frames), intrinsics, frame, fusing, config.frames, sensor_of(kind))
    return Path(true_surface(mesh, frame, seed, config.resolution), measured)


def draw_poses(
    mesh: trimesh.Trimesh, kind: VirtualCamera, config: DatasetConfig, rng: np.random.Generator
) -> jaxlie.SE3:
    """Poses of a path: an arc around the object, or random views as in the paper."""
    count, distance = max(config.frames), camera_distance(mesh, kind)
    if rng.random() >= config.arcs:
        key = jax.random.key(int(rng.integers(2**31)))
        return camera.random_views(key, count, distance)
    start, span = rng.uniform(0, 360), rng.uniform(60, 360) * rng.choice([-1, 1])
    along = np.linspace(0, 1, count)
    elevation = np.interp(along, [0, 1], rng.uniform(10, 60, 2))
    radius = distance * rng.uniform(NEAREST, FARTHEST)
    return camera.on_sphere(jnp.float32(start + span * along), jnp.float32(elevation), radius)


def draw_box(
    mesh: trimesh.Trimesh, config: DatasetConfig, rng: np.random.Generator
) -> Float[np.ndarray, "2 3"]:
    """Lower and upper corner of the object's box; for a share of the paths, slightly too large."""
    bounds = np.array(mesh.bounds)
    if rng.random() < config.faults.loose:
        bounds += np.array([[-1.0], [1.0]]) * rng.uniform(0, 0.06, (2, 3)) * mesh.extents
    return bounds


def padded(frames: Frames) -> Frames:
    """Pad images to a multiple of `IMAGE_STEP` rows and columns, with rays that hit nothing."""
    _, h, w = frames.depth.shape
    more = [(0, 0), (0, -h % IMAGE_STEP), (0, -w % IMAGE_STEP)]
    return frames._replace(
        depth=np.pad(frames.depth, more, constant_values=np.inf),
        segmented=np.pad(frames.segmented, more),
    )


@partial(jax.jit, static_argnames=("fusing", "numbers", "sensor"))
def _fused(
    frames: Frames,
    intrinsics: Intrinsics,
    frame: GridFrame,
    fusing: Fusion,
    numbers: tuple[int, ...],
    sensor: Sensor,
) -> Grids:
    depth, segmented = jnp.asarray(frames.depth), jnp.asarray(frames.segmented)
    states = fuse_in_stages(
        fusing, numbers, depth, segmented, intrinsics, frames.T_object_camera, frame, sensor
    )
    return jax.tree.map(lambda *x: jnp.stack(x), *map(fusing.grids, states))
