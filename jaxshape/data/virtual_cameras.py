"""Depth cameras that can be simulated."""

from dataclasses import dataclass, field

from jaxshape import checks
from jaxshape.data.config import CameraName
from jaxshape.geometry import sensor


@dataclass(frozen=True)
class SensorNoise:
    """The faults of a structured-light sensor such as the first Kinect.

    Standard deviations and steps grow with the square of depth, see `jaxshape.geometry.sensor`.

    Attributes:
        axial: Standard deviation along the ray, in metres at 1 m; grows with the square of depth.
        lateral: Standard deviation across the image, in pixels (0.8 of the Kinect's, which are
            smaller).
        quantization: Step of the measured depth, in metres at 1 m; grows with the square of depth.
        dropout: Probability that a pixel at a depth edge is lost, 0 to 1.
        grazing: Surfaces seen at more than this angle from their normal are lost, in degrees.

    Raises:
        ValueError: A value is outside its range.
    """

    axial: float = sensor.AXIAL
    lateral: float = 0.3
    quantization: float = sensor.STEP
    dropout: float = 0.3
    grazing: float = 80.0

    def __post_init__(self) -> None:
        checks.at_least("axial", self.axial, 0)
        checks.at_least("lateral", self.lateral, 0)
        checks.positive("quantization", self.quantization, "metres")
        checks.within("dropout", self.dropout, 0, 1)
        checks.within("grazing", self.grazing, 0, 180)


@dataclass(frozen=True)
class VirtualCamera:
    """A depth camera, and its usual distance.

    Attributes:
        width: Pixels along each row.
        height: Pixels along each column.
        field_of_view: Horizontal field of view, in degrees; None for the largest focal length with
            which every view shows the whole object, as in the paper.
        distance: Distance of the camera from the object's centre, in diagonals of its bounding box.
        noise: The faults of its sensor, if noise is requested.

    Raises:
        ValueError: The image is empty, the camera stands inside the object, or the field of view
            does not fit the image.
    """

    width: int
    height: int
    field_of_view: float | None
    distance: float = 1.5
    noise: SensorNoise = field(default_factory=SensorNoise)

    def __post_init__(self) -> None:
        checks.whole("width", self.width, 1)
        checks.whole("height", self.height, 1)
        if self.field_of_view is None and self.width != self.height:
            checks.refuse("field_of_view", None, "degrees, or as many rows as columns")
        if self.field_of_view is not None and not 0 < self.field_of_view < 180:
            checks.refuse("field_of_view", self.field_of_view, "degrees above 0 and below 180")
        if not self.distance > 0.5:
            checks.refuse("distance", self.distance, "more than 0.5 diagonals, outside the object")


CAMERAS: dict[CameraName, VirtualCamera] = {
    # The paper does not give the size of its images.
    "paper": VirtualCamera(96, 96, None),
    # The first Kinect, of a focal length of 525 pixels; a chair of 0.85 m then stands 2 m away.
    "kinect": VirtualCamera(640, 480, 62.7, 1.8),
    # D435: 87 degrees over 848 pixels, of which 640 are kept; an error of 0.08 pixels of disparity
    # between sensors that are 50 mm apart.
    "realsense": VirtualCamera(
        640, 480, 71.2, 1.3, SensorNoise(4e-3, 0.5, 1e-4, dropout=0.5, grazing=85.0)
    ),
    # A network interpolates surfaces through a grid of points, so that edges are soft, no pixels
    # are lost, and the error is about 1 cm in a room (Luetzenburg et al., Scientific Reports,
    # 2021).
    "iphone-lidar": VirtualCamera(
        256, 192, 62.0, 1.2, SensorNoise(3e-3, 0.6, 1e-3, dropout=0.0, grazing=88.0)
    ),
}
"""Cameras by name. At these distances a chair covers about 240 pixels of a Kinect; people stand
nearer with a wider lens or fewer pixels."""


def virtual_camera(name: CameraName) -> VirtualCamera:
    """A depth camera by name, at the distance from which people use it.

    Args:
        name: "kinect", "realsense", "iphone-lidar", or "paper" for the paper's square images.

    Raises:
        ValueError: There is no camera of that name.
    """
    checks.one_of("camera", name, CAMERAS)
    return CAMERAS[name]
