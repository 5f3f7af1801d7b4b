"""Where to look next at the object of a result folder. [host]

The folder holds samples of the posterior, so that choosing a view decodes nothing.
"""

from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxshape import reading
from jaxshape.data.virtual_cameras import CAMERAS
from jaxshape.geometry.camera import Intrinsics
from jaxshape.geometry.grid import GridFrame
from jaxshape.geometry.grids import Grids
from jaxshape.geometry.pixels import Sensor
from jaxshape.mapping.views.candidates import in_words, reachable_views
from jaxshape.mapping.views.gain import MOST_SHAPES, NextViews, next_views
from jaxshape.results.folder import ResultFolder, camera_poses, extent, read_folder

BEST = 3
"""Number of views that are named."""

APART = 40.0
"""Least angle between named views, in degrees: neighbouring views give the same information."""


class Looked(NamedTuple):
    """Where to look next at an object.

    Attributes:
        found: The result folder.
        views: The cameras to choose from, with the information gain of each.
        best: Numbers of the best cameras, the best first, far enough apart to differ.
        floor: Height of the floor in the object frame, in metres.
    """

    found: ResultFolder
    views: NextViews
    best: list[int]
    floor: float

    def sentences(self) -> list[str]:
        """Where each of the best cameras is, in words."""
        eyes = np.asarray(self.views.T_object_camera.translation())
        return [in_words(eyes[i], self.floor) for i in self.best]


def look(folder: Path, *, distance: float | None = None) -> Looked:
    """The next views that give most information about the object of a result folder. [host]

    Args:
        folder: Folder made by `reconstruct` or `demo`.
        distance: Distance of the cameras from the object's centre, in metres; None for the distance
            at which it was filmed, or for that of a Kinect if this is not known.

    Raises:
        ValueError: The folder holds no finished grids, or no samples.
    """
    found = read_folder(folder)
    kept = _kept(folder / "grid.npz")
    grids = Grids(kept["F"], kept["M"])
    frame = GridFrame(jnp.float32(found.origin), jnp.float32(found.voxel_size))
    poses = [T for _, T in camera_poses(found)]
    intrinsics, shape = _camera(found)
    floor = _floor(found)
    radius = distance or _distance(found, poses)
    if radius <= extent(found)[1]:
        raise ValueError(
            f"Cameras {radius:.2f} m from the object's centre would stand inside its box; give a "
            f"distance above {extent(found)[1]:.2f} m."
        )
    T = reachable_views(radius, floor)
    here = jnp.float32(poses[-1][:3, 3]) if poses else None
    sensor = Sensor(axial=_noise(found))
    samples = jnp.float32(kept["samples"][:MOST_SHAPES])
    views = _choose(samples, grids, frame, T, intrinsics, shape, here=here, sensor=sensor)
    return Looked(found, jax.device_get(views), _apart(views), floor)


_choose = jax.jit(next_views, static_argnames=("shape", "sensor"))


def _kept(path: Path) -> dict[str, np.ndarray]:
    """F, M and the samples; F and M are binary where frames were fused as points."""
    names = ("F", "M", "occupied", "occluded", "samples")
    kept = reading.read_arrays(path, names) if path.is_file() else {}
    F, M = kept.get("F", kept.get("occupied")), kept.get("M", kept.get("occluded"))
    if F is None or M is None:
        raise ValueError(
            f"{str(path.parent)!r} holds no grid.npz with F and M; give a finished folder of "
            "jaxshape reconstruct or demo, or an object of jaxshape scene."
        )
    if "samples" not in kept:
        raise ValueError(
            f"{str(path)!r} holds no samples of the shape (objects of no class have none); make "
            "the folder anew, with --samples 16."
        )
    kind = np.float32 if "F" in kept else bool
    return {"F": F.astype(kind), "M": M.astype(kind), "samples": kept["samples"]}


def _camera(found: ResultFolder) -> tuple[Intrinsics, tuple[int, int]]:
    """The camera of the recording; a Kinect where there was none."""
    if found.intrinsics is not None and found.shape is not None:
        return Intrinsics(*jnp.float32(found.intrinsics)), found.shape
    kinect = CAMERAS["kinect"]
    assert kinect.field_of_view is not None
    focal = kinect.width / 2 / np.tan(np.radians(kinect.field_of_view) / 2)
    numbers = jnp.float32([focal, focal, kinect.width / 2, kinect.height / 2])
    return Intrinsics(*numbers), (kinect.height, kinect.width)


def _distance(found: ResultFolder, poses: list[np.ndarray]) -> float:
    if poses:
        return float(np.median([np.linalg.norm(T[:3, 3]) for T in poses]))
    return CAMERAS["kinect"].distance * 2 * extent(found)[1]


def _floor(found: ResultFolder) -> float:
    """The lower face of the object's box, on which it stands."""
    box: Any = found.result.get("box")
    size: Any = box.get("size", ()) if isinstance(box, dict) else ()
    if np.shape(size) == (3,):
        return -float(size[1]) / 2
    return float(found.origin[1]) + float(found.voxel_size[1])


def _noise(found: ResultFolder) -> float:
    mapping: Any = found.result.get("mapping")
    noise = mapping.get("depth_noise") if isinstance(mapping, dict) else None
    return float(noise) if isinstance(noise, int | float) else Sensor().axial


def _apart(views: NextViews) -> list[int]:
    """The best cameras, no two of which are near each other."""
    eyes = np.asarray(views.T_object_camera.translation())
    toward = eyes / np.linalg.norm(eyes, axis=1, keepdims=True)
    chosen: list[int] = []
    for i in map(int, views.ranking):
        if all(toward[i] @ toward[j] < np.cos(np.radians(APART)) for j in chosen):
            chosen.append(i)
        if len(chosen) == BEST:
            break
    return chosen
