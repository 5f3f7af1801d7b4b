"""Settings of the depth camera that films an object, and of the fusion of its frames.

Nothing here imports JAX, so that the command line starts quickly.
"""

from dataclasses import dataclass
from typing import get_args

from jaxshape import checks
from jaxshape.data.config import CameraName
from jaxshape.geometry.config import FusionName


@dataclass(frozen=True, kw_only=True)
class CameraConfig:
    """A virtual depth camera, and the fusion of its frames.

    Attributes:
        camera: The depth camera: the first Kinect (640 x 480 pixels), an Intel RealSense, the LiDAR
            of an iPhone (256 x 192), or the paper's square images of 96 pixels.
        noise: Give depth images the faults of the camera's sensor; None does so for all cameras
            except the paper's.
        fusion: Method that turns frames into F and M: `distance` averages signed distances on a
            fine grid, `points` counts points in voxels (paper); None selects points for the paper's
            camera without noise, and distances otherwise.

    Raises:
        ValueError: A setting has another value.
    """

    camera: CameraName = "kinect"
    noise: bool | None = None
    fusion: FusionName | None = None

    def __post_init__(self) -> None:
        checks.one_of("camera", self.camera, get_args(CameraName))
        checks.one_of("noise", self.noise, (None, True, False))
        checks.one_of("fusion", self.fusion, (None, *get_args(FusionName)))

    @property
    def is_noisy(self) -> bool:
        """Whether depth images have the faults of the camera's sensor."""
        return self.camera != "paper" if self.noise is None else self.noise

    @property
    def fused_by(self) -> FusionName:
        """Method that fuses frames."""
        clean = self.camera == "paper" and not self.is_noisy
        return self.fusion or ("points" if clean else "distance")
