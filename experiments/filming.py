"""Film meshes: from an orbit, or by hand with images and poses on disk in the 7-Scenes layout."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import jaxlie
import numpy as np
import trimesh
from PIL import Image

from jaxshape.data.capture import Capture, camera_distance, capture
from jaxshape.data.dataset import Object, hash_seed, load_object
from jaxshape.data.meshes import Model
from jaxshape.data.render import add_sensor_noise, render_depth
from jaxshape.data.virtual_cameras import VirtualCamera
from jaxshape.geometry import camera
from jaxshape.geometry.camera import Intrinsics


def from_orbit(
    chair: Object, frames: int, device: VirtualCamera, noise: bool = True
) -> tuple[trimesh.Trimesh, Capture]:
    """A mesh, and the frames of an orbit at 30 degrees elevation around it."""
    model = load_object(chair)
    assert isinstance(model, Model), model
    T = camera.orbit(frames, camera_distance(model.mesh, device))
    seed = hash_seed(0, *model.name.encode())
    return model.mesh, capture(model.mesh, T, noise=noise, seed=seed, camera=device)


def film(
    folder: Path,
    mesh: trimesh.Trimesh,
    T: np.ndarray,
    shape: tuple[int, int],
    focal: float,
    rng: np.random.Generator,
    T_written: np.ndarray | None = None,
) -> np.ndarray:
    """Write depth images with a Kinect's noise, their poses and the camera; return clean depth.

    `T` are the true poses; `T_written` are the poses that are written, by default the true ones.
    """
    height, width = shape
    lens = Intrinsics(*jnp.float32([focal, focal, width / 2, height / 2]))
    clean, cosine = render_depth(mesh, jaxlie.SE3.from_matrix(jnp.float32(T)), lens, shape)
    depth = add_sensor_noise(clean, cosine, rng)
    millimetres = np.where(np.isfinite(depth), np.rint(1000 * depth), 0).clip(0, 65534)
    for i, image in enumerate(millimetres.astype(np.uint16)):
        Image.fromarray(image).save(folder / f"frame-{i:06d}.depth.png")
        np.savetxt(folder / f"frame-{i:06d}.pose.txt", (T if T_written is None else T_written)[i])
    K = [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]
    np.savetxt(folder / "camera-intrinsics.txt", K)
    return clean


def look_from(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """T_world_camera of a camera that looks at a point, upright in a world whose +y is up."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, (0, 1, 0))
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3] = np.stack([right, np.cross(forward, right), forward, eye], axis=1)
    return T


def among_boxes(
    meshes: Sequence[trimesh.Trimesh], boxes: Sequence[tuple[tuple, tuple]]
) -> trimesh.Trimesh:
    """Meshes together with boxes such as floors and walls, each given by two opposite corners."""
    around = [trimesh.creation.box(bounds=np.array(corners, float)) for corners in boxes]
    together: Any = trimesh.util.concatenate([*meshes, *around])
    return together
