"""Settings of a dataset and of the inputs drawn from it.

Nothing here imports JAX, so that the command line starts quickly.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, get_args

from jaxshape import checks, limits

CameraName = Literal["paper", "kinect", "realsense", "iphone-lidar"]
"""Depth cameras that can be simulated (`data/virtual_cameras`)."""

FamilyName = Literal["chair", "table"]
"""Families of procedural objects (`data/families`), and weights of the same names."""

Axis = Literal["x", "y", "z", "-x", "-y", "-z"]

UpFront = tuple[str, str]
"""Axes of a mesh that point up and to the front, as ("z", "-y")."""

UnitName = Literal["m", "cm", "mm", "inch"]

UNITS: dict[UnitName, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}
"""Metres in each unit of mesh files."""


def check_axes(up: str, front: str) -> None:
    """Refuse axes that do not describe the orientation of an object.

    Args:
        up: Axis that points up, as "y" or "-z".
        front: Axis towards which the object faces.

    Raises:
        ValueError: An argument is not an axis, or both are on one line.
    """
    checks.one_of("up", up, get_args(Axis))
    checks.one_of("front", front, get_args(Axis))
    if up[-1] == front[-1]:
        raise ValueError(
            f"up is {up!r} and front is {front!r}, but they must be perpendicular; give another."
        )


@dataclass(frozen=True)
class FaultConfig:
    """Rates of the faults of real frames in training, each a share from 0 to 1.

    Attributes:
        pose_error: Share of the frames whose pose is off by about a centimetre and half a degree.
        missing: Share of the frames that lack a region, as if the sensor returned nothing there.
        segmentation: Share of the frames whose mask is wrong: it lacks a piece of the object, or
            includes some floor.
        hidden: Share of the paths in which something hides one side of the object in all frames.
        loose: Share of the paths in which the object's box is up to 6 % too large on each side, so
            that the object is smaller in the grid, by a different factor along each axis.

    Raises:
        ValueError: A share is outside its range.
    """

    pose_error: float = 0.05
    missing: float = 0.1
    segmentation: float = 0.02
    hidden: float = 0.1
    loose: float = 0.25

    def __post_init__(self) -> None:
        for share, value in vars(self).items():
            checks.within(share, value, 0, 1)


FAULTLESS = FaultConfig(0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class DatasetConfig:
    """Settings that, together with the objects, determine every byte of a dataset.

    The defaults are the preset `default`.

    Attributes:
        paths: Camera paths around each object, 1 or more. Each draws its own camera, views, noise
            and faults.
        frames: Increasing numbers of frames, 1 or more each: the measurement after each number of
            frames of a path becomes a training input.
        cameras: Names of the depth cameras, from which each path draws one: "paper", "kinect",
            "realsense", "iphone-lidar". Frames of the paper's camera are fused as points, others as
            signed distances.
        noisy: Share of the paths whose depth images get the faults of their sensor, from 0 to 1.
        arcs: Share of the paths along an arc around the object, from 0 to 1; the others draw random
            views as in the paper.
        faults: Rates of the faults of real frames.
        up: Axis of the mesh files that points up.
        front: Axis of the mesh files towards which the object faces.
        unit: Unit of the mesh files: "m", "cm", "mm" or "inch".
        resolution: Voxels along each axis of the grids: 8, 16, 32, 64 or 128 (paper: 32).
        seed: Seed of all draws, 0 or more.

    Raises:
        ValueError: A setting is outside its range.
    """

    paths: int = 1
    frames: tuple[int, ...] = (1, 2, 3, 4, 6, 8, 12, 18)
    cameras: tuple[CameraName, ...] = ("paper", "kinect", "realsense", "iphone-lidar")
    noisy: float = 0.7
    arcs: float = 0.6
    faults: FaultConfig = FaultConfig()
    up: Axis = "y"
    front: Axis = "z"
    unit: UnitName = "m"
    resolution: int = 32
    seed: int = 0

    def __post_init__(self) -> None:
        checks.one_of("resolution", self.resolution, (8, 16, 32, 64, 128))
        checks.whole("paths", self.paths, 1, limits.PATHS, "each is filmed anew")
        if not self.frames or self.frames[0] < 1 or any(a >= b for a, b in pairwise(self.frames)):
            checks.refuse("frames", self.frames, "increasing numbers of frames, 1 or more each")
        why = "all frames of a path are in memory together"
        checks.whole("frames", self.frames[-1], 1, limits.FRAMES, why)
        if not self.cameras:
            checks.refuse("cameras", self.cameras, "one name of a camera or more")
        for name in self.cameras:
            checks.one_of("cameras", name, get_args(CameraName))
        checks.within("noisy", self.noisy, 0, 1)
        checks.within("arcs", self.arcs, 0, 1)
        check_axes(self.up, self.front)
        checks.one_of("unit", self.unit, UNITS)
        checks.seed("seed", self.seed)


DATASETS = {
    "default": DatasetConfig(),
    # 18 clean random views of each object, each a separate measurement (section 2.3).
    "paper": DatasetConfig(
        paths=18, frames=(1,), cameras=("paper",), noisy=0.0, arcs=0.0, faults=FAULTLESS
    ),
}
"""Datasets by name: our best, and the paper's own."""


@dataclass(frozen=True)
class InputConfig:
    """Settings for drawing training inputs from a dataset.

    Attributes:
        complete: Share of the inputs that are the complete surface itself, from 0 to 1.
        mirror: Exchange left and right in half of the pairs.
        warp: Each axis is locally stretched and compressed by up to this share, from 0 to below 1:
            it gives more proportions from the same objects.

    Raises:
        ValueError: A setting is outside its range.
    """

    complete: float = 0.05
    mirror: bool = True
    warp: float = 0.3

    def __post_init__(self) -> None:
        checks.one_of("mirror", self.mirror, (True, False))
        checks.within("complete", self.complete, 0, 1)
        checks.within("warp", self.warp, 0, 1)
        if self.warp == 1:
            checks.refuse("warp", self.warp, "a number below 1, or nothing is left")
