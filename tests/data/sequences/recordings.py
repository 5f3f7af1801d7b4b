"""Small recordings written to disk, one writer for each layout."""

import json
from typing import NamedTuple

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

H, W = 48, 64
FX, CX, CY = 60.0, 32.0, 24.0
K = np.array([[FX, 0, CX], [0, FX, CY], [0, 0, 1]])
"""Ours: the centre of the first pixel is at 0.5, 0.5."""
OPENCV = K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
"""The same camera, with the centre of the first pixel at 0, 0."""
RATE = 30.0


class Recording(NamedTuple):
    """What was recorded."""

    depth: np.ndarray
    """Metres, 0 where nothing was measured."""
    color: np.ndarray
    mask: np.ndarray
    T_world_camera: np.ndarray

    @property
    def times(self):
        return 100 + np.arange(len(self.depth)) / RATE


def record(count=6, seed=0):
    """A camera that moves and turns in front of a sphere before a wall, ray by ray."""
    v, u = np.mgrid[:H, :W] + 0.5
    rays = np.stack([(u - CX) / FX, (v - CY) / FX, np.ones((H, W))], -1)  # z = 1: length is depth
    T = np.tile(np.eye(4), (count, 1, 1))
    number = np.arange(count)
    T[:, :3, :3] = Rotation.from_euler("y", 0.05 * number[:, None]).as_matrix()
    T[:, :3, 3] = np.outer(number, [0.1, 0.05, 0.02]) - [0.3, 0, 0]
    rng = np.random.default_rng(seed)
    color = rng.integers(0, 256, (count, H, W, 3)).astype(np.uint8)
    depth = np.stack([_depth(rays @ pose[:3, :3].T, pose[:3, 3]) for pose in T])
    mask = rng.integers(0, 2, (count, H, W)).astype(bool)
    return Recording(np.rint(depth * 1000) / 1000, color, mask, T)


def _depth(direction, eye):
    depth = (3.0 - eye[2]) / direction[..., 2]  # the wall z = 3
    a, b = (direction**2).sum(-1), direction @ (eye - (0, 0, 2))
    root = b**2 - a * (((eye - (0, 0, 2)) ** 2).sum() - 0.5**2)  # the sphere at z = 2
    return np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, depth)


def save(path, pixels):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)


def raw(depth, scale):
    return np.rint(depth * scale).astype(np.uint16)


def write_7_scenes(folder, seen, scale=1000):
    for i, T in enumerate(seen.T_world_camera):
        save(folder / f"frame-{i:06d}.depth.png", raw(seen.depth[i], scale))
        save(folder / f"frame-{i:06d}.color.png", seen.color[i])
        save(folder / f"frame-{i:06d}.mask.png", seen.mask[i].astype(np.uint8) * 255)
        np.savetxt(folder / f"frame-{i:06d}.pose.txt", T)
    np.savetxt(folder / "camera-intrinsics.txt", K)


def tum_line(time, T):
    return " ".join(
        map(repr, map(float, (time, *T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat())))
    )


def write_tum(folder, seen, scale=5000, color_delay=0.01, poses=True):
    """Poses come at the times of the depth images; colour comes a little later."""
    lists = {"depth": [], "rgb": []}
    for i, time in enumerate(seen.times):
        for kind, at, pixels in (
            ("depth", time, raw(seen.depth[i], scale)),
            ("rgb", time + color_delay, seen.color[i]),
        ):
            save(folder / kind / f"{at:.6f}.png", pixels)
            lists[kind].append(f"{at:.6f} {kind}/{at:.6f}.png")
        save(folder / "masks" / f"{time:.6f}.png", seen.mask[i].astype(np.uint8))
    for kind, lines in lists.items():
        (folder / f"{kind}.txt").write_text("\n".join(["# kind", "# time file", *lines]) + "\n")
    if poses:
        path = [tum_line(t, T) for t, T in zip(seen.times, seen.T_world_camera, strict=True)]
        (folder / "groundtruth.txt").write_text("\n".join(["# ground truth", *path]) + "\n")
    (folder / "calibration.txt").write_text(f"{FX} {FX} {CX - 0.5} {CY - 0.5}\n")


def write_redwood(folder, seen, scale=1000, color_delay=0.01, poses=True):
    for i, time in enumerate(seen.times - 100):
        later = time + color_delay
        save(folder / f"depth/{i + 1:07d}-{round(time * 1e6):012d}.png", raw(seen.depth[i], scale))
        save(folder / f"rgb/{i + 3:07d}-{round(later * 1e6):012d}.png", seen.color[i])
        save(folder / f"masks/{i + 1:07d}-{round(time * 1e6):012d}.png", seen.mask[i])
    if poses:
        write_log(folder / "trajectory.log", seen.T_world_camera)
    np.savetxt(folder / "cam_K.txt", OPENCV)


def write_log(path, poses):
    lines = [
        f"{i} {i} {i + 1}\n" + "\n".join(" ".join(map(repr, r)) for r in T.tolist())
        for i, T in enumerate(poses)
    ]
    path.write_text("\n".join(lines) + "\n")


def write_open3d(folder, seen, scale=1000, as_json=False):
    """Images named after what they are; the camera is that of images of twice the size."""
    for i in range(len(seen.depth)):
        save(folder / f"depth/depth_{i}.png", raw(seen.depth[i], scale))
        save(folder / f"color/color_{i}.png", seen.color[i])
        save(folder / f"mask/mask_{i}.png", seen.mask[i])
    twice = np.diag([2.0, 2, 1]) @ K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    camera = {"width": 2 * W, "height": 2 * H, "intrinsic_matrix": twice.T.ravel().tolist()}
    (folder / "camera_primesense.json").write_text(json.dumps(camera))
    if as_json:
        inverses = np.linalg.inv(seen.T_world_camera)
        parameters = [{"extrinsic": T.T.ravel().tolist(), "intrinsic": camera} for T in inverses]
        (folder / "camera_primesense.json").unlink()
        (folder / "trajectory.json").write_text(json.dumps({"parameters": parameters}))
    else:
        write_log(folder / "trajectory.log", seen.T_world_camera)


def write_open3d_json(folder, seen, scale=1000):
    write_open3d(folder, seen, scale, as_json=True)


def write_bundlesdf(folder, seen, scale=1000):
    for i, T in enumerate(seen.T_world_camera):
        save(folder / f"depth/{i:05d}.png", raw(seen.depth[i], scale))
        save(folder / f"rgb/{i:05d}.png", seen.color[i])
        save(folder / f"masks/{i:05d}.png", seen.mask[i])
        (folder / "ob_in_cam").mkdir(exist_ok=True)
        np.savetxt(folder / f"ob_in_cam/{i:05d}.txt", np.linalg.inv(T))
    np.savetxt(folder / "cam_K.txt", OPENCV)


WRITERS = {
    "7-scenes": write_7_scenes,
    "tum": write_tum,
    "redwood": write_redwood,
    "open3d": write_open3d,
    "open3d json": write_open3d_json,
    "bundlesdf": write_bundlesdf,
}
