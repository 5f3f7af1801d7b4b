"""Settings of tracking and mapping.

Nothing here imports JAX, so that the command line answers at once.
"""

from dataclasses import dataclass
from typing import Literal, get_args

from jaxshape import checks, limits
from jaxshape.geometry.config import FusionName


@dataclass(frozen=True)
class TrackingConfig:
    """Settings of tracking: how the pose of a frame is found, and when it is believed.

    Attributes:
        against: Align with the last keyframe and the surface of the map, or with the keyframe
            alone.
        on: Align all pixels, if the camera moves through a still room; or the pixels of the object,
            if the object turns in front of a still camera.
        min_inliers: Least share of agreeing points, among the points expected to be seen again,
            from 0 to 1.
        sure_inliers: Share of agreeing points, counted in the same way, below which many other
            guesses of the pose are tried, from 0 to 1: wrong poses can reach such a share.
        min_overlap: Least share of all points that are expected to be seen again, from 0 to 1.
        max_angle: Angle from the expected pose beyond which a pose is not believed, in degrees,
            above 0.
        max_distance: Distance from the expected pose beyond which a pose is not believed, in
            metres, above 0.
        correct_poses: Move keyframes with given poses slightly, to where they agree better with
            the map: given poses drift, too. False takes all given poses as they are.

    Raises:
        ValueError: A setting is outside its range.
    """

    against: Literal["map", "keyframe"] = "map"
    on: Literal["scene", "object"] = "scene"
    min_inliers: float = 0.75
    sure_inliers: float = 0.9
    min_overlap: float = 0.25
    max_angle: float = 35.0
    max_distance: float = 0.5
    correct_poses: bool = True

    def __post_init__(self) -> None:
        checks.one_of("against", self.against, ("map", "keyframe"))
        checks.one_of("on", self.on, ("scene", "object"))
        for share in ("min_inliers", "sure_inliers", "min_overlap"):
            checks.within(share, getattr(self, share), 0, 1)
        checks.one_of("correct_poses", self.correct_poses, (True, False))
        checks.positive("max_angle", self.max_angle, "degrees")
        checks.positive("max_distance", self.max_distance, "metres")


@dataclass(frozen=True)
class MappingConfig:
    """Settings of mapping: when a frame becomes a keyframe, and how keyframes are fused and
    searched.

    Attributes:
        keyframe_angle: Angle between neighbouring keyframes as seen from the object, in degrees,
            above 0.
        keyframe_distance: Distance between neighbouring keyframes, in metres, above 0.
        realign: Realign all keyframes with the refined shape after each new one.
        isotropic: Scale all axes of the grid alike, as the paper does on real data, instead of
            filling the box.
        fusion: How keyframes are fused: `distance` averages signed distances on a fine grid, which
            removes depth noise; `points` counts measured points in voxels (paper).
        depth_noise: Standard deviation of the camera's depth, above 0, in metres at 1 m; it grows
            with the square of depth. The default is that of the first Kinect. For `distance`.
        min_hits: For `points`: least number of depth points in an occupied voxel, 1 or more (paper:
            1). A higher number suppresses stray points.
        keyframe_iterations: Steps of the search after each keyframe, from the code found so far, 1
            or more.

    Raises:
        ValueError: A setting is outside its range.
    """

    keyframe_angle: float = 10.0
    keyframe_distance: float = 0.25
    realign: bool = True
    isotropic: bool = False
    fusion: FusionName = "distance"
    depth_noise: float = 1.6e-3
    min_hits: int = 3
    keyframe_iterations: int = 40

    def __post_init__(self) -> None:
        checks.positive("keyframe_angle", self.keyframe_angle, "degrees")
        checks.positive("keyframe_distance", self.keyframe_distance, "metres")
        for switch in ("realign", "isotropic"):
            checks.one_of(switch, getattr(self, switch), (True, False))
        checks.one_of("fusion", self.fusion, get_args(FusionName))
        checks.positive("depth_noise", self.depth_noise, "metres")
        checks.whole("min_hits", self.min_hits, 1)
        checks.whole("keyframe_iterations", self.keyframe_iterations, 1, limits.STEPS)
