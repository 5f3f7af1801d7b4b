"""How far the depths of a structured-light sensor, such as the first Kinect, are off.

All of it grows with the square of depth: the sensor measures disparity, which is its inverse
(Khoshelham and Elberink, Sensors, 2012; Nguyen, Izadi and Lovell, 3DIMPVT, 2012).
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

AXIAL = 1.4e-3
"""Standard deviation of the noise along the ray, in metres at 1 m."""

STEP = 2.8e-3
"""Step of the measured depth, in metres at 1 m."""

DEVIATION = 1.6e-3
"""Standard deviation of noise and quantisation together, in metres at 1 m: both, rounded."""

SMALLEST_DEVIATION = 5e-4
"""Standard deviation of the depth of near things, in metres."""

UNEVENNESS = 5e-3
"""How far, in metres, a floor or a wall may lie off a plane."""

SPREAD = 5e-3
"""Three standard deviations of the noise and half a step, in metres at 1 m, rounded."""


def depth_deviation(depth: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Standard deviation of a measured depth: noise and quantisation.

    Args:
        depth: Metres.

    Returns:
        Metres; never below half a millimetre.
    """
    return jnp.maximum(DEVIATION * depth**2, SMALLEST_DEVIATION)


def tolerance(depth: Float[Array | np.ndarray, "*n"]) -> Float[Array | np.ndarray, "*n"]:
    """How far a measured point may lie from the plane that holds it.

    Args:
        depth: Of the point, in metres.

    Returns:
        Metres: nearly all that the sensor adds, and what a floor that is not flat does.
    """
    return UNEVENNESS + SPREAD * depth**2
