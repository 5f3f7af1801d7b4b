"""The files of one reconstruction: mesh, grids, trace and figures. [host]"""

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import trimesh
from jaxtyping import Array, Bool, Float, UInt8

from jaxshape.files import atomic_path, write_json
from jaxshape.geometry.distance import DistanceField
from jaxshape.geometry.grid import GridFrame
from jaxshape.geometry.grids import Grids
from jaxshape.geometry.overlap import iou
from jaxshape.geometry.pixels import Sensor
from jaxshape.mapping.map.doubts import ALL_SEEN, Unseen
from jaxshape.results.coloring import ColorView, color_vertices
from jaxshape.results.confidence import confidence_at
from jaxshape.results.fused_surface import fuse_surface
from jaxshape.results.surface import surface, write_mesh
from jaxshape.results.traces import write_trace
from jaxshape.results.verdict import SeenView, judged, quality_of, quality_of_cloud
from jaxshape.search.reconstruction import Reconstruction
from jaxshape.search.refiner import StopReason

SMOOTHING = 20
"""Number of rounds of Taubin's filter that smooth the steps of a boolean grid."""


COLOR_REACH = 2.0
"""Distance, in voxels, over which measured vertices that no frame shows take over a nearby colour.
"""


class Observation(NamedTuple):
    """Measurement of one object, and the place of its grid.

    Attributes:
        depth: Some depth images to show, in metres.
        occupied: F `[x y z]`, binary.
        occluded: M `[x y z]`, binary.
        frame: Voxel frame of the grid, in the object frame.
        T_world_object: Pose of the object `[4 4]`.
        truth: Complete surface of the object `[x y z]`; None where it is not known.
        field: Fused signed distances, whose surface becomes the mesh where something was measured;
            None makes the mesh from the composed grid.
        views: Frames that give the mesh its colours, read once; without frames it has no colours.
        sensor: How the noise of depth grows.
        keyframes: The keyframes that the mesh is judged by; without any it is not judged.
        floor: Height of the floor in the object frame, in metres; NaN where it is not known.
        unseen: Parts of the object that no keyframe saw, or of which the cloud shows nothing.
        usual: Usual extents of its class `[3]`, in metres; None where they are not known.
        soft: F and M as given to the prior; `occupied` and `occluded` are their rounded values.
            None for binary ones.
        cloud: Points in the object frame that the mesh is judged by where there are no keyframes
            `[n 3]`, in metres; None leaves it unjudged.
    """

    depth: Sequence[Float[np.ndarray, "_ _"]]
    occupied: Bool[np.ndarray, "x y z"]
    occluded: Bool[np.ndarray, "x y z"]
    frame: GridFrame
    T_world_object: Float[np.ndarray, "4 4"]
    truth: Bool[np.ndarray, "x y z"] | None
    field: DistanceField | None = None
    views: Iterable[ColorView] = ()
    sensor: Sensor = Sensor()
    keyframes: Sequence[SeenView] = ()
    floor: float = np.nan
    unseen: Unseen = ALL_SEEN
    usual: tuple[float, float, float] | None = None
    soft: Grids | None = None
    cloud: Float[np.ndarray, "n 3"] | None = None


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
        what the search took and why it stopped, the share of the mesh's area that was measured and
        the number of loose pieces that were left out, whether hidden parts were filled from their
        mirror image and the share of the measured halves that agrees, and the IoUs where the truth
        is known.

    Raises:
        ValueError: Where the shape is empty; nothing is written.
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

    `mesh.ply` lies in the world, `mesh.glb` in the object frame: +y is up in its standard. Both are
    in metres. The trace has a row for each iteration of the search; without a search, there is no
    trace.
    """
    return write_shape_mesh(folder, observation, reconstruction, figures)[0]


def write_shape_mesh(
    folder: Path,
    observation: Observation,
    reconstruction: Reconstruction,
    figures: dict[str, Any],
) -> tuple[dict[str, Any], "ShapeMesh"]:
    """Write what `write_shape` writes; returns its figures and the mesh."""
    one = only(reconstruction)
    found = shape_mesh(observation, one.composed, one.fill_logits, one.probability)
    flags = {"measured": found.measured, "color": found.color, "confidence": found.confidence}
    write_mesh(found.mesh, folder / "mesh.glb", **flags)
    world = found.mesh.copy().apply_transform(observation.T_world_object)
    write_mesh(world, folder / "mesh.ply", **flags)
    _write_grids(folder / "grid.npz", observation, one)
    if one.trace is None:
        (folder / "trace.npz").unlink(missing_ok=True)  # of an earlier search
    else:
        write_trace(folder / "trace.npz", jax.tree.map(lambda x: x[: one.iterations], one.trace))
    figures = {**figures, **_searched(one), **_of_mesh(found), **_measured(observation, one)}
    if observation.keyframes or observation.cloud is not None:
        figures |= _judged(observation, found, bool(one.symmetric))
    return figures, found


class ShapeMesh(NamedTuple):
    """The mesh of a result.

    Attributes:
        mesh: In the object frame, in metres.
        measured: True for vertices on the measured surface, False for predicted ones; None for the
            mesh of a composed grid.
        color: Colours of the vertices; None where no frame has colours.
        dropped: Number of loose pieces that were left out.
        confidence: Probability that there is surface at each vertex, from 0 to 1; None where the
            probability of the shape is not known.
    """

    mesh: trimesh.Trimesh
    measured: Bool[np.ndarray, " n"] | None
    color: UInt8[np.ndarray, "n 3"] | None
    dropped: int
    confidence: Float[np.ndarray, " n"] | None = None


def shape_mesh(
    observation: Observation,
    composed: Bool[np.ndarray, "x y z"],
    logits: Float[np.ndarray, "x y z"],
    probability: Float[np.ndarray, "x y z"] | None = None,
) -> ShapeMesh:
    """The mesh of the measured surface and, elsewhere, of the decoded shape.

    Args:
        observation: Measurement of the object.
        composed: The composed grid, which makes the mesh where there are no signed distances.
        logits: Logits of the shape that fills the unmeasured parts.
        probability: Probability that each voxel is surface; None leaves the mesh without
            confidence.

    Raises:
        ValueError: The shape is empty.
    """
    frame = observation.frame
    sure = lambda mesh: (  # noqa: E731
        None if probability is None else confidence_at(mesh.vertices, probability, frame)
    )
    if observation.field is None:
        mesh = surface(composed, frame, smoothing=SMOOTHING)
        return ShapeMesh(mesh, None, None, 0, sure(mesh))
    mesh, measured, dropped = fuse_surface(observation.field, logits, frame)
    reach = COLOR_REACH * float(np.max(frame.voxel_size))
    color = color_vertices(
        mesh, measured, observation.views, reach=reach, sensor=observation.sensor
    )
    return ShapeMesh(mesh, measured, color, dropped, sure(mesh))


def _of_mesh(found: ShapeMesh) -> dict[str, Any]:
    area = found.mesh.area_faces
    over_area = lambda x: round(float(x[found.mesh.faces].mean(axis=1) @ area / area.sum()), 4)  # noqa: E731
    figures: dict[str, Any] = {}
    if found.measured is not None:
        figures |= {
            "mesh_measured": over_area(found.measured),
            "mesh_pieces_dropped": found.dropped,
        }
    if found.confidence is not None:
        figures["mesh_confidence"] = over_area(found.confidence)
    return figures


def _judged(observation: Observation, found: ShapeMesh, is_mirrored: bool) -> dict[str, Any]:
    if observation.cloud is not None:
        voxel = float(np.max(observation.frame.voxel_size))
        quality = quality_of_cloud(
            found.mesh,
            observation.cloud,
            voxel=voxel,
            is_mirrored=is_mirrored,
            unseen=observation.unseen,
        )
    else:
        quality = quality_of(
            found.mesh,
            found.measured,
            observation.keyframes,
            axial=observation.sensor.axial,
            is_mirrored=is_mirrored,
            floor=observation.floor,
            unseen=observation.unseen,
        )
    verdict = judged(quality, observation.usual)
    return {
        "verdict": verdict.word,
        "verdict_reasons": list(verdict.reasons),
        "quality": {name: _rounded(value) for name, value in quality._asdict().items()},
    }


def _rounded(value: Any) -> Any:
    """A figure as JSON holds it: four digits, None for NaN."""
    if isinstance(value, tuple):
        return [_rounded(one) for one in value]
    if not isinstance(value, float):
        return value
    return round(value, 4) if np.isfinite(value) else None


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
    if one.symmetric is not None:
        measured["symmetric"] = bool(one.symmetric)
        measured["symmetry_agreement"] = round(float(one.agreement), 4)
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
    if one.samples is not None:
        arrays["samples"] = np.asarray(one.samples, np.float16)
        arrays["probability"] = one.probability.astype(np.float16)
    if observation.soft is not None:
        arrays["F"], arrays["M"] = (np.asarray(x, np.float16) for x in observation.soft[:2])
    if observation.truth is not None:
        arrays["truth"] = observation.truth
    with atomic_path(path) as temporary:
        np.savez_compressed(temporary, **arrays)  # pyright: ignore[reportArgumentType]
