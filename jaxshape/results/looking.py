"""Where to look next at the object of a result folder. [host]

Samples of the shape are codes of the prior: of a conditional prior around the most probable code,
of others around the code that was found, as far as the training codes spread.
"""

from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxshape import reading
from jaxshape.data.virtual_cameras import CAMERAS
from jaxshape.geometry.camera import Intrinsics
from jaxshape.geometry.grid import GridFrame
from jaxshape.geometry.grids import Grids
from jaxshape.geometry.pixels import Sensor
from jaxshape.mapping.views.candidates import in_words, reachable_views
from jaxshape.mapping.views.gain import NextViews, next_views
from jaxshape.model.shapes import ShapePrior, decode
from jaxshape.results.folder import ResultFolder, camera_poses, extent, read_folder

SAMPLES = 16
"""Plausible shapes by which views are chosen."""

BEST = 3
"""Views that are named."""

APART = 40.0
"""Degrees between the views that are named: neighbours tell the same."""


class Looked(NamedTuple):
    """Where to look next at an object.

    Attributes:
        found: The result folder.
        views: The cameras to choose from, and what each would tell.
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


def look(
    folder: Path,
    prior: ShapePrior,
    *,
    distance: float | None = None,
    samples: int = SAMPLES,
    seed: int = 0,
) -> Looked:
    """The views that would tell most about the object of a result folder. [host]

    Args:
        folder: Folder made by `reconstruct` or `demo`.
        prior: The shape prior that it was made with.
        distance: Of the cameras from the object's centre, in metres; None for that at which it was
            filmed, or where a Kinect stands.
        samples: Plausible shapes, 1 to 32.
        seed: Seed of their codes, 0 or more.

    Raises:
        ValueError: The folder holds no finished grids, or grids of another prior.
    """
    found = read_folder(folder)
    kept = _kept(folder / "grid.npz", prior)
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
    logits = drawn(prior, jax.random.key(seed), grids, jnp.float32(kept["code"]), samples)
    sensor = Sensor(axial=_noise(found))
    views = _choose(logits, grids, frame, T, intrinsics, shape, here=here, sensor=sensor)
    return Looked(found, jax.device_get(views), _apart(views), floor)


@partial(jax.jit, static_argnums=4)
def drawn(
    prior: ShapePrior, key: Array, grids: Grids, code: Float[Array, " d"], count: int
) -> Float[Array, "sample x y z"]:
    """Logits of plausible shapes of one object.

    Args:
        prior: The shape prior.
        key: Random key of the codes.
        grids: F and M of the object `[x y z]`.
        code: The code that was found `[d]`.
        count: Shapes, 1 or more.
    """
    spread = jax.random.multivariate_normal(
        key, jnp.zeros_like(code), prior.code_covariance, (1, count), method="svd"
    )
    return decode(prior, code + spread, jax.tree.map(lambda x: x[None], grids))[0]


_choose = jax.jit(next_views, static_argnames=("shape", "sensor"))


def _kept(path: Path, prior: ShapePrior) -> dict[str, np.ndarray]:
    """F, M and the code; of results of earlier versions, F and M are binary."""
    names = ("F", "M", "occupied", "occluded", "code")
    kept = reading.read_arrays(path, names) if path.is_file() else {}
    F, M = kept.get("F", kept.get("occupied")), kept.get("M", kept.get("occluded"))
    if F is None or M is None or "code" not in kept:
        raise ValueError(
            f"{str(path.parent)!r} holds no grid.npz with F, M and a code; give a finished folder "
            "of jaxshape reconstruct or demo."
        )
    n = prior.resolution
    if F.shape != (n, n, n) or M.shape != F.shape or kept["code"].shape != (prior.code_size,):
        raise ValueError(
            f"{str(path)!r} was made with other weights: its grids are {F.shape} and its code "
            f"{kept['code'].shape}, but these weights know {(n, n, n)} and {(prior.code_size,)}. "
            "Give those it was made with: --weights."
        )
    kind = np.float32 if "F" in kept else bool
    return {"F": F.astype(kind), "M": M.astype(kind), "code": kept["code"]}


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
    """The best cameras of which none is near another."""
    eyes = np.asarray(views.T_object_camera.translation())
    toward = eyes / np.linalg.norm(eyes, axis=1, keepdims=True)
    chosen: list[int] = []
    for i in map(int, views.ranking):
        if all(toward[i] @ toward[j] < np.cos(np.radians(APART)) for j in chosen):
            chosen.append(i)
        if len(chosen) == BEST:
            break
    return chosen
