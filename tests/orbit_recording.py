"""A walk around a chair in the corner of a room, whose truth is known, in the 7-Scenes layout."""

import json
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import jaxlie
import numpy as np
import trimesh
from PIL import Image

from jaxshape.data.boxes import Box
from jaxshape.data.chairs import random_chair
from jaxshape.data.render import add_sensor_noise, render_depth
from jaxshape.data.virtual_cameras import SensorNoise
from jaxshape.geometry import camera
from jaxshape.geometry.camera import Intrinsics

FRAMES, SIZE, FOCAL = 14, 128, 120.0
STEP, ELEVATION, DISTANCE = 5.0, 28.0, 1.9  # degrees between frames, degrees, metres
T_WORLD_OBJECT = np.array([[0, 0, 1, 2], [0, 1, 0, 1], [-1, 0, 0, -3], [0, 0, 0, 1]], float)
INTRINSICS = Intrinsics(*jnp.float32([FOCAL, FOCAL, SIZE / 2, SIZE / 2]))


class Recording(NamedTuple):
    """What was recorded."""

    depth: np.ndarray
    """Millimetres, as the files hold them; 0 where nothing was measured."""
    T_world_camera: np.ndarray
    """Of each frame, in truth."""
    box: Box
    """Of the chair alone: its feet stay on the floor."""
    chair: trimesh.Trimesh
    """In the object frame."""


def record(occluder: bool = False, noise: SensorNoise = SensorNoise(), seed: int = 2) -> Recording:
    """Walk around the side chair of a seed; with `occluder`, a box passes before it in frames 4 to
    9."""
    chair = random_chair(seed, style="side chair")
    T_object_camera = _poses()
    T = np.asarray(T_object_camera.as_matrix(), np.float64)
    depth, cosine = render_depth(chair, T_object_camera, INTRINSICS, SIZE)
    for low, high in _corner(chair.bounds[0, 1]):
        _add_box(depth, cosine, T, np.array([low, high]))
    if occluder:
        for i in range(4, 10):  # 1 m before the camera, 0.14 m further to its right each time
            center = np.array([0.14 * (i - 6.5), 0.05, 1.0])
            box = center + np.array([[-0.11, -0.15, -0.07], [0.11, 0.15, 0.07]])
            _add_box(depth[i : i + 1], cosine[i : i + 1], np.eye(4)[None], box)
    depth = add_sensor_noise(depth, cosine, np.random.default_rng(0), noise)
    millimetres = np.where(np.isfinite(depth), np.rint(depth * 1000), 0).clip(0, 65534)
    size = chair.extents * (1.04, 1.02, 1.04)
    box = Box(T_WORLD_OBJECT, size, _on_the_floor(size))
    return Recording(millimetres.astype(np.uint16), T_WORLD_OBJECT @ T, box, chair)


def _poses() -> jaxlie.SE3:
    """A little nearer and farther, higher and lower, as nobody walks on a circle."""
    phase = jnp.arange(FRAMES, dtype=jnp.float32)
    elevation = ELEVATION + 2 * jnp.sin(0.8 * phase)
    T = camera.on_sphere(10 + STEP * phase, elevation, DISTANCE)
    radius = 1 + 0.03 * jnp.sin(0.5 * phase)[:, None]
    return jaxlie.SE3.from_rotation_and_translation(T.rotation(), radius * T.translation())


def _corner(floor: float) -> list:
    """Floor, two walls, a crate and a shelf, as lowest and highest corners in the object frame."""
    return [
        ((-3, floor - 0.1, -3), (3, floor, 3)),
        ((-3, floor, -1.4), (3, floor + 3, -1.3)),
        ((-1.6, floor, -3), (-1.5, floor + 3, 3)),
        ((-1.3, floor, -1.2), (-0.8, floor + 0.5, -0.7)),
        ((0.3, floor + 0.6, -1.3), (0.9, floor + 0.65, -1.05)),
    ]


def _add_box(depth: np.ndarray, cosine: np.ndarray, T: np.ndarray, box: np.ndarray) -> None:
    """Draw an axis-aligned box into depth images, by where each ray enters and leaves its slabs."""
    u, v = np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5)
    rays = np.stack([u - SIZE / 2, v - SIZE / 2, np.full(u.shape, FOCAL)], axis=-1) / FOCAL
    for i, pose in enumerate(T):
        along = rays @ pose[:3, :3].T
        ends = (box[:, None, None] - pose[:3, 3]) / np.where(along == 0, 1e-12, along)
        near, leave = ends.min(axis=0), ends.max(axis=0).min(axis=-1)
        enter = near.max(axis=-1)
        hit = (0 < enter) & (enter < leave) & (enter < depth[i])
        axis = near.argmax(axis=-1)[..., None]
        meets = np.abs(np.take_along_axis(along, axis, axis=-1))[..., 0]
        depth[i] = np.where(hit, enter, depth[i])
        cosine[i] = np.where(hit, meets / np.linalg.norm(along, axis=-1), cosine[i])


def _on_the_floor(size: np.ndarray) -> np.ndarray:
    """The lowest 3 cm of a box, into which the floor reaches by noise."""
    return np.array([[[-9, -9, -9], [9, 0.03 - size[1] / 2, 9]]], float)


def write_recording(folder: Path, recording: Recording, *, poses: bool = True) -> Path:
    """Write depth images, poses, intrinsics and box.json."""
    folder.mkdir(parents=True)
    for i in range(len(recording.depth)):
        write_depth(folder, i, recording.depth[i])
        if poses:
            np.savetxt(folder / f"frame-{i:06d}.pose.txt", recording.T_world_camera[i])
    write_camera(folder, FOCAL)
    low, high = recording.box.exclude[0].tolist()
    box = {
        "T_world_object": recording.box.T_world_object.tolist(),
        "size": recording.box.size.tolist(),
        "exclude": [{"min": low, "max": high}],
    }
    (folder / "box.json").write_text(json.dumps(box))
    return folder


def write_depth(folder: Path, index: int, millimetres: np.ndarray) -> None:
    Image.fromarray(millimetres).save(depth_path(folder, index))


def depth_path(folder: Path, index: int) -> Path:
    return folder / f"frame-{index:06d}.depth.png"


def write_camera(folder: Path, focal: float) -> None:
    K = [[focal, 0, SIZE / 2], [0, focal, SIZE / 2], [0, 0, 1]]
    np.savetxt(folder / "camera-intrinsics.txt", K)


def pose_errors(T: np.ndarray, T_true: np.ndarray) -> tuple[float, float]:
    """Centimetres and degrees between two poses."""
    cosine = (np.trace(T[:3, :3].T @ T_true[:3, :3]) - 1) / 2
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    return 100 * float(np.linalg.norm(T[:3, 3] - T_true[:3, 3])), float(angle)
