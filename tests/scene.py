"""A recorded sequence of a chair whose truth is known, in the 7-Scenes layout."""

import json
from typing import NamedTuple

import jaxlie
import numpy as np
import trimesh
from PIL import Image

from jaxshape.data.capture import camera_distance
from jaxshape.data.render import fit_intrinsics, render_depth
from jaxshape.geometry import camera
from jaxshape.geometry.camera import Intrinsics

SIZE = 48
T_WORLD_OBJECT = np.array([[0, 0, 1, 5], [0, 1, 0, 6], [-1, 0, 0, -7], [0, 0, 0, 1]], float)
"""The object stands turned and shifted in the world, upright."""


class Scene(NamedTuple):
    """What was recorded, in the object frame."""

    depth: np.ndarray
    """Metres as written; 0 where the ray met nothing."""
    intrinsics: Intrinsics
    T_object_camera: jaxlie.SE3
    size: np.ndarray
    """Of the box in box.json: a little larger than the object."""


def write_scene(folder, mesh: trimesh.Trimesh, *, frames=3, masks=False) -> Scene:
    """Write depth images, poses, intrinsics and box.json."""
    folder.mkdir(parents=True, exist_ok=True)
    T_object_camera = camera.orbit(frames, camera_distance(mesh))
    intrinsics = fit_intrinsics(mesh, T_object_camera, SIZE)
    depth, _ = render_depth(mesh, T_object_camera, intrinsics, SIZE)
    raw = np.where(np.isfinite(depth), np.rint(depth * 1000), 0).astype(np.uint16)
    poses = T_WORLD_OBJECT @ np.asarray(T_object_camera.as_matrix(), np.float64)
    for i in range(frames):
        Image.fromarray(raw[i]).save(folder / f"frame-{i:06d}.depth.png")
        np.savetxt(folder / f"frame-{i:06d}.pose.txt", poses[i])
        if masks:
            mask = ((raw[i] > 0) * 255).astype(np.uint8)
            Image.fromarray(mask).save(folder / f"frame-{i:06d}.mask.png")
    fx, fy, cx, cy = (float(x) for x in intrinsics)
    np.savetxt(folder / "camera-intrinsics.txt", [[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    size = mesh.extents * 1.02
    box = {"T_world_object": T_WORLD_OBJECT.tolist(), "size": size.tolist()}
    (folder / "box.json").write_text(json.dumps(box))
    return Scene(raw / np.float32(1000), intrinsics, T_object_camera, size)
