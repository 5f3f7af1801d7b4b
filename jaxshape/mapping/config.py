"""Settings of tracking and mapping; free of JAX, so that the command line can show them at once."""

from dataclasses import dataclass
from typing import Literal

from jaxshape import checks


@dataclass(frozen=True)
class TrackingConfig:
    """How the pose of a frame is found, and when it is believed."""

    against: Literal["map", "keyframe"] = "map"
    """Align with the last keyframe and the surface of the map, or with the keyframe alone."""
    on: Literal["scene", "object"] = "scene"
    """Align all pixels, where the camera moves through a still room; or those of the object, where
    it turns before a still camera."""
    min_inliers: float = 0.75
    """Share of the points, of those that should be seen again, that must agree."""
    sure_inliers: float = 0.9
    """The same, below which many other guesses are tried: wrong poses explain up to that much."""
    min_overlap: float = 0.25
    """Share of the points that must be seen again."""
    max_angle: float = 35.0
    """Degrees from the expected pose beyond which a pose is not believed."""
    max_distance: float = 0.5
    """Metres from the expected pose beyond which a pose is not believed."""

    def __post_init__(self) -> None:
        checks.one_of("against", self.against, ("map", "keyframe"))
        checks.one_of("on", self.on, ("scene", "object"))
        for share in ("min_inliers", "sure_inliers", "min_overlap"):
            checks.within(share, getattr(self, share), 0, 1)
        checks.positive("max_angle", self.max_angle, "degrees")
        checks.positive("max_distance", self.max_distance, "metres")


@dataclass(frozen=True)
class MappingConfig:
    """When a frame becomes a keyframe, and what the map makes of it."""

    keyframe_angle: float = 10.0
    """Degrees between neighbouring keyframes, as seen from the object."""
    keyframe_distance: float = 0.25
    """Metres between neighbouring keyframes."""
    realign: bool = True
    """Realign all keyframes with the refined shape after each new one."""
    isotropic: bool = False
    """Scale all axes of the grid alike, as the paper does on real data, instead of filling the
    box."""
    min_hits: int = 3
    """Depth points that make a voxel occupied; the paper has 1, more suppress stray points."""
    keyframe_iterations: int = 40
    """Steps of the search after each keyframe, from the code found so far."""

    def __post_init__(self) -> None:
        checks.positive("keyframe_angle", self.keyframe_angle, "degrees")
        checks.positive("keyframe_distance", self.keyframe_distance, "metres")
        for switch in ("realign", "isotropic"):
            checks.one_of(switch, getattr(self, switch), (True, False))
        checks.whole("min_hits", self.min_hits, 1)
        checks.whole("keyframe_iterations", self.keyframe_iterations, 1)
