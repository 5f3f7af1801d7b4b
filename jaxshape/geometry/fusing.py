"""The two methods that fuse frames into F and M, behind one interface.

`Points` counts measured points in voxels, as in the paper (Eq. 6); `Distances` averages signed
distances on a fine grid, for real or noisy depth. Both are static under `jax.jit`:

    state = fusing.nothing(resolution)
    state = fusing.merge(state, fusing.measure(depth, segmented, intrinsics, T, frame, sensor))
    grids = fusing.grids(state)
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, get_args

import jax
import jaxlie
from jaxtyping import Array, Bool, Float

from jaxshape import checks
from jaxshape.geometry import distance, fusion
from jaxshape.geometry.camera import Intrinsics
from jaxshape.geometry.config import FusionName
from jaxshape.geometry.distance import DistanceField
from jaxshape.geometry.evidence import soft_grids
from jaxshape.geometry.fusion import Measurement
from jaxshape.geometry.grid import RESOLUTION, GridFrame
from jaxshape.geometry.grids import Grids
from jaxshape.geometry.pixels import Sensor


@jax.tree_util.register_static
@dataclass(frozen=True)
class Points:
    """Points counted in voxels: binary F and M (paper, Eq. 6).

    Attributes:
        resolution: Voxels along each axis of F and M.
        min_hits: Points that make a voxel occupied, 1 or more (paper: 1).

    Raises:
        ValueError: A setting is outside its range.
    """

    resolution: int = RESOLUTION
    min_hits: int = 1

    def __post_init__(self) -> None:
        checks.whole("resolution", self.resolution, 1)
        checks.whole("min_hits", self.min_hits, 1)

    def nothing(self) -> Measurement:
        """The measurement before any frame."""
        return fusion.nothing_measured(self.resolution)

    def measure(
        self, depth, segmented, intrinsics, T_object_camera, frame, sensor: Sensor = Sensor()
    ) -> Measurement:
        """The measurement of one frame; points have no weights, so the sensor is ignored."""
        del sensor
        return fusion.measure(depth, segmented, intrinsics, T_object_camera, frame, self.resolution)

    def merge(self, first: Measurement, second: Measurement) -> Measurement:
        """Merge the measurements of two sets of frames."""
        return fusion.merge(first, second)

    def grids(self, state: Measurement) -> Grids:
        """F and M."""
        occupied = fusion.occupied(state, self.min_hits)
        return Grids(occupied, fusion.occluded(state, self.min_hits))


@jax.tree_util.register_static
@dataclass(frozen=True)
class Distances:
    """Signed distances averaged on a fine grid: soft F and M.

    Attributes:
        resolution: Voxels along each axis of F and M.
        fine: Voxels along each axis of the fine grid, a multiple of the resolution; None for the
            least multiple that is 4 times 32 or more.

    Raises:
        ValueError: The side of the fine grid is not a multiple of the resolution.
    """

    resolution: int = RESOLUTION
    fine: int | None = None

    def __post_init__(self) -> None:
        checks.whole("resolution", self.resolution, 1)
        if self._side % self.resolution:
            checks.refuse("fine", self.fine, f"a multiple of {self.resolution}")

    @property
    def _side(self) -> int:
        if self.fine is not None:
            return self.fine
        return self.resolution * math.ceil(distance.FINE * RESOLUTION / self.resolution)

    def nothing(self) -> DistanceField:
        """The field before any frame."""
        return distance.nothing_measured(self._side)

    def measure(
        self, depth, segmented, intrinsics, T_object_camera, frame, sensor: Sensor = Sensor()
    ) -> DistanceField:
        """The field of one frame."""
        coarse = frame._replace(voxel_size=frame.voxel_size * (self.resolution / RESOLUTION))
        return distance.measure(
            depth, segmented, intrinsics, T_object_camera, coarse, sensor, self._side
        )

    def merge(self, first: DistanceField, second: DistanceField) -> DistanceField:
        """Merge the fields of two sets of frames."""
        return distance.merge(first, second)

    def grids(self, state: DistanceField) -> Grids:
        """Soft F and M."""
        return soft_grids(state, self.resolution)


Fusion = Points | Distances
"""A fusion method; merging is associative and commutative, with `nothing()` as identity."""


def fusion_named(name: FusionName, resolution: int = RESOLUTION, min_hits: int = 1) -> Fusion:
    """The fusion method of a name.

    Args:
        name: "distance" for signed distances, "points" for the paper's points.
        resolution: Voxels along each axis of F and M.
        min_hits: Points that make a voxel occupied, for "points".

    Raises:
        ValueError: There is no method of that name, or a number is outside its range.
    """
    checks.one_of("fusion", name, get_args(FusionName))
    return Points(resolution, min_hits) if name == "points" else Distances(resolution)


def fuse(
    fusing: Fusion,
    depth: Float[Array, "frame h w"],
    segmented: Bool[Array, "frame h w"],
    intrinsics: Intrinsics,
    T_object_camera: jaxlie.SE3,
    frame: GridFrame,
    sensor: Sensor = Sensor(),
    state: Any = None,
) -> Any:
    """Fuse all frames of one camera, one at a time, so that memory holds only two fields.

    Args:
        fusing: The fusion method.
        depth: Metres `[frame h w]`; 0 for missing depth, infinite where the ray hit nothing.
        segmented: True on pixels that show the object `[frame h w]`.
        intrinsics: The camera of all frames.
        T_object_camera: Pose of each frame in the object frame `[frame]`.
        frame: Voxel frame of F and M.
        sensor: Noise of the camera.
        state: The state of earlier frames; None if there are none.
    """

    merge: Any = fusing.merge  # of either method, and so is the state

    def add(state, one):
        depth, segmented, T = one
        new = fusing.measure(depth, segmented, intrinsics, T, frame, sensor)
        return merge(state, new), None

    earlier = fusing.nothing() if state is None else state
    return jax.lax.scan(add, earlier, (depth, segmented, T_object_camera))[0]


def fuse_in_stages(
    fusing: Fusion,
    numbers: tuple[int, ...],
    depth: Float[Array, "frame h w"],
    segmented: Bool[Array, "frame h w"],
    intrinsics: Intrinsics,
    T_object_camera: jaxlie.SE3,
    frame: GridFrame,
    sensor: Sensor = Sensor(),
) -> Iterator[Any]:
    """The state of the first k frames, for each k of an increasing tuple.

    Args:
        fusing: The fusion method.
        numbers: Increasing numbers of frames, 1 or more each.
        depth: Metres `[frame h w]`; 0 for missing depth, infinite where the ray hit nothing.
        segmented: True on pixels that show the object `[frame h w]`.
        intrinsics: The camera of all frames.
        T_object_camera: Pose of each frame in the object frame `[frame]`.
        frame: Voxel frame of F and M.
        sensor: Noise of the camera.

    Yields:
        The states, in the order of the numbers.
    """
    frames, state = (depth, segmented, T_object_camera), fusing.nothing()
    for ends in pairwise((0, *numbers)):
        depth, segmented, T = jax.tree.map(lambda x, ends=ends: x[slice(*ends)], frames)
        state = fuse(fusing, depth, segmented, intrinsics, T, frame, sensor, state)
        yield state
