"""Files of a scene, while it is followed and when it ends. [host]

scene.glb            all objects in the world, a node for each: class, size, how sure
scene.json           the objects, and what became of them
mesh.ply             all objects as one mesh in the world
objects.png          the keyframe that shows most of them, with their numbers
objects/chair-1/     mesh.ply, mesh.glb, grid.npz, result.json of each object
keyframes/, keyframes.json, trajectory.txt, trajectory.log: as of one object
"""

import shutil
from collections.abc import Sequence as Many
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import trimesh

from jaxshape.data.sequences import Sequence
from jaxshape.files import write_json
from jaxshape.geometry.grids import binary
from jaxshape.mapping.map.doubts import unreadable, unseen_in_words, unseen_of
from jaxshape.mapping.map.recording import Progress
from jaxshape.mapping.map.state import grids_of
from jaxshape.mapping.scene.following import Scene, SceneObject
from jaxshape.results.glb import Node, write_glb
from jaxshape.results.output import SMOOTHING, ShapeMesh, write_shape_mesh
from jaxshape.results.progress import (
    color_views,
    counts,
    floor_height,
    keyframe_entries,
    observation_of,
    seen_views,
    write_pictures,
    write_trajectories,
)
from jaxshape.results.surface import surface, write_mesh


class WrittenObject(NamedTuple):
    """An object whose files are written.

    Attributes:
        one: The object.
        result: Content of its result.json.
        found: Its mesh.
    """

    one: SceneObject
    result: dict[str, Any]
    found: ShapeMesh


def write_scene(
    folder: Path, sequence: Sequence, scene: Scene, figures: dict[str, Any]
) -> dict[str, Any]:
    """Write all files of a finished scene but its report and its picture.

    Args:
        folder: The result folder.
        sequence: The recording.
        scene: The scene, from `finish_scene`.
        figures: Further entries of `scene.json`.

    Returns:
        Content of `scene.json`.
    """
    shutil.rmtree(folder / "objects", ignore_errors=True)  # those of an earlier run
    written, empty = [], []
    for one in scene.objects:
        try:
            written.append(_write_object(folder / "objects" / one.name, sequence, one))
        except ValueError as problem:  # nothing was measured of it
            empty.append(f"{one.name} has no surface, and is left out. {problem}")
    whole = whole_progress(scene)
    write_pictures(folder / "keyframes", sequence, whole)
    write_trajectories(folder, sequence, whole)
    write_json(folder / "keyframes.json", keyframe_entries(sequence, whole))
    if written:
        write_glb(folder / "scene.glb", [_node(one) for one in written])
        _write_together(folder / "mesh.ply", written)
    result = scene_entries(scene, written, figures, empty)
    write_json(folder / "scene.json", result)
    return result


def write_scene_progress(
    folder: Path, sequence: Sequence, scene: Scene, figures: dict[str, Any]
) -> None:
    """Write the present state of a scene that is still followed, for `jaxshape view` to show.

    `mesh.ply` is the surface of the measured voxels of all objects, whose classes are not known
    yet; files of finished objects from an earlier run are removed.

    Args:
        folder: The result folder.
        sequence: The recording.
        scene: The scene, from `follow_scene`.
        figures: Further entries of `scene.json`.
    """
    shutil.rmtree(folder / "objects", ignore_errors=True)
    whole = whole_progress(scene)
    write_pictures(folder / "keyframes", sequence, whole)
    write_json(folder / "keyframes.json", keyframe_entries(sequence, whole))
    meshes = list(filter(None, map(_measured_mesh, scene.objects)))
    if meshes:
        together: Any = trimesh.util.concatenate(meshes)
        write_mesh(together, folder / "mesh.ply")
    entries = [
        _place_of(one) | {"class": None, "size": one.progress.start.box.size.tolist()}
        for one in scene.objects
    ]
    result = figures | counts(scene.camera) | {"running": True, "objects": entries}
    write_json(folder / "scene.json", result | {"events": list(scene.tracks.events)})


def _measured_mesh(one: SceneObject) -> trimesh.Trimesh | None:
    """The surface of an object's measured voxels, in the world; None where there are none."""
    state = one.progress.state
    occupied = np.asarray(binary(grids_of(state)).occupied)
    if not occupied.any():
        return None
    T_world_object = state.place.box.T_world_object
    return surface(occupied, state.place.frame, smoothing=SMOOTHING, T_world_object=T_world_object)


def _write_object(folder: Path, sequence: Sequence, one: SceneObject) -> WrittenObject:
    """Write the files of one object."""
    progress, decision = one.progress, one.decision
    assert progress.shape is not None and decision is not None
    observation = observation_of(progress.state)
    if observation.field is not None:
        observation = observation._replace(views=color_views(sequence, progress))
    start = progress.start
    is_completed = decision.name is not None
    observation = observation._replace(
        keyframes=seen_views(progress.state),
        floor=np.nan if one.thing.is_on_top else floor_height(start),
    )
    warnings = []
    if is_completed:
        observation = observation._replace(unseen=unseen_of(progress))
        warnings = list(unseen_in_words(progress))
    folder.mkdir(parents=True)
    about = {
        "object": one.name,
        "class": decision.name,
        "sure": round(decision.sure, 3),
        "evidence": decision.scores,
        "is_completed": is_completed,
        "warnings": warnings,
        "box": {
            "T_world_object": start.box.T_world_object.tolist(),
            "size": start.box.size.tolist(),
        },
    }
    result, found = write_shape_mesh(folder, observation, progress.shape, about)
    write_json(folder / "result.json", _without_nan(result))
    return WrittenObject(one, result, found)


def _without_nan(result: dict[str, Any]) -> dict[str, Any]:
    """An object that was not completed has no objective."""
    return {k: v for k, v in result.items() if not (isinstance(v, float) and np.isnan(v))}


def _node(written: WrittenObject) -> Node:
    one, result, found = written
    assert one.decision is not None
    box = one.progress.start.box
    extras = {
        "class": one.decision.name or "none",
        "sure": round(one.decision.sure, 3),
        "size": [round(float(x), 4) for x in found.mesh.extents],
        "verdict": result.get("verdict", ""),
    }
    return Node(
        one.name, found.mesh, found.measured, found.color, T_world_object=box.T_world_object,
        extras=extras,
    )  # fmt: skip


def _write_together(path: Path, written: Many[WrittenObject]) -> None:
    """One mesh of all objects, in the world."""
    meshes = [
        one.found.mesh.copy().apply_transform(one.one.progress.start.box.T_world_object)
        for one in written
    ]
    together: Any = trimesh.util.concatenate(meshes)

    def joined(name: str) -> Any:
        parts = [getattr(one.found, name) for one in written]
        return None if any(part is None for part in parts) else np.concatenate(parts)

    write_mesh(together, path, measured=joined("measured"), color=joined("color"))


def whole_progress(scene: Scene) -> Progress:
    """The camera's progress, its keyframes showing the pixels of all objects.

    Args:
        scene: The scene.
    """
    state = scene.camera.state
    keyframes = []
    for k, keyframe in enumerate(state.keyframes):
        found = np.zeros(keyframe.depth.shape, bool)
        for one in scene.objects:
            found |= np.asarray(one.progress.state.keyframes[k].segmented)
        keyframes.append(keyframe._replace(segmented=jnp.asarray(found)))
    return scene.camera._replace(state=state._replace(keyframes=tuple(keyframes)))


def scene_entries(
    scene: Scene,
    written: Many[WrittenObject],
    figures: dict[str, Any],
    warnings: Many[str] = (),
) -> dict[str, Any]:
    """The content of scene.json.

    Args:
        scene: The scene.
        written: The objects whose files are written.
        figures: Further entries.
        warnings: Further warnings, in sentences.
    """
    moved = [one.number for one in scene.tracks.things if one.is_moved]
    named = [f"{one.one.name}: {text}" for one in written for text in one.result["warnings"]]
    warned = [*figures.get("warnings", ()), *unreadable(scene.camera), *scene_warnings(scene)]
    return {
        **figures,
        **counts(scene.camera),
        "keyframes": len(scene.camera.state.keyframes),
        "warnings": [*warned, *warnings, *named],
        "objects": [_entry(one) for one in written],
        "moved": moved,
        "events": list(scene.tracks.events),
    }


def scene_warnings(scene: Scene) -> list[str]:
    """Warnings about a scene that a user should look at, in sentences.

    Args:
        scene: The scene.
    """
    found = []
    if scene.level is None:
        found.append(
            "No floor was seen, and objects are found only with the floor: film the floor, too."
        )
    elif not scene.objects:
        found.append("Nothing of the size of an object stands on the floor or on a table.")
    for one in scene.tracks.things:
        if one.is_moved:
            found.append(f"Object {one.number} was moved while it was filmed, and is left out.")
    return found


def _entry(written: WrittenObject) -> dict[str, Any]:
    one, result, found = written
    return {
        **_place_of(one),
        "class": result["class"],
        "sure": result["sure"],
        "evidence": result["evidence"],
        "size": [round(float(x), 4) for x in found.mesh.extents],
        "verdict": result.get("verdict"),
        "verdict_reasons": result.get("verdict_reasons", []),
        "folder": f"objects/{one.name}",
    }


def _place_of(one: SceneObject) -> dict[str, Any]:
    return {
        "name": one.name,
        "number": one.thing.number,
        "T_world_object": one.progress.start.box.T_world_object.tolist(),
        "is_on_top": one.thing.is_on_top,
    }
