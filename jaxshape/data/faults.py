"""Faults of real depth frames, for training: each occurs in a share of the frames. [host]

They act on images and poses, as in a recording, so that they affect every fusion method.
"""

from typing import NamedTuple

import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Bool, Float

from jaxshape.data.config import FaultConfig
from jaxshape.geometry.camera import Intrinsics

POSE_ERROR = 0.01, 0.01
"""Standard deviations of a wrong pose: metres along, and radians about, each axis."""


class Frames(NamedTuple):
    """Depth frames as a program receives them.

    Attributes:
        depth: Metres `[frame h w]`; 0 for missing depth, infinite where the ray hit nothing.
        segmented: True on pixels that are segmented as the object `[frame h w]`.
        T_object_camera: Poses `[frame]`, of which some may be wrong.
    """

    depth: Float[np.ndarray, "frame h w"]
    segmented: Bool[np.ndarray, "frame h w"]
    T_object_camera: jaxlie.SE3


def with_faults(
    depth: Float[np.ndarray, "frame h w"],
    intrinsics: Intrinsics,
    T_object_camera: jaxlie.SE3,
    size: Float[np.ndarray, "3"],
    config: FaultConfig,
    rng: np.random.Generator,
) -> Frames:
    """The frames of an object with the faults of real ones.

    Args:
        depth: Metres `[frame h w]`, infinite where the ray hit nothing.
        intrinsics: The camera of all frames.
        T_object_camera: True poses `[frame]`.
        size: Edges of the object's box, which is centred at the origin, in metres.
        config: Shares of the faults.
        rng: Random generator of the draws.
    """
    depth = depth.copy()
    segmented = np.isfinite(depth) & (depth > 0)
    poses = np.asarray(T_object_camera.as_matrix(), np.float64)
    rays = pixel_rays(intrinsics, depth.shape[1:])
    if rng.random() < config.hidden:
        _hide(depth, segmented, rays, poses, size, rng)
    for i, pose in enumerate(poses):
        if rng.random() < config.segmentation:
            _cut(segmented[i], rng) if rng.random() < 0.5 else _leak(
                depth[i], segmented[i], rays, pose, size, rng
            )
        if rng.random() < config.missing:
            _miss(depth[i], segmented[i], rng)
    struck = rng.random(len(poses)) < config.pose_error
    return Frames(depth, segmented, _moved(T_object_camera, struck, rng))


def pixel_rays(intrinsics: Intrinsics, shape: tuple[int, int]) -> Float[np.ndarray, "h w 3"]:
    """Directions through the centres of all pixels, of length 1 along the optical axis."""
    fx, fy, cx, cy = (float(x) for x in intrinsics)
    row, column = np.indices(shape) + 0.5
    return np.stack([(column - cx) / fx, (row - cy) / fy, np.ones(shape)], axis=-1)


def _hide(depth, segmented, rays, poses, size, rng) -> None:
    """Hide one side of the object in all frames: its depth is missing there."""
    normal = rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    reach = 0.5 * np.abs(normal) @ size
    limit = rng.uniform(0.0, 0.8) * reach
    for i, pose in enumerate(poses):
        seen = segmented[i]
        points = (rays[seen] * depth[i][seen][:, None]) @ pose[:3, :3].T + pose[:3, 3]
        hidden = np.zeros_like(seen)
        hidden[seen] = points @ normal > limit
        depth[i][hidden], segmented[i][hidden] = 0, False


def _cut(segmented, rng) -> None:
    """Cut up to a quarter of the object off the mask, on one side of the image."""
    lines = np.flatnonzero(segmented.any(axis=(axis := int(rng.integers(2)))))
    if len(lines) == 0:
        return
    count = max(1, int(rng.uniform(0, 0.25) * len(lines)))
    chosen = lines[:count] if rng.random() < 0.5 else lines[-count:]
    segmented[(slice(None), chosen) if axis == 0 else (chosen, slice(None))] = False


def _leak(depth, segmented, rays, pose, size, rng) -> None:
    """Add a patch of the floor below the object to the mask."""
    directions = rays @ pose[:3, :3].T
    falls = np.where(directions[..., 1] < -1e-6, directions[..., 1], -1e-6)
    along = (-size[1] / 2 - pose[1, 3]) / falls
    floor = directions * along[..., None] + pose[:3, 3]
    center = rng.uniform(-0.5, 0.5, 2) * size[[0, 2]]
    half = rng.uniform(0.1, 0.25, 2) * size[[0, 2]]
    patch = np.isinf(depth) & (directions[..., 1] < -1e-6)
    patch &= (np.abs(floor[..., [0, 2]] - center) < half).all(axis=-1)
    depth[patch], segmented[patch] = along[patch], True


def _miss(depth, segmented, rng) -> None:
    """Remove the depth in a disc of the image around a pixel of the object."""
    rows, columns = np.nonzero(segmented)
    if len(rows) == 0:
        return
    middle = rng.integers(len(rows))
    radius = rng.uniform(0.02, 0.12) * depth.shape[0]
    row, column = np.indices(depth.shape)
    disc = np.hypot(row - rows[middle], column - columns[middle]) < radius
    depth[disc], segmented[disc] = 0, False


def _moved(T: jaxlie.SE3, struck: Bool[np.ndarray, " frame"], rng) -> jaxlie.SE3:
    """Change some poses by a normally distributed motion."""
    scale = np.repeat(POSE_ERROR, 3) * struck[:, None]
    turn = rng.normal(size=(len(struck), 6)) * scale
    return jaxlie.SE3(T.wxyz_xyz) @ jaxlie.SE3.exp(jnp.float32(turn))
