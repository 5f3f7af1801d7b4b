"""A small result folder, as a reconstruction of several keyframes leaves it."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from jaxshape.geometry.grid import GridFrame
from jaxshape.results import output
from jaxshape.results.output import Observation, write_result
from jaxshape.search.reconstruction import Reconstruction, compose
from jaxshape.search.refiner import StopReason, Trace

T_WORLD_OBJECT = np.array([[0, 0, 1, 5], [0, 1, 0, 6], [-1, 0, 0, 7], [0, 0, 0, 1]], float)
T_OBJECT_CAMERA = np.array([[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 2], [0, 0, 0, 1]], float)
"""In front of the object, upright, looking at it."""

KEYFRAMES = 3
STATUSES = ("keyframe", "tracked", "keyframe", "lost", "unreadable", "tracked", "keyframe")


def solid(lower, upper):
    grid = np.zeros((32, 32, 32), bool)
    grid[tuple(slice(a, b) for a, b in zip(lower, upper, strict=True))] = True
    return grid


def chair(seat: int, back: int):
    """A seat, four legs and a back, as thick as asked for."""
    legs = [solid((x, 1, z), (x + 3, 14, z + 3)) for x in (4, 25) for z in (4, 25)]
    slab = solid((4, 14, 4), (28, 14 + seat, 28)) | solid((4, 14, 4), (28, 31, 4 + back))
    return slab | np.any(legs, axis=0)


TRUTH, COMPLETED, FIRST = chair(3, 3), chair(3, 4), chair(5, 6)
OCCUPIED, OCCLUDED = TRUTH & solid((0, 0, 12), (32, 32, 32)), solid((4, 1, 4), (28, 12, 12))
OBSERVATION = Observation(
    depth=[np.full((20, 30), 1.5, np.float32)],
    occupied=OCCUPIED,
    occluded=OCCLUDED,
    frame=GridFrame(jnp.array([-0.32, -0.48, -0.32]), jnp.array([0.02, 0.03, 0.02])),
    T_world_object=T_WORLD_OBJECT,
    truth=TRUTH,
)
RECONSTRUCTION = Reconstruction(
    first_code=jnp.zeros((1, 10)),
    code=jnp.arange(10.0)[None],
    completed_first=jnp.asarray(FIRST)[None],
    logits=jnp.where(COMPLETED, 1.0, -1.0)[None],
    completed=jnp.asarray(COMPLETED)[None],
    composed=compose(jnp.asarray(OCCUPIED), jnp.asarray(OCCLUDED), jnp.asarray(COMPLETED))[None],
    first_objective=jnp.array([0.5]),
    objective=jnp.array([0.25]),
    trace=Trace(*(jnp.array([[5.0, 4, 3]]),) * 3, jnp.array([[11, 21, 31]])),
    path=jnp.zeros((1, 3, 10)),
    iterations=jnp.array([3]),
    stop=jnp.array([StopReason.TOLX]),
)


def write_folder(folder):
    """What `demo` leaves, but for the picture, and keyframes beside it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(output, "overview", lambda *args, **settings: None)
        write_result(folder, OBSERVATION, RECONSTRUCTION, {"object": "a chair", "seconds": 12.34})
    (folder / "keyframes").mkdir()
    poses = [pose(i) for i in range(len(STATUSES))]
    frames = [
        {
            "index": i,
            "name": f"frame-{i}",
            "status": status,
            "reason": "only 12 % agree" if status == "lost" else "",
            "T_world_camera": None if status in ("lost", "unreadable") else poses[i].tolist(),
        }
        for i, status in enumerate(STATUSES)
    ]
    keyframes = [_keyframe(folder, i, poses[i]) for i, s in enumerate(STATUSES) if s == "keyframe"]
    about = {"intrinsics": [50, 50, 32, 24], "shape": [48, 64]}
    write_json(folder / "keyframes.json", about | {"keyframes": keyframes, "frames": frames})


def pose(index):
    """T_world_camera of a frame: each a little farther to the side."""
    aside = np.eye(4)
    aside[0, 3] = 0.1 * index
    return T_WORLD_OBJECT @ aside @ T_OBJECT_CAMERA


def _keyframe(folder, index, T_world_camera):
    name = f"frame-{index}"
    row, column = np.mgrid[:48, :64]
    inside = (abs(row - 24) < 12) & (abs(column - 32) < 12)
    color = np.where(inside[..., None], (180, 90, 40), (200, 210, 220)).astype(np.uint8)
    depth = np.where(inside, 1900, 2500).astype(np.uint16)
    files = {k: f"keyframes/{name}{end}" for k, end in
             {"image": ".jpg", "depth": ".depth.png", "mask": ".mask.png"}.items()}  # fmt: skip
    Image.fromarray(color).save(folder / files["image"])
    Image.fromarray(depth).save(folder / files["depth"])
    Image.fromarray(inside.astype(np.uint8) * 255).save(folder / files["mask"])
    return {
        "index": index,
        "name": name,
        "T_world_camera": T_world_camera.tolist(),
        **files,
        "inlier_fraction": 0.87,
        "rmse": 0.0042,
        "conditioning": 31.5,
        "seconds": {"track": 0.11, "fuse": 0.22, "refine": 1.33},
        "objective": 0.4567,
        "iou": 0.789,
    }


def write_json(path, content):
    path.write_text(json.dumps(content))


def change_json(path, **changed):
    write_json(path, json.loads(path.read_text()) | changed)
