"""The checkpoint of a reconstruction: all that a killed run needs to go on. [host]

It lies in `state.npz` of the result folder, and is removed when the run ends.
"""

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from jaxshape import reading
from jaxshape.data.boxes import Box
from jaxshape.data.sequences import Sequence, SequenceError
from jaxshape.files import atomic_path
from jaxshape.mapping.config import MappingConfig
from jaxshape.mapping.map.cutting import parts_in
from jaxshape.mapping.map.recording import FrameLog, Progress
from jaxshape.mapping.map.state import MapState, assemble
from jaxshape.mapping.placement.finding import Start, room
from jaxshape.mapping.placement.placing import Placement
from jaxshape.mapping.tracking.keyframes import Keyframe, keyframe_of, place_of, prepare
from jaxshape.model.shapes import ShapePrior

STATE = "state.npz"


def save_state(folder: Path, progress: Progress, settings: dict[str, Any]) -> None:
    """Keep all data that a later run with the same settings needs to go on from here.

    Args:
        folder: The result folder.
        progress: Progress of the run.
        settings: Settings of the run, as JSON can hold them.
    """
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
    # These pixels depended on poses and boxes that no longer exist.
    for name in ("masked", "segmented"):
        pixels = np.stack([np.asarray(getattr(one, name)) for one in state.keyframes])
        arrays[f"keyframes.{name}"] = np.packbits(pixels, axis=-1)
    for name in ("masked", "core"):
        if getattr(start, name) is not None:
            arrays[name] = getattr(start, name)
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
    mapping: MappingConfig,
) -> Progress | None:
    """The progress of a run that was cut short.

    Args:
        folder: The result folder.
        sequence: The recording of the run.
        prior: The shape prior of the run.
        settings: Settings of the run, as given to `save_state`.
        mapping: Settings of mapping of the run.

    Returns:
        The progress; None where there is none.

    Raises:
        SequenceError: That run had other settings, or the file is damaged.
    """
    path = folder / STATE
    if not path.is_file():
        return None
    try:
        kept = reading.read_arrays(path)
        about = reading.parse_json(str(kept["about"]))
        is_ours = about["settings"] == json.loads(json.dumps(settings))
    except (OSError, ValueError, KeyError, TypeError) as problem:
        raise _damaged(path, problem) from problem
    if not is_ours:
        raise SequenceError(
            f"{folder} holds an unfinished reconstruction with other settings; give the same "
            "settings to resume it, another --output, or --fresh to start over."
        )
    try:
        start = _start(kept, about)
        logs = tuple(
            FrameLog(*log)._replace(T_keyframe_camera=None if np.isnan(T).any() else T)
            for log, T in zip(about["logs"], kept["T_keyframe_camera"], strict=True)
        )
        return Progress(_state(kept, about, start, logs, sequence, prior, mapping), start, logs)
    except SequenceError:  # a frame that could be read before
        raise
    except (ValueError, KeyError, TypeError, IndexError) as problem:
        raise _damaged(path, problem) from problem


def _damaged(path: Path, problem: Exception) -> SequenceError:
    return SequenceError(
        f"{path} cannot be read ({problem}); remove it, or add --fresh to start over."
    )


def _start(kept: dict[str, np.ndarray], about: dict[str, Any]) -> Start:
    placed = [kept[f"placement.{i}"] for i in range(len(Placement._fields))
              if f"placement.{i}" in kept]  # fmt: skip
    return Start(
        index=about["index"],
        masked=kept.get("masked"),
        core=kept.get("core"),
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
    kept, about, start: Start, logs, sequence: Sequence, prior: ShapePrior, mapping: MappingConfig
) -> MapState:
    place = place_of(start.box, prior.resolution, room(start), isotropic=mapping.isotropic)
    indices = [log.index for log in logs if log.status == "keyframe"]
    keyframes: list[Keyframe] = []
    view = None
    for number, index in enumerate(indices):
        frame = sequence[index]
        prepared = prepare(frame)
        view = prepared.view
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
        prepared = prepared._replace(masked=masked)
        if start.T_level_world is not None and frame.mask is None:
            prepared = prepared._replace(parts=parts_in(prepared, None if number else start.core))
        keyframes.append(keyframe_of(prepared, place, T, odometry, segmented))
    assert view is not None
    return assemble(
        prior,
        place,
        tuple(keyframes),
        view,
        mapping,
        code=jnp.asarray(kept["code"]),
        logits=jnp.asarray(kept["logits"]),
        T_world_camera=jaxlie.SE3(jnp.asarray(kept["T_world_camera"])),
        T_before_last=jaxlie.SE3(jnp.asarray(kept["T_before_last"])),
        poses_are_given=about["poses_are_given"],
    )


def remove_state(folder: Path) -> None:
    """Forget the checkpoint: the run has ended."""
    (folder / STATE).unlink(missing_ok=True)
