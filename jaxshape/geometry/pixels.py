"""Depth and slope of the surface that each pixel of a depth image shows.

A pixel at a depth jump shows no surface: its depth may belong to either side or to neither.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, UInt32

from jaxshape import checks
from jaxshape.geometry.camera import Intrinsics
from jaxshape.geometry.sensor import DEVIATION

STEEPEST = 0.1
"""Smallest accepted cosine between a ray and the normal of the surface that it hits."""


@dataclass(frozen=True)
class Sensor:
    """Noise of a depth camera.

    Attributes:
        axial: Standard deviation of depth, in metres at 1 m; grows with the square of depth.
        floor: Standard deviation of errors that do not grow with depth, in metres: calibration and
            poses.

    Raises:
        ValueError: A deviation is negative.
    """

    axial: float = DEVIATION
    floor: float = 3e-3

    def __post_init__(self) -> None:
        checks.at_least("axial", self.axial, 0)
        checks.at_least("floor", self.floor, 0)


class SurfacePixels(NamedTuple):
    """The planes fitted to the surfaces in pixels.

    Attributes:
        depth: Depth in metres, averaged over the neighbours on the same surface; for pixels without
            a surface, the depth of the nearest neighbour. 0 for missing depth, infinite where the
            ray hit nothing.
        slope: Metres from the plane for each metre along the optical axis; 0 for pixels without a
            surface.
    """

    depth: Float[Array, "*n"]
    slope: Float[Array, "*n"]


def surface_pixels(
    depth: Float[Array, "h w"],
    segmented: Bool[Array, "h w"],
    intrinsics: Intrinsics,
    sensor: Sensor = Sensor(),
) -> SurfacePixels:
    """Fit a plane to each pixel's neighbourhood, and find the pixels that show no surface.

    The inverse depth of a plane is affine in pixel coordinates, so means and slopes of inverse
    depth are exact for planes.
    """
    known = depth > 0
    inverse = jnp.where(known, 1 / jnp.where(known, depth, 1), -1.0)  # 0 where infinite
    # Noise of inverse depth is the same at all depths; the second term allows a slope of 80
    # degrees.
    tolerance = 4 * sensor.axial + 5.7 * inverse / jnp.minimum(intrinsics.fx, intrinsics.fy)
    jump, total, count = jnp.zeros(depth.shape, bool), inverse, jnp.ones_like(depth)
    nearest = inverse
    for other, _, _ in _neighbours(inverse, 1):
        valid = other >= 0
        jump |= valid & (other - inverse > tolerance)
        same = valid & (jnp.abs(other - inverse) <= tolerance)
        total += jnp.where(same, other, 0)
        count += same
        nearest = jnp.maximum(nearest, other)
    mean = jnp.where(inverse > 0, total / count, inverse)

    sum_x = sum_y = jnp.zeros_like(depth)
    sum_xx = sum_yy = jnp.full_like(depth, 1e-6)
    for other, dx, dy in _neighbours(mean, 2):
        same = (other > 0) & (jnp.abs(other - mean) < 2 * tolerance)
        change = jnp.where(same, other - mean, 0)
        sum_x, sum_xx = sum_x + dx * change, sum_xx + dx * dx * same
        sum_y, sum_yy = sum_y + dy * change, sum_yy + dy * dy * same
    a, b = sum_x / sum_xx * intrinsics.fx, sum_y / sum_yy * intrinsics.fy
    h, w = depth.shape
    x = (jnp.arange(w) + 0.5 - intrinsics.cx) / intrinsics.fx
    y = ((jnp.arange(h) + 0.5 - intrinsics.cy) / intrinsics.fy)[:, None]
    c = mean - a * x - b * y  # the plane is a x + b y + c = 1 / z
    slope = jnp.maximum(mean, 1e-6) / jnp.sqrt(a * a + b * b + c * c + 1e-12)
    surface = segmented & (inverse > 0) & ~jump & (slope > STEEPEST)
    shown = jnp.where(surface, mean, nearest)
    measured = jnp.where(known, 1 / jnp.where(shown > 0, shown, 1), 0)
    measured = jnp.where(known & (shown == 0), jnp.inf, measured)
    return SurfacePixels(measured, jnp.where(surface, slope, 0))


GREATEST = 2.0
"""Slope in the corner of an image of 120 degrees; on the optical axis it is at most 1."""

SLOPE_BITS = 8
"""Bits of the slope, among the 32 of a pixel: depth keeps 15 bits of mantissa, 0.06 mm at 2 m."""


def pack(pixels: SurfacePixels) -> UInt32[Array, "*n"]:
    """Depth, with the slope in its last bits, so that one look-up reads both."""
    steps = 2**SLOPE_BITS - 1
    bits = lax.bitcast_convert_type(pixels.depth, jnp.uint32)
    slope = jnp.rint(jnp.minimum(pixels.slope / GREATEST, 1) * steps)
    return (bits & ~jnp.uint32(steps)) | slope.astype(jnp.uint32)


def unpack(packed: UInt32[Array, "*n"]) -> SurfacePixels:
    """The pixels that were packed."""
    steps = jnp.uint32(2**SLOPE_BITS - 1)
    depth = lax.bitcast_convert_type(packed & ~steps, jnp.float32)
    return SurfacePixels(
        depth, (packed & steps).astype(jnp.float32) * (GREATEST / (2**SLOPE_BITS - 1))
    )


def _neighbours(image: Float[Array, "h w"], step: int):
    """The image shifted by `step` pixels in eight directions, -1 beyond its border."""
    h, w = image.shape
    padded = jnp.pad(image, step, constant_values=-1.0)
    for dy in (-step, 0, step):
        for dx in (-step, 0, step):
            if dx or dy:
                yield padded[step + dy : step + dy + h, step + dx : step + dx + w], dx, dy
