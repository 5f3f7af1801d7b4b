"""What the reconstruction of a recording leaves on disk, while it runs and when it ends. [host]

    state.npz        all that a run needs to go on after its last frame; removed when it ends
    keyframes/       pictures of the keyframes
    keyframes.json   the camera, the keyframes and what became of every frame
    trajectory.txt   T_world_camera of the frames: TUM's format
    trajectory.log   the same, Open3D's
    mesh.glb, mesh.ply, grid.npz, trace.npz, result.json: see `output`

Every file is replaced at once, when the new one is whole, so that `jaxshape view` can watch.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from PIL import Image

from jaxshape.data.boxes import Box
from jaxshape.data.sequences import (
    Sequence,
    SequenceError,
    Trajectory,
    write_trajectory,
)
from jaxshape.files import atomic_path, write_json
from jaxshape.geometry import fusion
from jaxshape.mapping.map.recording import FrameLog, Progress, trajectory
from jaxshape.mapping.map.state import MapState, assemble
from jaxshape.mapping.placement.finding import Start, room
from jaxshape.mapping.placement.placing import Placement
from jaxshape.mapping.tracking.keyframes import (
    Keyframe,
    Place,
    PreparedFrame,
    keyframe_of,
    place_of,
    prepare,
)
from jaxshape.model.shapes import ShapePrior
from jaxshape.results.output import Observation, write_shape

STATE = "state.npz"
FRAMES_TO_SHOW = 6


def write_progress(
    folder: Path,
    sequence: Sequence,
    progress: Progress,
    figures: dict[str, Any],
    min_hits: int,
    *,
    running: bool,
) -> dict[str, Any]:
    """Write all but the checkpoint, as far as there is something; returns result.json."""
    _write_pictures(folder / "keyframes", sequence, progress)
    _write_trajectory(folder, sequence, progress)
    observation = observation_of(progress.state, min_hits)
    start = progress.start
    result = {**figures, **counts(progress), "notes": start.notes, "warnings": start.warnings}
    result["box"] = {
        "T_world_object": start.box.T_world_object.tolist(),
        "size": start.box.size.tolist(),
    }
    if running:
        result["running"] = True
    if progress.shape is not None:
        result = write_shape(folder, observation, progress.shape, result)
    write_json(folder / "keyframes.json", _keyframes(sequence, progress))
    write_json(folder / "result.json", result)
    return result


def observation_of(state: MapState, min_hits: int) -> Observation:
    """What the keyframes of a map measured of the object."""
    every = max(1, len(state.keyframes) // FRAMES_TO_SHOW)
    shown = state.keyframes[::every][:FRAMES_TO_SHOW]
    return Observation(
        depth=[_crop(np.asarray(one.depth), np.asarray(one.segmented)) for one in shown],
        occupied=np.asarray(fusion.occupied(state.measurement, min_hits)),
        occluded=np.asarray(fusion.occluded(state.measurement, min_hits)),
        frame=state.place.frame,
        T_world_object=state.place.box.T_world_object,
        truth=None,
    )


def counts(progress: Progress) -> dict[str, int]:
    """How many frames there were, and what became of them."""
    statuses = [log.status for log in progress.logs]
    return {
        "frames": len(statuses),
        "frames_tracked": statuses.count("tracked") + statuses.count("keyframe"),
        "frames_lost": statuses.count("lost"),
        "frames_unreadable": statuses.count("unreadable"),
        "keyframes": len(progress.state.keyframes),
    }


def _crop(depth: np.ndarray, segmented: np.ndarray) -> np.ndarray:
    """The part of a depth image that shows the object; all else as background."""
    if not segmented.any():
        return depth
    rows, columns = (np.flatnonzero(segmented.any(axis)) for axis in (1, 0))
    window = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    return np.where(segmented, depth, np.inf)[window]


# Keyframes and poses ----------------------------------------------------------------------------


def _fused(progress: Progress) -> Iterator[tuple[FrameLog, Keyframe]]:
    """What became of each keyframe, and what the map keeps of it."""
    logs = (log for log in progress.logs if log.status == "keyframe")
    return zip(logs, progress.state.keyframes, strict=True)


def _write_pictures(folder: Path, sequence: Sequence, progress: Progress) -> None:
    """Colour, depth and mask of each keyframe, at working size; those that are there stay."""
    for log, keyframe in _fused(progress):
        segmented = np.asarray(keyframe.segmented)
        _write_image(folder / f"{log.name}.mask.png", segmented.astype(np.uint8) * 255)
        if (folder / f"{log.name}.depth.png").exists():
            continue
        depth = np.asarray(keyframe.depth)
        millimetres = np.rint(np.where(np.isfinite(depth), depth * 1000, 0)).clip(0, 65534)
        _write_image(folder / f"{log.name}.depth.png", millimetres.astype(np.uint16))
        color = sequence[log.index].color
        if color is not None:
            h, w = segmented.shape
            with atomic_path(folder / f"{log.name}.jpg") as path:
                Image.fromarray(color).resize((w, h), Image.Resampling.BOX).save(path, quality=85)


def _write_image(path: Path, pixels: np.ndarray) -> None:
    with atomic_path(path) as temporary:
        Image.fromarray(pixels).save(temporary)


def _keyframes(sequence: Sequence, progress: Progress) -> dict[str, Any]:
    poses = trajectory(progress)
    first = progress.state.keyframes[0]
    return {
        "intrinsics": [round(float(x), 4) for x in first.intrinsics],
        "shape": list(first.depth.shape),
        "keyframes": [
            {
                **_frame_entry(log, poses),
                "depth": f"keyframes/{log.name}.depth.png",
                "mask": f"keyframes/{log.name}.mask.png",
                **({"image": f"keyframes/{log.name}.jpg"} if sequence.files[log.index].color
                   else {}),
                "object_pixels": int(np.sum(keyframe.segmented)),
                **log.figures,
            }
            for log, keyframe in _fused(progress)
        ],
        "frames": [_frame_entry(log, poses) for log in progress.logs],
    }  # fmt: skip


def _frame_entry(log: FrameLog, poses: dict[int, np.ndarray]) -> dict[str, Any]:
    pose = poses.get(log.index)
    return {
        "index": log.index,
        "name": log.name,
        "status": log.status,
        "reason": log.reason,
        "T_world_camera": None if pose is None else pose.tolist(),
    }


def _write_trajectory(folder: Path, sequence: Sequence, progress: Progress) -> None:
    poses = trajectory(progress)
    index = np.array(sorted(poses))
    times = None if sequence.times is None else sequence.times[index]
    found = Trajectory(np.stack([poses[i] for i in index]), index, times)
    write_trajectory(folder / "trajectory.txt", found)
    write_trajectory(folder / "trajectory.log", found)


# The checkpoint ---------------------------------------------------------------------------------


def save_state(folder: Path, progress: Progress, settings: dict[str, Any]) -> None:
    """Keep what a later run with the same settings needs to go on from here."""
    state, start = progress.state, progress.start
    arrays: dict[str, Any] = {
        "about": json.dumps(
            {
                "settings": settings,
                "index": start.index,
                "notes": start.notes,
                "warnings": start.warnings,
                "floor": start.floor,
                "poses_are_given": state.poses_are_given,
                "logs": [log._replace(T_keyframe_camera=None) for log in progress.logs],
            }
        ),
        "T_keyframe_camera": np.stack(
            [np.full((4, 4), np.nan) if log.T_keyframe_camera is None else log.T_keyframe_camera
             for log in progress.logs]
        ),
        "code": state.code,
        "logits": state.logits,
        "T_world_camera": state.T_world_camera.wxyz_xyz,
        "T_before_last": state.T_before_last.wxyz_xyz,
        "start": start.T_world_camera,
        "box": start.box.T_world_object,
        "size": start.box.size,
        "exclude": start.box.exclude,
    }  # fmt: skip
    for name in ("T_world_camera", "T_previous_keyframe"):
        poses = [getattr(one, name).wxyz_xyz for one in state.keyframes]
        arrays[f"keyframes.{name}"] = np.stack(poses)
    arrays["keyframes.information"] = np.stack([one.information for one in state.keyframes])
    # Which pixels they are depended on poses and boxes that are no more.
    for name in ("masked", "segmented"):
        pixels = np.stack([np.asarray(getattr(one, name)) for one in state.keyframes])
        arrays[f"keyframes.{name}"] = np.packbits(pixels, axis=-1)
    if start.masked is not None:
        arrays["masked"] = start.masked
    if start.T_level_world is not None:
        arrays["T_level_world"] = start.T_level_world
    if start.placement is not None:
        leaves = jax.tree.leaves(start.placement)
        arrays |= {f"placement.{i}": leaf for i, leaf in enumerate(leaves)}
    with atomic_path(folder / STATE) as path:
        np.savez(path, **jax.device_get(arrays))


def load_state(
    folder: Path,
    sequence: Sequence,
    prior: ShapePrior,
    settings: dict[str, Any],
    *,
    isotropic: bool,
) -> Progress | None:
    """The progress of a run that was cut short; None where there is none.

    Raises `SequenceError` where that run had other settings, or the file is not what it should be.
    """
    path = folder / STATE
    if not path.is_file():
        return None
    try:
        with np.load(path) as file:
            kept = dict(file)
        about = json.loads(str(kept["about"]))
    except (OSError, EOFError, BadZipFile, ValueError, KeyError) as problem:
        raise SequenceError(
            f"{path} cannot be read ({problem}); remove it, or add --fresh to begin anew."
        ) from problem
    if about["settings"] != json.loads(json.dumps(settings)):
        raise SequenceError(
            f"{folder} holds an unfinished reconstruction with other settings; give the same ones "
            "to go on, another --output, or --fresh to begin anew."
        )
    start = _start(kept, about)
    logs = tuple(
        FrameLog(*log)._replace(T_keyframe_camera=None if np.isnan(T).any() else T)
        for log, T in zip(about["logs"], kept["T_keyframe_camera"], strict=True)
    )
    place = place_of(start.box, room(start), isotropic=isotropic)
    return Progress(_state(kept, about, start, place, logs, sequence, prior), start, logs)


def _start(kept: dict[str, np.ndarray], about: dict[str, Any]) -> Start:
    placed = [kept[f"placement.{i}"] for i in range(len(Placement._fields))
              if f"placement.{i}" in kept]  # fmt: skip
    return Start(
        index=about["index"],
        masked=kept.get("masked"),
        box=Box(kept["box"], kept["size"], kept["exclude"]),
        T_world_camera=kept["start"],
        T_level_world=kept.get("T_level_world"),
        floor=about["floor"],
        placement=Placement(jaxlie.SE3(jnp.asarray(placed[0])), *map(jnp.asarray, placed[1:]))
        if placed
        else None,
        notes=tuple(about["notes"]),
        warnings=tuple(about["warnings"]),
    )


def _state(
    kept, about, start: Start, place: Place, logs, sequence: Sequence, prior: ShapePrior
) -> MapState:
    indices = [log.index for log in logs if log.status == "keyframe"]
    keyframes: list[Keyframe] = []
    view = None
    for number, index in enumerate(indices):
        view = prepare(sequence[index], sequence.intrinsics).view
        masked, segmented = (
            jnp.asarray(np.unpackbits(packed, axis=-1, count=view.depth.shape[1]).astype(bool))
            for packed in (kept[f"keyframes.{name}"][number] for name in ("masked", "segmented"))
        )
        T, T_previous = (
            jaxlie.SE3(jnp.asarray(kept[f"keyframes.{name}"][number]))
            for name in ("T_world_camera", "T_previous_keyframe")
        )
        information = jnp.asarray(kept["keyframes.information"][number])
        odometry = T_previous, information
        keyframes.append(keyframe_of(PreparedFrame(view, masked), place, T, odometry, segmented))
    assert view is not None
    return assemble(
        prior,
        place,
        tuple(keyframes),
        view,
        code=jnp.asarray(kept["code"]),
        logits=jnp.asarray(kept["logits"]),
        T_world_camera=jaxlie.SE3(jnp.asarray(kept["T_world_camera"])),
        T_before_last=jaxlie.SE3(jnp.asarray(kept["T_before_last"])),
        poses_are_given=about["poses_are_given"],
    )


def remove_state(folder: Path) -> None:
    """Forget the checkpoint: the run has ended."""
    (folder / STATE).unlink(missing_ok=True)
