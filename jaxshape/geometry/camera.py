"""Pinhole cameras and the view-points of the paper.

OpenCV axes: x right, y down, z forward. Depth is z, not ray length. The centre of pixel
`(row, column)` is at image coordinates `(u, v) = (column + 0.5, row + 0.5)`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray


class Intrinsics(NamedTuple):
    """A pinhole camera; leading axes are batch axes.

    Attributes:
        fx: Focal length along x `[*batch]`, in pixels.
        fy: Focal length along y `[*batch]`, in pixels.
        cx: Column of the principal point `[*batch]`, in pixels; the centre of the first pixel is at
            0.5.
        cy: Row of the principal point `[*batch]`, in pixels; the centre of the first pixel is at
            0.5.
    """

    fx: Float[Array, "*batch"]
    fy: Float[Array, "*batch"]
    cx: Float[Array, "*batch"]
    cy: Float[Array, "*batch"]


def intrinsics_for(field_of_view: float, image_size: int) -> Intrinsics:
    """The camera of a square image.

    Args:
        field_of_view: Angle between opposite sides, in degrees, between 0 and 180.
        image_size: Pixels along each side.
    """
    focal = 0.5 * image_size / jnp.tan(jnp.deg2rad(field_of_view) / 2)
    center = jnp.asarray(image_size / 2, focal.dtype)
    return Intrinsics(focal, focal, center, center)


def intrinsics_of(K: Float[np.ndarray, "3 3"]) -> Intrinsics:
    """The camera of a camera matrix.

    Args:
        K: Camera matrix, fx 0 cx / 0 fy cy / 0 0 1, in pixels.

    Returns:
        The same numbers in float32.
    """
    return Intrinsics(*jnp.float32([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]))


def project(
    intrinsics: Intrinsics, points: Float[Array, "*batch 3"]
) -> tuple[Float[Array, "*batch 2"], Float[Array, "*batch"]]:
    """Project camera-frame points into the image.

    Points at or behind the camera plane get finite but meaningless image coordinates; recognise
    them by their depth, which is 0 or below.

    Args:
        intrinsics: The camera.
        points: Points in the camera frame `[*batch 3]`, in metres.

    Returns:
        Image coordinates `(u, v)` `[*batch 2]`, in pixels, and depth `[*batch]`, in metres.
    """
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    safe_z = jnp.where(z > 0, z, 1.0)
    u = intrinsics.fx * x / safe_z + intrinsics.cx
    v = intrinsics.fy * y / safe_z + intrinsics.cy
    return jnp.stack([u, v], axis=-1), z


def unproject(
    intrinsics: Intrinsics, depth: Float[Array, "*batch h w"]
) -> Float[Array, "*batch h w 3"]:
    """The camera-frame point that each pixel of a depth image measures.

    Args:
        intrinsics: The camera.
        depth: Depth image `[*batch h w]`, in metres; 0 for missing depth, infinite where the ray
            hit nothing.

    Returns:
        Points `[*batch h w 3]`, in metres; 0 for pixels of depth 0, infinite for pixels of infinite
        depth.
    """
    h, w = depth.shape[-2:]
    u, v = jnp.arange(w) + 0.5, jnp.arange(h) + 0.5
    x = (u - intrinsics.cx) / intrinsics.fx * depth
    y = ((v - intrinsics.cy) / intrinsics.fy)[:, None] * depth
    return jnp.stack([x, y, depth], axis=-1)


def look_up(
    image: Float[Array, "h w *channels"], pixels: Float[Array, "*batch 2"]
) -> Float[Array, "..."]:
    """The values of an image at the pixels that contain the given image points.

    Args:
        image: Any number of values for each pixel, for example a depth image or an image of points.
        pixels: Image coordinates `(u, v)`, in pixels.

    Returns:
        The values `[*batch *channels]`; 0 outside the image.
    """
    h, w = image.shape[:2]
    column, row = pixels[..., 0], pixels[..., 1]
    inside = (column >= 0) & (column < w) & (row >= 0) & (row < h)
    index = jnp.where(inside, row.astype(jnp.int32) * w + column.astype(jnp.int32), h * w)
    return image.reshape(h * w, *image.shape[2:]).at[index].get(mode="fill", fill_value=0.0)


def transform(T_a_b: jaxlie.SE3, points: Float[Array, "*batch n 3"]) -> Float[Array, "*batch n 3"]:
    """Transform points from frame b to frame a.

    For whole clouds, multiplying by a matrix is faster than by quaternions.

    Args:
        T_a_b: Pose of frame b in frame a.
        points: Points in frame b `[*batch n 3]`, in metres.
    """
    return points @ T_a_b.rotation().as_matrix().mT + T_a_b.translation()[..., None, :]


def look_at(eye: Float[Array, "*batch 3"], target: Float[Array, "*batch 3"]) -> jaxlie.SE3:
    """`T_world_camera` of a camera at `eye` whose principal axis passes through `target`.

    World +y is up and the image x-axis stays horizontal (paper, section 2.3), so looking straight
    up or down is undefined.

    Args:
        eye: Position of the camera in the world `[*batch 3]`, in metres.
        target: Point that the principal axis passes through `[*batch 3]`, in metres.
    """
    forward = _unit(target - eye)
    up = jnp.array([0.0, 1.0, 0.0])
    right = _unit(jnp.cross(forward, up))
    down = jnp.cross(forward, right)
    R_world_camera = jnp.stack([right, down, forward], axis=-1)
    return jaxlie.SE3.from_rotation_and_translation(jaxlie.SO3.from_matrix(R_world_camera), eye)


def on_sphere(
    azimuth: Float[Array, "*batch"], elevation: Float[Array, "*batch"], radius: float
) -> jaxlie.SE3:
    """`T_object_camera` of cameras on a sphere that look at the origin.

    Args:
        azimuth: Angle about +y `[*batch]`, in degrees: 0 in front of the object (+z), growing
            towards its +x side.
        elevation: Angle above the horizontal plane `[*batch]`, in degrees.
        radius: Distance from the origin, in metres.
    """
    azimuth, elevation = jnp.deg2rad(azimuth), jnp.deg2rad(elevation)
    direction = jnp.stack(
        [
            jnp.sin(azimuth) * jnp.cos(elevation),
            jnp.sin(elevation),
            jnp.cos(azimuth) * jnp.cos(elevation),
        ],
        axis=-1,
    )
    return look_at(radius * direction, jnp.zeros_like(direction))


def random_views(key: PRNGKeyArray, count: int, radius: float) -> jaxlie.SE3:
    """Training views that look at the origin from random directions (paper, section 2.3).

    Azimuth is uniform in [0, 360), elevation in [30, 60) degrees. The paper prints the two ranges
    in swapped order.

    Args:
        key: Random key of the views.
        count: Number of views, 1 or more.
        radius: Distance from the origin, in metres.

    Returns:
        `T_object_camera` of each view `[count]`.
    """
    azimuth_key, elevation_key = jax.random.split(key)
    azimuth = jax.random.uniform(azimuth_key, (count,), minval=0.0, maxval=360.0)
    elevation = jax.random.uniform(elevation_key, (count,), minval=30.0, maxval=60.0)
    return on_sphere(azimuth, elevation, radius)


def orbit(count: int, radius: float, *, elevation: float = 30.0, step: float = 20.0) -> jaxlie.SE3:
    """Test views around the object at one elevation (paper, section 4.1).

    Args:
        count: Number of views, 1 or more; view j has the azimuth `step * j`.
        radius: Distance from the origin, in metres.
        elevation: Angle above the horizontal plane, in degrees, between -90 and 90.
        step: Azimuth between neighbouring views, in degrees.

    Returns:
        `T_object_camera` of each view `[count]`; the first stands in front of the object.
    """
    azimuth = step * jnp.arange(count, dtype=jnp.float32)
    return on_sphere(azimuth, jnp.full(count, elevation), radius)


def _unit(vector: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
    return vector / jnp.linalg.norm(vector, axis=-1, keepdims=True)
