"""Cameras that a person can hold around an object, and their positions in words.

They lie on a sphere around the object and look at its centre. Azimuth is 0 in front of the object,
+z, and grows towards its left side, +x: left as someone sees it who sits on the chair.
"""

import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Float

from jaxshape import checks
from jaxshape.geometry.camera import look_at

AZIMUTHS, ELEVATIONS = 36, 7
"""Candidates: 252, every 10 degrees around the object."""

HEIGHTS = (0.3, 2.0)
"""Lowest and highest camera that a person holds, in metres above the floor."""

STEEPEST = 75.0
"""Elevation in degrees above which a camera looks straight down and its image turns."""

SIDES = ("the front", "its left side", "behind", "its right side")
TOWARDS = ("its front", "its left side", "its back", "its right side")


def reachable_views(
    radius: float,
    floor: float,
    *,
    azimuths: int = AZIMUTHS,
    elevations: int = ELEVATIONS,
    heights: tuple[float, float] = HEIGHTS,
) -> jaxlie.SE3:
    """Cameras on a sphere around an object that a person can reach. [host]

    Args:
        radius: Distance of the cameras from the origin of the object frame, in metres, above 0.
        floor: Height of the floor in the object frame, in metres.
        azimuths: Cameras on each circle around the object, 1 or more.
        elevations: Circles, 1 or more, from the lowest to the highest that can be reached.
        heights: Lowest and highest camera above the floor, in metres.

    Returns:
        `T_object_camera` of each camera `[azimuths * elevations]`, circle by circle.

    Raises:
        ValueError: A number is outside its range.
    """
    checks.positive("radius", radius, "metres")
    checks.whole("azimuths", azimuths, 1)
    checks.whole("elevations", elevations, 1)
    if heights[0] > heights[1]:
        checks.refuse("heights", heights, "the lowest camera before the highest, in metres")
    highest = np.sin(np.radians(STEEPEST))
    low, high = np.arcsin(np.clip((np.array(heights) + floor) / radius, -highest, highest))
    elevation = np.linspace(low, high, elevations).repeat(azimuths)
    azimuth = np.tile(2 * np.pi * np.arange(azimuths) / azimuths, elevations)
    level = np.cos(elevation)
    toward = [np.sin(azimuth) * level, np.sin(elevation), np.cos(azimuth) * level]
    eye = jnp.float32(radius * np.stack(toward, axis=1))
    return look_at(eye, jnp.zeros_like(eye))


def in_words(eye: Float[np.ndarray, " 3"], floor: float) -> str:
    """Where a camera is, relative to the front of an object and to the floor.

    Args:
        eye: Position of the camera in the object frame, in metres.
        floor: Height of the floor in the object frame, in metres.

    Returns:
        Words such as "from behind, 40 degrees towards its left side, at 1.5 m, camera 1.2 m above
        the floor".
    """
    azimuth = np.degrees(np.arctan2(eye[0], eye[2]))
    quarter = int(np.rint(azimuth / 90))
    turned = azimuth - 90 * quarter
    words = [f"from {SIDES[quarter % 4]}"]
    if round(abs(turned)) > 0:
        neighbour = (quarter + (1 if turned > 0 else -1)) % 4
        words.append(f"{abs(turned):.0f} degrees towards {TOWARDS[neighbour]}")
    words.append(f"at {np.linalg.norm(eye):.1f} m")
    return ", ".join([*words, f"camera {eye[1] - floor:.1f} m above the floor"])
