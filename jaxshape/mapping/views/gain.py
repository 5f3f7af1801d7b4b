"""Information gain of each of many cameras for an object: the expected drop in entropy.

The unknown part of an object is its occluded voxels. Samples of its shape give the uncertainty of
each voxel, its entropy H under the mean of the samples. They also give the share of shapes in which
a camera would see the voxel without occlusion. The expected drop of a camera is

    sum_v  H_v r_v        with r_v the share of voxel v that the camera settles,

where r_v is the probability that v is seen, times the certainty with which the sensor tells a voxel
from its neighbours at that distance. A variant was tried in which seen voxels also inform voxels
that vary with them over the samples, such as the other legs (voxels as jointly normal, with the
covariance of the samples): it chose views that were no better (docs/next_view.md).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
from jax.scipy.special import xlogy
from jaxtyping import Array, Float, Int

from jaxshape.geometry.camera import Intrinsics, project, transform
from jaxshape.geometry.grid import GridFrame, object_from_voxel, voxel_from_object
from jaxshape.geometry.grids import Grids
from jaxshape.geometry.pixels import Sensor
from jaxshape.mapping.views.seeing import MOST_SHAPES, hidden, pack, share
from jaxshape.search.composition import compose

VOXELS = 1024
"""Number of voxels that are evaluated, drawn in proportion to their entropy: gains err by 2 %."""

TURNING = 0.05
"""Cost of walking half round the object, as a share of the greatest gain: among cameras whose gains
are equal within their error, the nearer one comes first."""


class NextViews(NamedTuple):
    """Cameras, ranked by their expected information gain.

    Attributes:
        T_object_camera: Pose of each camera in the object frame `[view]`.
        gain: Expected drop in the entropy of the occluded voxels `[view]`, in nats, 0 or more.
        score: The gain minus the cost of the way to the camera `[view]`, in nats.
        ranking: Numbers of the cameras, the best first `[view]`.
        entropy: Entropy of the occluded voxels before, in nats.
    """

    T_object_camera: jaxlie.SE3
    gain: Float[Array, " view"]
    score: Float[Array, " view"]
    ranking: Int[Array, " view"]
    entropy: Float[Array, ""]


def next_views(
    samples: Float[Array, "sample x y z"],
    grids: Grids,
    frame: GridFrame,
    T_object_camera: jaxlie.SE3,
    intrinsics: Intrinsics,
    shape: tuple[int, int],
    *,
    here: Float[Array, " 3"] | None = None,
    sensor: Sensor = Sensor(),
) -> NextViews:
    """Rank cameras by the expected drop in the entropy of an object's shape.

    Pure JAX; compile it with `jax.jit(js.next_views, static_argnames=("shape", "sensor"))`.

    Args:
        samples: Logits of plausible shapes of one object, 1 to 32 `[sample x y z]`.
        grids: F and M of the object `[x y z]`, binary or soft.
        frame: Voxel frame of the grids.
        T_object_camera: Poses of the cameras to choose from, outside the object's box `[view]`.
        intrinsics: Focal lengths and principal point of the cameras, in pixels.
        shape: Height and width of their images, in pixels.
        here: Where the camera is now, in the object frame `[3]`, in metres; nearby cameras come
            first where gains are about the same. None where that does not matter.
        sensor: How the noise of depth grows with distance.

    Returns:
        The cameras, their gains, and their ranking.

    Raises:
        ValueError: There are no samples or more than 32, or their shape is not that of the grids.
    """
    _check(samples, grids)
    drop, entropy = _gains(samples, grids, frame, T_object_camera, intrinsics, shape, sensor)
    score = drop - _cost(T_object_camera.translation(), here) * TURNING * jnp.max(drop)
    return NextViews(T_object_camera, drop, score, jnp.argsort(-score), entropy)


def _check(samples: Array, grids: Grids) -> None:
    expected = jnp.shape(grids.occupied)
    if samples.ndim != 4 or samples.shape[1:] != expected:
        raise ValueError(
            f"samples have the shape {samples.shape} and the grids {expected}; give samples of one "
            "object as [sample, x, y, z], and its F and M as [x, y, z]."
        )
    if not 1 <= len(samples) <= MOST_SHAPES:
        raise ValueError(
            f"{len(samples)} samples were given; give 1 to {MOST_SHAPES}, such as the first "
            f"{MOST_SHAPES} of them."
        )


def _gains(samples, grids, frame, T_object_camera, intrinsics, shape, sensor):
    """The expected drop of each camera, and the entropy before."""
    n = samples.shape[-1]
    M = jnp.asarray(grids.occluded).astype(samples.dtype)
    probability = jax.nn.sigmoid(samples)
    occupied = jax.vmap(lambda p: compose(grids.occupied, grids.occluded, p))(probability)
    uncertain = (M * _entropy(probability.mean(axis=0))).ravel()
    index, entropy = _drawn(uncertain)
    voxels = jnp.stack(jnp.unravel_index(index, (n, n, n)), axis=-1)
    eyes = voxel_from_object(frame, T_object_camera.translation())
    seen = 1 - share(hidden(pack(occupied), n, voxels, eyes), len(samples))
    points = object_from_voxel(frame, voxels + 0.5)
    seen = seen * _certainty(points, T_object_camera, intrinsics, shape, frame, sensor)
    return entropy * seen.mean(axis=1), entropy


def _entropy(p: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Entropy of an event with probability p, in nats."""
    return -xlogy(p, p) - xlogy(1 - p, 1 - p)


def _drawn(weight: Float[Array, " n"]) -> tuple[Int[Array, " k"], Float[Array, ""]]:
    """Voxels at equal steps of the sum of their weights, and that sum."""
    total = jnp.cumsum(weight)
    steps = (jnp.arange(VOXELS) + 0.5) / VOXELS * total[-1]
    return jnp.minimum(jnp.searchsorted(total, steps), len(weight) - 1), total[-1]


def _certainty(points, T_object_camera, intrinsics, shape, frame, sensor) -> Float[Array, "v k"]:
    """Certainty with which the sensor tells points from their neighbours; 0 outside the image."""
    seen = jax.vmap(transform, in_axes=(0, None))(T_object_camera.inverse(), points)
    pixels, depth = project(intrinsics, seen)
    inside = (pixels >= 0) & (pixels < jnp.array(shape[::-1]))
    half = jnp.mean(frame.voxel_size) / 2
    noise = (sensor.axial * depth**2 / half) ** 2
    return jnp.where(inside.all(axis=-1) & (depth > 0), 1 / (1 + noise), 0)


def _cost(eyes: Float[Array, "view 3"], here: Float[Array, " 3"] | None) -> Float[Array, " view"]:
    """The angle from the present camera position, as a share of half a turn."""
    if here is None:
        return jnp.zeros(len(eyes))
    length = jnp.linalg.norm(eyes, axis=1) * jnp.linalg.norm(here)
    return jnp.arccos(jnp.clip(eyes @ here / jnp.maximum(length, 1e-6), -1, 1)) / jnp.pi
