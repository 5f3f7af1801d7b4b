"""Settings of a dataset and of the inputs drawn from it.

Nothing here imports JAX, so that the command line answers at once.
"""

from dataclasses import dataclass
from typing import Literal, get_args

from jaxshape import checks

CameraName = Literal["paper", "kinect", "realsense", "iphone-lidar"]
"""Depth cameras that a virtual one can stand for (`data/virtual_cameras`)."""

Axis = Literal["x", "y", "z", "-x", "-y", "-z"]


def check_axes(up: str, front: str) -> None:
    """Refuse axes that do not describe the orientation of an object.

    Args:
        up: Axis that points up, as "y" or "-z".
        front: Axis along which the object's front looks.

    Raises:
        ValueError: One of them is no axis, or both lie on one line.
    """
    checks.one_of("up", up, get_args(Axis))
    checks.one_of("front", front, get_args(Axis))
    if up[-1] == front[-1]:
        raise ValueError(
            f"up is {up!r} and front is {front!r}, but they must be perpendicular; give another."
        )


@dataclass(frozen=True)
class DatasetConfig:
    """Settings that decide, with the objects themselves, every byte of a dataset.

    Attributes:
        views: Random views of each object, 1 or more (paper: 18).
        noisy: Share of the objects whose depth images get the faults of a real sensor, from 0 to 1.
        up: Axis of the mesh files that points up.
        front: Axis of the mesh files along which the object's front looks.
        resolution: Voxels along each axis of the grids: 8, 16, 32, 64 or 128 (paper: 32).
        seed: Seed of views, noise and surface samples, 0 or more.

    Raises:
        ValueError: A setting is outside its range.
    """

    views: int = 18
    noisy: float = 0.5
    up: Axis = "y"
    front: Axis = "z"
    resolution: int = 32
    seed: int = 0

    def __post_init__(self) -> None:
        checks.one_of("resolution", self.resolution, (8, 16, 32, 64, 128))
        checks.whole("views", self.views, 1)
        checks.within("noisy", self.noisy, 0, 1)
        check_axes(self.up, self.front)
        checks.whole("seed", self.seed, 0)


@dataclass(frozen=True)
class InputConfig:
    """How training inputs are changed, so that they look like those of a reconstruction.

    Attributes:
        max_views: Inputs fuse 1 to this many random views, 1 or more (paper: 1).
        complete: Share of the inputs that are the complete surface itself, from 0 to 1.
        mirror: Exchange left and right in half of the pairs.
        scale: Shrink each axis by up to this share, from 0 to below 1, as a box that is a little
            too large would.
        pose_error: Share of the views that lie a voxel off along each axis, from 0 to 1.
        missing: Share of the views that lack a region, as where a sensor returns nothing, from 0 to
            1.
        segmentation: Share of the views whose mask is wrong, from 0 to 1: it cuts a piece off, or
            takes in some background.

    Raises:
        ValueError: A setting is outside its range.
    """

    max_views: int = 18
    complete: float = 0.1
    mirror: bool = True
    scale: float = 0.0
    pose_error: float = 0.05
    missing: float = 0.1
    segmentation: float = 0.02

    def __post_init__(self) -> None:
        checks.whole("max_views", self.max_views, 1)
        checks.one_of("mirror", self.mirror, (True, False))
        for share in ("complete", "scale", "pose_error", "missing", "segmentation"):
            checks.within(share, getattr(self, share), 0, 1)
        if self.scale == 1:
            checks.refuse("scale", self.scale, "a number below 1, or nothing is left")
