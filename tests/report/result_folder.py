"""A small result folder, as a reconstruction of several keyframes leaves it."""

import json

import jax.numpy as jnp
import jaxlie
import numpy as np
from made_result import T_WORLD_OBJECT, observation, reconstruction, solid
from PIL import Image

from jaxshape.data.boxes import Box
from jaxshape.data.sequences import Sequence
from jaxshape.data.sequences.frames import FrameFiles
from jaxshape.geometry.camera import Intrinsics
from jaxshape.geometry.fusion import Measurement
from jaxshape.geometry.grid import GridFrame
from jaxshape.mapping.config import MappingConfig
from jaxshape.mapping.map.recording import FrameLog, Progress
from jaxshape.mapping.map.state import MapState, fusing_of
from jaxshape.mapping.placement.finding import Start
from jaxshape.mapping.tracking.keyframes import Keyframe, Place
from jaxshape.results.output import write_result
from jaxshape.results.progress import write_progress

T_OBJECT_CAMERA = np.array([[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 2], [0, 0, 0, 1]], float)
"""In front of the object, upright, looking at it."""

KEYFRAMES = 3
STATUSES = ("keyframe", "tracked", "keyframe", "lost", "unreadable", "tracked", "keyframe")
SHAPE, INTRINSICS = (48, 64), (50.0, 50.0, 32.0, 24.0)
ROW, COLUMN = np.mgrid[: SHAPE[0], : SHAPE[1]]
INSIDE = (abs(ROW - 24) < 12) & (abs(COLUMN - 32) < 12)
FIGURES = {
    "seconds_track": 0.11,
    "seconds_fuse": 0.22,
    "seconds_refine": 1.33,
    "inlier_fraction": 0.87,
    "overlap": 0.64,
    "rmse": 0.0042,
    "conditioning": 0.0315,
}


def chair(seat: int, back: int):
    """A seat, four legs and a back, as thick as asked for."""
    legs = [solid((x, 1, z), (x + 3, 14, z + 3)) for x in (4, 25) for z in (4, 25)]
    slab = solid((4, 14, 4), (28, 14 + seat, 28)) | solid((4, 14, 4), (28, 31, 4 + back))
    return slab | np.any(legs, axis=0)


TRUTH, COMPLETED, FIRST = chair(3, 3), chair(3, 4), chair(5, 6)
OCCUPIED, OCCLUDED = TRUTH & solid((0, 0, 12), (32, 32, 32)), solid((4, 1, 4), (28, 12, 12))
FRAME = GridFrame(jnp.array([-0.32, -0.48, -0.32]), jnp.array([0.02, 0.03, 0.02]))
OBSERVATION = observation(OCCUPIED, OCCLUDED, TRUTH, FRAME)
RECONSTRUCTION = reconstruction(OBSERVATION, FIRST, COMPLETED, steps=3)


def write_folder(folder):
    """What `reconstruct` leaves, and `demo`, which knows the truth; without the overview."""
    figures = {"object": "a chair", "seconds": 12.34, "search": {"objective": "balanced"}}
    sequence = _recording(folder.parent / "recording")
    write_progress(folder, sequence, _progress(), figures, running=False)
    write_result(folder, OBSERVATION, RECONSTRUCTION, figures)


def pose(index):
    """T_world_camera of a frame: each a little farther to the side."""
    aside = np.eye(4)
    aside[0, 3] = 0.1 * index
    return T_WORLD_OBJECT @ aside @ T_OBJECT_CAMERA


def _recording(folder):
    """Its colour images, which are all that is read of it."""
    folder.mkdir(parents=True)
    color = np.where(INSIDE[..., None], (180, 90, 40), (200, 210, 220)).astype(np.uint8)
    files = [FrameFiles(f"frame-{i}", folder / f"{i}.depth.png", folder / f"{i}.color.png", None)
             for i in range(len(STATUSES))]  # fmt: skip
    for one in files:
        Image.fromarray(color).save(one.color)
        Image.fromarray(np.where(INSIDE, 1900, 2500).astype(np.uint16)).save(one.depth)
    return Sequence(
        layout="7-scenes",
        intrinsics=np.diag([50.0, 50.0, 1.0]),
        camera="given",
        files=tuple(files),
        read_pose=lambda index: None,
        has_poses=False,
        shape=SHAPE,
        depth_scale=1000.0,
    )


def _progress():
    """A map of the keyframes with what is written of it, and nothing else."""
    last, logs, keyframes = 0, [], []
    for i, status in enumerate(STATUSES):
        if status == "keyframe":
            last = i
            keyframes.append(_keyframe(pose(i)))
        there = status in ("keyframe", "tracked")
        reason = "only 12 % agree" if status == "lost" else ""
        relative = np.linalg.inv(pose(last)) @ pose(i) if there else None
        figures = FIGURES if there else {}
        number = len(keyframes) - 1
        logs.append(FrameLog(i, f"frame-{i}", status, reason, number, relative, figures))
    box = Box(T_WORLD_OBJECT, np.ones(3), np.zeros((0, 2, 3)))
    state = only(
        MapState,
        keyframes=tuple(keyframes),
        place=only(Place, box=box, frame=FRAME),
        fusing=fusing_of(MappingConfig(fusion="points", min_hits=1), 32),
        measurement=Measurement(jnp.int32(OCCUPIED), jnp.asarray(~(OCCUPIED | OCCLUDED))),
    )
    start = only(Start, box=box, notes=(), warnings=())
    return Progress(state, start, tuple(logs), RECONSTRUCTION)


def _keyframe(T_world_camera):
    return only(
        Keyframe,
        depth=jnp.where(INSIDE, 1.9, 2.5),
        segmented=jnp.asarray(INSIDE),
        intrinsics=Intrinsics(*jnp.float32(INTRINSICS)),
        T_world_camera=jaxlie.SE3.from_matrix(jnp.float32(T_world_camera)),
    )


def only(kind, **fields):
    """A named tuple of which some fields are known."""
    return kind(**dict.fromkeys(kind._fields) | fields)


def write_json(path, content):
    path.write_text(json.dumps(content))


def change_json(path, **changed):
    write_json(path, json.loads(path.read_text()) | changed)
