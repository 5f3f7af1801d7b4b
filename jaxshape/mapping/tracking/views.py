"""A depth image as oriented points, which tracking aligns.

Points and normals come from the image after edge-preserving smoothing, because the raw pixels of a
structured-light sensor say little about the direction of a surface.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxshape.geometry import camera
from jaxshape.geometry.camera import Intrinsics
from jaxshape.geometry.sensor import depth_deviation

JUMP = 0.03
"""Neighbouring pixels lie on two surfaces if their depths differ by more than this share."""

_TAPS = (0.06, 0.25, 0.38, 0.25, 0.06)  # weights of the smoothing along each axis


class DepthView(NamedTuple):
    """A depth image, and the oriented points it measures, in the frame of its camera.

    Attributes:
        depth: Depth as measured `[h w]`, in metres; 0 where nothing is known, infinite where the
            ray met nothing.
        points: Points of the smoothed depth image `[h w 3]`, in metres.
        normals: Unit normals towards the camera `[h w 3]`; 0 where they are not known.
        intrinsics: The camera.
    """

    depth: Float[Array, "h w"]
    points: Float[Array, "h w 3"]
    normals: Float[Array, "h w 3"]
    intrinsics: Intrinsics


def view_of(depth: Float[Array, "h w"], intrinsics: Intrinsics) -> DepthView:
    """The oriented points of a depth image in metres."""
    known = jnp.where(jnp.isfinite(depth), depth, 0)
    smooth = _smooth_rows(_smooth_rows(known).T).T
    points = camera.unproject(intrinsics, smooth)
    return DepthView(depth, points, _normals(points), intrinsics)


def is_oriented(view: DepthView) -> Bool[Array, "h w"]:
    """Pixels whose point and normal are both known."""
    return jnp.any(view.normals != 0, axis=-1)


def halved(
    depth: Float[Array, "h w"], intrinsics: Intrinsics
) -> tuple[Float[Array, "h//2 w//2"], Intrinsics]:
    """A depth image of half the size, and its camera.

    A new pixel is the mean of the pixels in its 2 x 2 block that lie on the nearest surface. Where
    nothing in a block was measured, it is infinite if most rays met nothing, else 0 (unknown).
    """
    h, w = depth.shape
    blocks = depth[: h // 2 * 2, : w // 2 * 2].reshape(h // 2, 2, w // 2, 2)
    measured = (blocks > 0) & jnp.isfinite(blocks)
    nearest = jnp.min(blocks, axis=(1, 3), keepdims=True, where=measured, initial=jnp.inf)
    same = measured & (blocks < (1 + JUMP) * nearest)
    count = same.sum(axis=(1, 3))
    mean = jnp.where(same, blocks, 0).sum(axis=(1, 3)) / jnp.maximum(count, 1)
    is_empty = jnp.isinf(blocks).sum(axis=(1, 3)) > 2
    half = jnp.where(count > 0, mean, jnp.where(is_empty, jnp.inf, 0.0))
    return half, Intrinsics(*(x / 2 for x in intrinsics))


def _smooth_rows(depth: Float[Array, "h w"]) -> Float[Array, "h w"]:
    """Weighted mean around each pixel in its row, without pixels of other surfaces.

    A neighbour counts no more than the one opposite: otherwise, at the end of a slope, the mean
    would lie off the slope.
    """
    scale = 3 * depth_deviation(depth) + JUMP / 3 * depth
    padded = jnp.pad(depth, ((0, 0), (2, 2)))
    others = jnp.stack([padded[:, i : i + depth.shape[1]] for i in range(len(_TAPS))])
    likeness = jnp.where(others > 0, jnp.exp(-(((others - depth) / scale) ** 2)), 0)
    weights = jnp.minimum(likeness, likeness[::-1]) * jnp.array(_TAPS)[:, None, None]
    total = jnp.sum(weights * others, axis=0)
    return jnp.where(depth > 0, total / jnp.where(depth > 0, weights.sum(axis=0), 1), 0)


def _normals(points: Float[Array, "h w 3"]) -> Float[Array, "h w 3"]:
    """Normals from the differences between the neighbours of each pixel."""
    padded = jnp.pad(points, ((1, 1), (1, 1), (0, 0)))
    depth = points[..., 2]

    def difference(before, after):
        jump = JUMP * depth
        near = (jnp.abs(before[..., 2] - depth) < jump) & (jnp.abs(after[..., 2] - depth) < jump)
        return after - before, near & (before[..., 2] > 0) & (after[..., 2] > 0)

    across, has_row = difference(padded[1:-1, :-2], padded[1:-1, 2:])
    down, has_column = difference(padded[:-2, 1:-1], padded[2:, 1:-1])
    normal = jnp.cross(down, across)  # x right and y down: towards the camera
    length = jnp.linalg.norm(normal, axis=-1, keepdims=True)
    known = (has_row & has_column & (depth > 0))[..., None] & (length > 0)
    return jnp.where(known, normal / jnp.where(known, length, 1), 0)
