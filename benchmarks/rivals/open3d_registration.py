"""Registration of two depth frames with Open3D: multi-scale point-to-plane ICP of clouds, and its
dense odometry, which as ours looks for matches in the image."""

from functools import partial

import numpy as np
import open3d as o3d
import open3d.core as o3c
from jaxtyping import Float

from benchmarks.rivals.variant import Variant

registration = o3d.t.pipelines.registration
odometry = o3d.t.pipelines.odometry
FAR = 3.0  # metres, Open3D's own default; deeper pixels, the noisiest, are left out


def variants() -> dict[str, Variant]:
    """Clouds at the scales and reach of Open3D's own tutorial, and finer; odometry with its
    own limit for outliers and with a wider one."""
    icp = {
        f"ICP, voxels of {sizes[-1]:g} m": Variant(
            partial(_cloud, size=sizes[-1]), partial(_multi_scale, sizes=sizes)
        )
        for sizes in ((0.1, 0.05, 0.025), (0.08, 0.04, 0.02))
    }
    dense = {
        f"odometry, outliers beyond {limit:g} m": Variant(_image, partial(_odometry, limit=limit))
        for limit in (0.07, 0.2)
    }
    return icp | dense


def _depth(depth: Float[np.ndarray, "h w"]):
    known = np.where(np.isfinite(depth), depth, np.float32(0)).astype(np.float32)
    return o3d.t.geometry.Image(o3c.Tensor(np.ascontiguousarray(known[..., None])))


def _matrix(intrinsics: tuple[float, float, float, float]):
    fx, fy, cx, cy = intrinsics  # pixel centres at whole numbers
    return o3c.Tensor(np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]]))


def _cloud(depth, intrinsics, *, size):
    cloud = o3d.t.geometry.PointCloud.create_from_depth_image(
        _depth(depth), _matrix(intrinsics), depth_scale=1.0, depth_max=FAR
    )
    cloud = cloud.voxel_down_sample(size)
    cloud.estimate_normals(max_nn=30, radius=4 * size)
    return cloud


def _multi_scale(reference, frame, *, sizes):
    criteria = [
        registration.ICPConvergenceCriteria(1e-6, 1e-6, iterations) for iterations in (50, 30, 14)
    ]
    found = registration.multi_scale_icp(
        frame,
        reference,
        o3d.utility.DoubleVector(sizes),
        criteria,
        o3d.utility.DoubleVector([0.3, 0.14, 0.07]),
        o3c.Tensor(np.eye(4)),
        registration.TransformationEstimationPointToPlane(),
    )
    return found.transformation.numpy()


def _image(depth, intrinsics):
    gray = o3d.t.geometry.Image(o3c.Tensor(np.zeros((*depth.shape, 3), np.float32)))
    return o3d.t.geometry.RGBDImage(gray, _depth(depth)), _matrix(intrinsics)


def _odometry(reference, frame, *, limit):
    try:
        found = odometry.rgbd_odometry_multi_scale(
            frame[0],
            reference[0],
            frame[1],
            o3c.Tensor(np.eye(4)),
            1.0,
            FAR,
            [odometry.OdometryConvergenceCriteria(n) for n in (20, 15, 10)],
            odometry.Method.PointToPlane,
            odometry.OdometryLossParams(depth_outlier_trunc=limit),
        )
    except RuntimeError:  # where too few pixels match
        return np.eye(4)
    return found.transformation.numpy()
