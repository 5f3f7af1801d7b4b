"""Settings of a dataset and of the inputs drawn from it; free of JAX, for the command line."""

from dataclasses import dataclass
from typing import Literal, get_args

from jaxshape import checks

Axis = Literal["x", "y", "z", "-x", "-y", "-z"]


def check_axes(up: str, front: str) -> None:
    """Refuse axes that say nothing of how an object is turned.

    Args:
        up: Axis that points up, as "y" or "-z".
        front: Axis along which the object's front looks.

    Raises:
        ValueError: Where one of them is no axis, or both lie on one line.
    """
    checks.one_of("up", up, get_args(Axis))
    checks.one_of("front", front, get_args(Axis))
    if up[-1] == front[-1]:
        raise ValueError(
            f"up is {up!r} and front is {front!r}, but they must be perpendicular; give another."
        )


@dataclass(frozen=True)
class DatasetConfig:
    """What, with the objects themselves, decides every byte of a dataset."""

    views: int = 18
    """Random views of each object (paper: 18)."""
    noisy: float = 0.5
    """Share of the objects whose depth images get the faults of a real sensor."""
    up: Axis = "y"
    """Axis of the mesh files that points up."""
    front: Axis = "z"
    """Axis of the mesh files along which the object's front looks."""
    resolution: int = 32
    """Voxels along each axis of the grids (paper: 32)."""
    seed: int = 0
    """Of views, noise and surface samples."""

    def __post_init__(self) -> None:
        checks.one_of("resolution", self.resolution, (8, 16, 32, 64, 128))
        checks.whole("views", self.views, 1)
        checks.within("noisy", self.noisy, 0, 1)
        check_axes(self.up, self.front)
        checks.whole("seed", self.seed, 0)


@dataclass(frozen=True)
class InputConfig:
    """What a training input goes through, so that it looks like those of a reconstruction."""

    max_views: int = 18
    """Inputs fuse 1 to this many random views (paper: 1)."""
    complete: float = 0.1
    """Share of the inputs that are the complete surface itself."""
    mirror: bool = True
    """Exchange left and right in half of the pairs."""
    scale: float = 0.0
    """Shrink each axis by up to this share, as a box that is a little too large would."""
    pose_error: float = 0.05
    """Share of the views that lie a voxel off along each axis."""
    missing: float = 0.1
    """Share of the views that lack a region, as where a sensor returns nothing."""
    segmentation: float = 0.02
    """Share of the views whose mask is wrong: it cuts a piece off, or takes in some background."""

    def __post_init__(self) -> None:
        checks.whole("max_views", self.max_views, 1)
        checks.one_of("mirror", self.mirror, (True, False))
        for share in ("complete", "scale", "pose_error", "missing", "segmentation"):
            checks.within(share, getattr(self, share), 0, 1)
        if self.scale == 1:
            checks.refuse("scale", self.scale, "a number below 1, or nothing is left")
