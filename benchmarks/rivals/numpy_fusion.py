"""Fusion and mask of one depth frame in vectorised NumPy (paper, Eq. 6)."""

import numpy as np
from jaxtyping import Bool, Float, Int


def measure(
    depth: Float[np.ndarray, "h w"],
    segmented: Bool[np.ndarray, "h w"],
    intrinsics: tuple[float, float, float, float],
    T_object_camera: Float[np.ndarray, "4 4"],
    origin: Float[np.ndarray, " 3"],
    voxel_size: Float[np.ndarray, " 3"],
    *,
    resolution: int = 32,
    add_at: bool = False,
) -> tuple[Int[np.ndarray, "x y z"], Bool[np.ndarray, "x y z"]]:
    """Points per voxel, and what was seen through; `jaxshape.measure` in other words.

    Only pixels that are needed are unprojected, and `np.bincount` counts them; with `add_at`, the
    several times slower `np.add.at` that is met more often.
    """
    fx, fy, cx, cy = map(np.float32, intrinsics)
    R, t = T_object_camera[:3, :3].astype(np.float32), T_object_camera[:3, 3].astype(np.float32)
    grid = (resolution,) * 3

    row, column = np.nonzero(segmented & (depth > 0) & np.isfinite(depth))
    z = depth[row, column]
    x, y = (column + np.float32(0.5) - cx) / fx * z, (row + np.float32(0.5) - cy) / fy * z
    points = np.stack([x, y, z], axis=-1) @ R.T + t
    voxels = np.floor((points - origin) / voxel_size).astype(np.int32)
    voxels = voxels[np.all((voxels >= 0) & (voxels < resolution), axis=-1)]
    if add_at:
        hits = np.zeros(grid, np.int64)
        np.add.at(hits, tuple(voxels.T), 1)
    else:
        flat = np.ravel_multi_index(tuple(voxels.T), grid)
        hits = np.bincount(flat, minlength=resolution**3).reshape(grid)

    index = np.indices(grid, np.float32).reshape(3, -1).T + np.float32(0.5)
    x, y, z = ((origin + index * voxel_size - t) @ R).T
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = fx * x / z + cx, fy * y / z + cy
    h, w = depth.shape
    inside = (z > 0) & (u >= 0) & (u < w) & (v >= 0) & (v < h)
    seen_through = np.zeros(resolution**3, bool)
    looked_up = depth[v[inside].astype(np.int32), u[inside].astype(np.int32)]
    seen_through[inside] = z[inside] < looked_up
    return hits, seen_through.reshape(grid)
