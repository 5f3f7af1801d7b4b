"""The files of one reconstruction: mesh, grids, trace and figures. [host]"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxshape.files import atomic_path, write_json
from jaxshape.geometry.grid import GridFrame
from jaxshape.geometry.overlap import iou
from jaxshape.results.surface import surface, write_mesh
from jaxshape.results.traces import write_trace
from jaxshape.search.reconstruction import Reconstruction
from jaxshape.search.refiner import StopReason

SMOOTHING = 20
"""Rounds of Taubin's filter that take the staircase off a boolean grid."""


class Observation(NamedTuple):
    """Measurement of one object, and the place of its grid.

    Attributes:
        depth: Some depth images to show, in metres.
        occupied: F `[x y z]`, binary.
        occluded: M `[x y z]`, binary.
        frame: Voxel frame of the grid, in the object frame.
        T_world_object: Pose of the object `[4 4]`.
        truth: Complete surface of the object `[x y z]`; None where it is not known.
    """

    depth: Sequence[Float[np.ndarray, "_ _"]]
    occupied: Bool[np.ndarray, "x y z"]
    occluded: Bool[np.ndarray, "x y z"]
    frame: GridFrame
    T_world_object: Float[np.ndarray, "4 4"]
    truth: Bool[np.ndarray, "x y z"] | None


def write_result(
    folder: str | os.PathLike[str],
    observation: Observation,
    reconstruction: Reconstruction,
    figures: dict[str, Any],
) -> dict[str, Any]:
    """Write the files of `write_shape`, then `result.json`, of ONE object.

    Args:
        folder: Where to write; made if missing.
        observation: Measurement of the object.
        reconstruction: The reconstruction, a batch of one.
        figures: Further entries of `result.json`, such as the settings.

    Returns:
        The content of `result.json`: `figures`, the objective before and after in nats per voxel,
        what the search took and why it stopped, and the IoUs where the truth is known.

    Raises:
        ValueError: Where the composed shape is empty; nothing is written.
    """
    folder = Path(folder)
    result = write_shape(folder, observation, reconstruction, figures)
    write_json(folder / "result.json", result)
    return result


def write_shape(
    folder: Path,
    observation: Observation,
    reconstruction: Reconstruction,
    figures: dict[str, Any],
) -> dict[str, Any]:
    """Write `mesh.glb`, `mesh.ply`, `grid.npz` and `trace.npz` of ONE object; returns its figures.

    The mesh is the composed shape in the world frame, in metres. The trace has a row for each
    iteration of the search; there is none of the encoder alone.
    """
    one = only(reconstruction)
    mesh = surface(
        one.composed,
        observation.frame,
        smoothing=SMOOTHING,
        T_world_object=observation.T_world_object,
    )
    write_mesh(mesh, folder / "mesh.glb")
    write_mesh(mesh, folder / "mesh.ply")
    _write_grids(folder / "grid.npz", observation, one)
    if one.trace is None:
        (folder / "trace.npz").unlink(missing_ok=True)  # of an earlier search
    else:
        write_trace(folder / "trace.npz", jax.tree.map(lambda x: x[: one.iterations], one.trace))
    return {**figures, **_searched(one), **_measured(observation, one)}


def only(reconstruction: Reconstruction) -> Any:
    """The only object of a batch of one, as NumPy arrays."""
    return jax.device_get(jax.tree.map(lambda x: x[0], reconstruction))


def _searched(one: Any) -> dict[str, Any]:
    if one.trace is None:
        return {"iterations": 0, "evaluations": 1, "stop": None}
    return {
        "iterations": int(one.iterations),
        "evaluations": int(one.trace.evaluations[-1]),
        "stop": StopReason(int(one.stop)).name.lower(),
    }


def _measured(observation: Observation, one: Any) -> dict[str, Any]:
    measured: dict[str, Any] = {
        "objective_encoder": float(one.first_objective),
        "objective_refined": float(one.objective),
        "voxels_measured": int(observation.occupied.sum()),
        "voxels_occluded": int(observation.occluded.sum()),
    }
    if observation.truth is not None:
        measured |= {
            "iou_encoder": float(iou(one.completed_first, observation.truth)),
            "iou_refined": float(iou(one.completed, observation.truth)),
            "iou_composed": float(iou(one.composed, observation.truth)),
        }
    return measured


def _write_grids(path: Path, observation: Observation, one: Any) -> None:
    arrays: dict[str, Array | np.ndarray] = {
        "occupied": observation.occupied,
        "occluded": observation.occluded,
        "encoder": one.completed_first,
        "refined": one.completed,
        "composed": one.composed,
        "logits": one.logits,
        "code": one.code,
        "origin": np.asarray(observation.frame.origin),
        "voxel_size": np.asarray(observation.frame.voxel_size),
        "T_world_object": observation.T_world_object,
    }
    if observation.truth is not None:
        arrays["truth"] = observation.truth
    with atomic_path(path) as temporary:
        np.savez_compressed(temporary, **arrays)  # pyright: ignore[reportArgumentType]
