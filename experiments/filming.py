"""Film a mesh by hand: noisy depth images and poses on disk, in the 7-Scenes layout."""

from pathlib import Path

import jax.numpy as jnp
import jaxlie
import numpy as np
import trimesh
from PIL import Image

from jaxshape.data.render import add_sensor_noise, render_depth
from jaxshape.geometry.camera import Intrinsics


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
