"""Fusion and mask of one depth frame with Open3D's voxel grids, whose voxels are cubes."""

from typing import Any

import numpy as np
import open3d as o3d
import open3d.core as o3c
from jaxtyping import Bool, Float


def camera_of(
    intrinsics: tuple[float, float, float, float],
    T_object_camera: Float[np.ndarray, "4 4"],
    shape: tuple[int, int],
) -> Any:
    """Open3D's description of a camera; its voxel grids take pixel centres at whole numbers."""
    h, w = shape
    fx, fy, cx, cy = map(float, intrinsics)
    camera = o3d.camera.PinholeCameraParameters()
    camera.intrinsic = o3d.camera.PinholeCameraIntrinsic(w, h, fx, fy, cx - 0.5, cy - 0.5)
    camera.extrinsic = np.linalg.inv(np.asarray(T_object_camera, np.float64))
    return camera


def measure(
    depth: Float[np.ndarray, "h w"],
    segmented: Bool[np.ndarray, "h w"],
    camera: Any,
    origin: Float[np.ndarray, " 3"],
    voxel_size: float,
    *,
    resolution: int = 32,
) -> tuple[Bool[np.ndarray, "x y z"], Bool[np.ndarray, "x y z"]]:
    """Occupied voxels of the segmented points, and voxels carved as seen through.

    Open3D carves a voxel when all eight of its corners are seen through, in an interpolated depth
    image, so that it keeps what is around pixels that know nothing.
    """
    object_depth = o3d.geometry.Image(
        np.where(segmented & np.isfinite(depth), depth, np.float32(0))
    )
    cloud = o3d.geometry.PointCloud.create_from_depth_image(
        object_depth, camera.intrinsic, camera.extrinsic, depth_scale=1.0, depth_trunc=1e3
    )
    side = resolution * voxel_size
    corner = np.asarray(origin, np.float64)
    surface = o3d.geometry.VoxelGrid.create_from_point_cloud_within_bounds(
        cloud, voxel_size, corner, corner + side
    )
    # Carving would take 0 for free space: nothing known is put right before the camera.
    depth_map = o3d.geometry.Image(np.clip(depth, np.float32(1e-6), np.float32(1e3)))
    kept = o3d.geometry.VoxelGrid.create_dense(corner, np.zeros(3), voxel_size, side, side, side)
    kept.carve_depth_map(depth_map, camera, keep_voxels_outside_image=True)
    return _grid(surface, resolution), ~_grid(kept, resolution)


def integration(
    depth: Float[np.ndarray, "h w"],
    intrinsics: tuple[float, float, float, float],
    T_object_camera: Float[np.ndarray, "4 4"],
    voxel_size: float,
    *,
    truncation: float = 4.0,
) -> Any:
    """A function of nothing that integrates a frame into a block grid of signed distances.

    `truncation` is in voxels.
    """
    fx, fy, cx, cy = intrinsics
    lens = o3c.Tensor(np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1.0]]))
    pose = o3c.Tensor(np.linalg.inv(np.asarray(T_object_camera, np.float64)))
    image = o3d.t.geometry.Image(o3c.Tensor(np.where(np.isfinite(depth), depth, 0)))
    volume = o3d.t.geometry.VoxelBlockGrid(
        attr_names=("tsdf", "weight"),
        attr_dtypes=(o3c.float32, o3c.float32),
        attr_channels=(1, 1),
        voxel_size=voxel_size,
    )

    def integrate() -> None:
        blocks = volume.compute_unique_block_coordinates(image, lens, pose, 1.0, 1e3, truncation)
        volume.integrate(blocks, image, lens, pose, 1.0, 1e3, truncation)

    return integrate


def _grid(voxels: Any, resolution: int) -> Bool[np.ndarray, "x y z"]:
    grid = np.zeros((resolution,) * 3, bool)
    index = np.array([voxel.grid_index for voxel in voxels.get_voxels()], int).reshape(-1, 3)
    index = index[np.all((index >= 0) & (index < resolution), axis=1)]
    grid[tuple(index.T)] = True
    return grid
