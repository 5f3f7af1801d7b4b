"""Depth errors of a structured-light sensor, such as the first Kinect.

They grow with the square of depth, since the sensor measures disparity, the inverse of depth
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
"""Standard deviation of noise and quantisation together, in metres at 1 m, rounded."""

SMALLEST_DEVIATION = 5e-4
"""Standard deviation of the depth of near surfaces, in metres."""

UNEVENNESS = 5e-3
"""Largest distance of a floor or a wall from a plane, in metres."""

SPREAD = 5e-3
"""Three standard deviations of the noise and half a step, in metres at 1 m, rounded."""


def depth_deviation(depth: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Standard deviation of a measured depth, from noise and quantisation.

    Args:
        depth: Measured depths `[*batch]`, in metres.

    Returns:
        Standard deviations `[*batch]`, in metres, at least half a millimetre.
    """
    return jnp.maximum(DEVIATION * depth**2, SMALLEST_DEVIATION)


def tolerance(depth: Float[Array | np.ndarray, "*n"]) -> Float[Array | np.ndarray, "*n"]:
    """The distance at which a measured point still counts as lying on a plane.

    Args:
        depth: Depths of the points `[*n]`, in metres.

    Returns:
        Distances `[*n]`, in metres: they cover nearly all of the sensor error, and the unevenness
        of a real floor or wall.
    """
    return UNEVENNESS + SPREAD * depth**2
