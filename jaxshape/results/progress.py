"""Files of the reconstruction of a recording, while it runs and when it ends. [host]

    keyframes/       pictures of the keyframes
    keyframes.json   the camera, the keyframes and what became of every frame
    trajectory.txt   T_world_camera of the frames: TUM's format
    trajectory.log   the same, Open3D's
    mesh.ply, mesh.glb, grid.npz, trace.npz, result.json: see `output`
    state.npz        until the run ends: see `checkpoint`

Every file is replaced at once, when the new one is whole, so that `jaxshape view` can watch.
"""

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from jaxshape.data.sequences import Sequence, SequenceError, Trajectory, write_trajectory
from jaxshape.data.sequences.cameras import intrinsic_numbers
from jaxshape.files import atomic_path, write_json
from jaxshape.geometry.distance import DistanceField
from jaxshape.geometry.grids import binary
from jaxshape.mapping.map.doubts import doubts_of, unseen_of
from jaxshape.mapping.map.recording import FrameLog, Progress, trajectory
from jaxshape.mapping.map.state import MapState, grids_of
from jaxshape.mapping.placement.finding import Start
from jaxshape.mapping.tracking.keyframes import Keyframe
from jaxshape.results.coloring import ColorView
from jaxshape.results.output import Observation, write_shape
from jaxshape.results.verdict import SeenView

FRAMES_TO_SHOW = 6


def write_progress(
    folder: Path,
    sequence: Sequence,
    progress: Progress,
    figures: dict[str, Any],
    *,
    running: bool,
    usual: tuple[float, float, float] | None = None,
) -> dict[str, Any]:
    """Write all available files of a reconstruction except the checkpoint.

    Args:
        folder: The result folder.
        sequence: The recording.
        progress: Progress of the run.
        figures: Further entries of `result.json`.
        running: Whether the run goes on.
        usual: Usual extents of the object's class `[3]`, in metres; None where they are not known.

    Returns:
        Content of `result.json`.
    """
    write_pictures(folder / "keyframes", sequence, progress)
    write_trajectories(folder, sequence, progress)
    observation = observation_of(progress.state)
    if observation.field is not None:
        observation = observation._replace(views=color_views(sequence, progress))
    start = progress.start
    if not running:
        keyframes, floor = seen_views(progress.state), floor_height(start)
        observation = observation._replace(
            keyframes=keyframes, floor=floor, unseen=unseen_of(progress), usual=usual
        )
    warnings = [*figures.get("warnings", ()), *start.warnings, *doubts_of(progress)]
    result = {**figures, **counts(progress), "notes": start.notes, "warnings": warnings}
    result["box"] = {
        "T_world_object": start.box.T_world_object.tolist(),
        "size": start.box.size.tolist(),
    }
    if running:
        result["running"] = True
    if progress.shape is not None:
        result = write_shape(folder, observation, progress.shape, result)
    write_json(folder / "keyframes.json", keyframe_entries(sequence, progress))
    write_json(folder / "result.json", result)
    return result


def observation_of(state: MapState) -> Observation:
    """Measurement of the object by the keyframes of a map."""
    soft = grids_of(state)
    grids = binary(soft)
    field = state.measurement if isinstance(state.measurement, DistanceField) else None
    every = max(1, len(state.keyframes) // FRAMES_TO_SHOW)
    shown = state.keyframes[::every][:FRAMES_TO_SHOW]
    return Observation(
        depth=[_crop(np.asarray(one.depth), np.asarray(one.segmented)) for one in shown],
        occupied=np.asarray(grids.occupied),
        occluded=np.asarray(grids.occluded),
        frame=state.place.frame,
        T_world_object=state.place.box.T_world_object,
        truth=None,
        field=field,
        soft=None if field is None else soft,
        sensor=state.fusing.sensor,
    )


def seen_views(state: MapState) -> tuple[SeenView, ...]:
    """The keyframes of a map, in the form that is compared with a mesh in the object frame."""
    T_object_world = np.linalg.inv(state.place.box.T_world_object)

    def seen(one: Keyframe) -> SeenView:
        fx, fy, cx, cy = map(float, one.intrinsics)
        T_object_camera = T_object_world @ np.asarray(one.T_world_camera.as_matrix(), np.float64)
        depth, segmented = np.asarray(one.depth), np.asarray(one.segmented)
        return SeenView(depth, segmented, (fx, fy, cx, cy), T_object_camera)

    return tuple(map(seen, state.keyframes))


def floor_height(start: Start) -> float:
    """y of the floor in the object frame, which stands upright on it; NaN where it is not known."""
    if start.T_level_world is None:
        return np.nan
    return start.floor - float((start.T_level_world @ start.box.T_world_object)[1, 3])


def color_views(sequence: Sequence, progress: Progress) -> Iterator[ColorView]:
    """The keyframes that have colours, at their present poses, read one after the other."""
    T_object_world = np.linalg.inv(progress.state.place.box.T_world_object)
    for log, keyframe in _fused(progress):
        try:
            frame = sequence[log.index]
        except SequenceError:  # it could be read before
            continue
        if frame.color is not None:
            T_world_camera = np.asarray(keyframe.T_world_camera.as_matrix(), np.float64)
            camera = intrinsic_numbers(frame.intrinsics)
            yield ColorView(frame.color, frame.depth, camera, T_object_world @ T_world_camera)


def counts(progress: Progress) -> dict[str, int]:
    """Numbers of frames, in all and by status."""
    statuses = [log.status for log in progress.logs]
    return {
        "frames": len(statuses),
        "frames_tracked": statuses.count("tracked") + statuses.count("keyframe"),
        "frames_lost": statuses.count("lost"),
        "frames_unreadable": statuses.count("unreadable"),
        "keyframes": sum(1 for _ in _fused(progress)),
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
    """The keyframes that show the object."""
    return (pair for pair in progress.of_keyframes() if np.asarray(pair[1].segmented).any())


def write_pictures(folder: Path, sequence: Sequence, progress: Progress) -> None:
    """Write colour, depth and mask of each keyframe at working size; existing pictures stay.

    Args:
        folder: The folder of the pictures.
        sequence: The recording.
        progress: Progress of the run.
    """
    for log, keyframe in _fused(progress):
        segmented = np.asarray(keyframe.segmented)
        _write_image(folder / f"{log.name}.mask.png", segmented.astype(np.uint8) * 255)
        if (folder / f"{log.name}.depth.png").exists():
            continue
        depth = np.asarray(keyframe.depth)
        millimetres = np.rint(np.where(np.isfinite(depth), depth * 1000, 0)).clip(0, 65534)
        _write_image(folder / f"{log.name}.depth.png", millimetres.astype(np.uint16))
        color = None
        with suppress(SequenceError):  # it could be read before
            color = sequence[log.index].color
        if color is not None:
            h, w = segmented.shape
            with atomic_path(folder / f"{log.name}.jpg") as path:
                Image.fromarray(color).resize((w, h), Image.Resampling.BOX).save(path, quality=85)


def _write_image(path: Path, pixels: np.ndarray) -> None:
    with atomic_path(path) as temporary:
        Image.fromarray(pixels).save(temporary)


def keyframe_entries(sequence: Sequence, progress: Progress) -> dict[str, Any]:
    """The content of keyframes.json.

    Args:
        sequence: The recording.
        progress: Progress of the run.
    """
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
        "frames": [_frame_entry(log, poses) for log in _as_fused(progress)],
    }  # fmt: skip


def _as_fused(progress: Progress) -> Iterator[FrameLog]:
    """The logs of all frames; a keyframe without the object counts as tracked only."""
    fused = {log.index for log, _ in _fused(progress)}
    reason = "no pixel was segmented as the object"
    for log in progress.logs:
        is_empty = log.status == "keyframe" and log.index not in fused
        yield log._replace(status="tracked", reason=reason) if is_empty else log


def _frame_entry(log: FrameLog, poses: dict[int, np.ndarray]) -> dict[str, Any]:
    pose = poses.get(log.index)
    return {
        "index": log.index,
        "name": log.name,
        "status": log.status,
        "reason": log.reason,
        "T_world_camera": None if pose is None else pose.tolist(),
    }


def write_trajectories(folder: Path, sequence: Sequence, progress: Progress) -> None:
    """Write trajectory.txt and trajectory.log.

    Args:
        folder: The result folder.
        sequence: The recording.
        progress: Progress of the run.
    """
    poses = trajectory(progress)
    index = np.array(sorted(poses))
    times = None if sequence.times is None else sequence.times[index]
    found = Trajectory(np.stack([poses[i] for i in index]), index, times)
    write_trajectory(folder / "trajectory.txt", found)
    write_trajectory(folder / "trajectory.log", found)
