"""The files of one reconstruction: mesh, grids, trace, figures and a picture. [host]"""

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import trimesh
from jaxtyping import Array, Bool, Float

from jaxshape.files import atomic_path
from jaxshape.geometry.grid import GridFrame
from jaxshape.report.pictures import grid_panel, measurement_panel, mesh_panel, overview
from jaxshape.results.metrics import iou
from jaxshape.results.surface import surface, write_mesh
from jaxshape.results.traces import write_trace
from jaxshape.search.reconstruction import Reconstruction
from jaxshape.search.refiner import StopReason

SMOOTHING = 20
"""Rounds of Taubin's filter that take the staircase off a boolean grid."""


class Observation(NamedTuple):
    """What was measured of one object, and where its grid lies."""

    depth: Sequence[Float[np.ndarray, "_ _"]]
    """A few depth frames to show, in metres."""
    occupied: Bool[np.ndarray, "x y z"]
    occluded: Bool[np.ndarray, "x y z"]
    frame: GridFrame
    T_world_object: Float[np.ndarray, "4 4"]
    truth: Bool[np.ndarray, "x y z"] | None
    """The complete surface, where it is known."""


def write_result(
    folder: str | os.PathLike[str],
    observation: Observation,
    reconstruction: Reconstruction,
    figures: dict[str, Any],
) -> dict[str, Any]:
    """Write `overview.png` and the files of `write_shape`, then `result.json`, of ONE object.

    `result.json` holds `figures`, the objective before and after, what the search took and why it
    stopped, and the IoUs where the truth is known; it is returned.
    """
    folder = Path(folder)
    result = write_shape(folder, observation, reconstruction, figures)
    draw(folder, observation, reconstruction, result)
    with atomic_path(folder / "result.json") as path:
        path.write_text(json.dumps(result, indent=2))
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
    one = _only(reconstruction)
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


def draw(
    folder: Path, observation: Observation, reconstruction: Reconstruction, result: dict[str, Any]
) -> None:
    """Write `overview.png`."""
    _draw(folder / "overview.png", observation, _only(reconstruction), result)


def _only(reconstruction: Reconstruction) -> Any:
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


def _draw(path: Path, observation: Observation, one: Any, result: dict[str, Any]) -> None:
    def note(name: str) -> str:
        return f"IoU {result[name]:.2f}" if name in result else ""

    composed = np.where(observation.occluded, 2 * one.composed, observation.occupied.astype(int))
    columns = [
        measurement_panel("F (blue) and M", observation.occupied, observation.occluded),
        grid_panel("encoder", one.completed_first, "predicted", note=note("iou_encoder")),
        grid_panel("refined", one.completed, "predicted", note=note("iou_refined")),
        grid_panel("composed", composed, "measured", "predicted", note=note("iou_composed")),
        _mesh_panel(observation, one),
    ]
    if observation.truth is not None:
        columns.append(grid_panel("truth", observation.truth, "truth"))
    overview(path, depth_frames=observation.depth, columns=columns)


def _mesh_panel(observation: Observation, one: Any):
    mesh: trimesh.Trimesh = surface(one.composed, observation.frame, smoothing=SMOOTHING)
    return mesh_panel("mesh", mesh, "predicted")
