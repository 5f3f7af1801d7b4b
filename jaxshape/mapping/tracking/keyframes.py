"""Frames as the map keeps them, and the place of the object's grids in the world. [host]"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxshape.data.boxes import Box, points_in_box
from jaxshape.data.sequences import Frame
from jaxshape.geometry import grid
from jaxshape.geometry.camera import Intrinsics, intrinsics_of
from jaxshape.geometry.grid import GridFrame
from jaxshape.mapping.segmentation.parts import Parts
from jaxshape.mapping.tracking import icp
from jaxshape.mapping.tracking.icp import Cloud
from jaxshape.mapping.tracking.surfels import CELLS, Lattice
from jaxshape.mapping.tracking.views import DepthView, halved, view_of

WORKING_WIDTH = 400
"""Images wider than this are halved: tracking needs no more than 320 x 240 pixels."""

_STRIDE = 2  # pixels between the points that a keyframe keeps


class DepthImage(NamedTuple):
    """A depth image as it was recorded.

    Attributes:
        depth: Depth image `[h w]`, in metres; 0 where nothing is known, infinite where the ray met
            nothing.
        intrinsics: The camera.
    """

    depth: Float[Array, "h w"]
    intrinsics: Intrinsics


class PreparedFrame(NamedTuple):
    """One frame, prepared for tracking and mapping.

    Attributes:
        view: Depth image at working size, with its oriented points.
        masked: Pixels that may show the object `[h w]`: a given mask, or all.
        recorded: The depth image in full size; None where that is the working size.
        parts: Parts that the image falls into; None where the box alone defines the object.
        instances: Number of the object that each pixel shows `[h w]`, 0 for none; None where no
            mask numbers them.
    """

    view: DepthView
    masked: Bool[Array, "h w"]
    recorded: DepthImage | None = None
    parts: Parts | None = None
    instances: Int[np.ndarray, "h w"] | None = None


# The parts of a frame, and the pixels that show the object, from the pose of the camera.
Cut = Callable[[jaxlie.SE3], tuple[Parts, Bool[Array, "h w"]]]


class Keyframe(NamedTuple):
    """The part of a frame that the map keeps.

    Attributes:
        depth: Depth image `[h w]`, in metres; 0 where nothing is known, infinite where the ray met
            nothing.
        masked: Pixels that may show the object `[h w]`: a given mask, or all.
        segmented: Pixels that show the object `[h w]`.
        intrinsics: The camera.
        cloud: Oriented points of the object, in the frame of the camera.
        T_world_camera: Present pose of the keyframe.
        T_previous_keyframe: Tracked pose relative to the keyframe before.
        information: Inverse covariance of that relative pose `[6 6]`, in the frame of the keyframe
            before; 0 for the first.
        recorded: The depth image in full size, which is fused; None where that is the working size.
        parts: Parts that the image falls into; None where the box alone defines the object.
    """

    depth: Float[Array, "h w"]
    masked: Bool[Array, "h w"]
    segmented: Bool[Array, "h w"]
    intrinsics: Intrinsics
    cloud: Cloud
    T_world_camera: jaxlie.SE3
    T_previous_keyframe: jaxlie.SE3
    information: Float[Array, "6 6"]
    recorded: DepthImage | None = None
    parts: Parts | None = None


class Place(NamedTuple):
    """Where the object's grids lie in the world.

    Attributes:
        box: The object's box.
        cut: The box whose content is taken for the object.
        frame: Voxel frame of the grids, in the object frame.
        lattice: Cells of the surface, in the world.
    """

    box: Box
    cut: Box
    frame: GridFrame
    lattice: Lattice


def place_of(box: Box, resolution: int, room: float = 0.0, *, isotropic: bool = False) -> Place:
    """The voxel frame of a resolution and the lattice of the surface that fill a box.

    Args:
        box: The object's box in the world.
        resolution: Voxels along each axis of the grids.
        room: Share by which the box that cuts out the object is larger.
        isotropic: Whether all axes have one scale.
    """
    fit = grid.fit_box_isotropic if isotropic else grid.fit_box
    frame = fit(jnp.float32(-box.size / 2), jnp.float32(box.size / 2), resolution=resolution)
    R, t = box.T_world_object[:3, :3], box.T_world_object[:3, 3]
    scale = CELLS / resolution / np.asarray(frame.voxel_size, np.float64)
    linear = scale[:, None] * R.T
    offset = -linear @ t - scale * np.asarray(frame.origin, np.float64)
    cut = box._replace(size=(1 + room) * box.size)
    return Place(box, cut, frame, Lattice(jnp.float32(linear), jnp.float32(offset)))


def keyframe_of(
    prepared: PreparedFrame,
    place: Place,
    T_world_camera: jaxlie.SE3,
    odometry: tuple[jaxlie.SE3, Float[Array, "6 6"]] | None,
    segmented: Bool[Array, "h w"] | None = None,
) -> Keyframe:
    """The part of a frame that the map keeps.

    Args:
        prepared: The frame.
        place: Where the object's grids lie.
        T_world_camera: Pose of the frame.
        odometry: Its pose relative to the keyframe before, and the inverse covariance of that pose;
            None for the first.
        segmented: The object's pixels; None for all pixels in its box.

    Returns:
        The keyframe.
    """
    if segmented is None:
        segmented = object_pixels(prepared, place, T_world_camera)
    T_previous, information = odometry or (jaxlie.SE3.identity(), jnp.zeros((6, 6)))
    return Keyframe(
        depth=prepared.view.depth,
        masked=prepared.masked,
        segmented=segmented,
        intrinsics=prepared.view.intrinsics,
        cloud=_cloud(prepared.view, segmented),
        T_world_camera=T_world_camera,
        T_previous_keyframe=T_previous,
        information=information,
        recorded=prepared.recorded,
        parts=prepared.parts,
    )


def to_fuse(keyframe: Keyframe) -> tuple[DepthImage, Bool[Array, "h w"]]:
    """The depth image of a keyframe in full size, and its pixels that show the object."""
    if keyframe.recorded is None:
        return DepthImage(keyframe.depth, keyframe.intrinsics), keyframe.segmented
    (h, w), (rows, columns) = keyframe.recorded.depth.shape, keyframe.segmented.shape
    segmented = keyframe.segmented.repeat(h // rows, axis=0).repeat(w // columns, axis=1)
    missing = [(0, n - m) for n, m in zip((h, w), segmented.shape, strict=True)]
    return keyframe.recorded, jnp.pad(segmented, missing)


def cut_anew(
    keyframe: Keyframe, place: Place, segmented: Bool[Array, "h w"] | None = None
) -> Keyframe:
    """The keyframe with the object cut out of it by another box, or with these pixels of it."""
    prepared = PreparedFrame(view_again(keyframe.depth, keyframe.intrinsics), keyframe.masked)
    if segmented is None:
        segmented = object_pixels(prepared, place, keyframe.T_world_camera)
    return keyframe._replace(segmented=segmented, cloud=_cloud(prepared.view, segmented))


def object_pixels(
    prepared: PreparedFrame, place: Place, T_world_camera: jaxlie.SE3
) -> Bool[Array, "h w"]:
    """Pixels that may show the object and whose points lie in its box."""
    T = np.asarray(T_world_camera.as_matrix(), np.float64)
    points = np.asarray(prepared.view.points, np.float64) @ T[:3, :3].T + T[:3, 3]
    inside = points_in_box(points, place.cut) & (np.asarray(prepared.view.points[..., 2]) > 0)
    return prepared.masked & inside


_cloud = jax.jit(partial(icp.cloud_of, stride=_STRIDE))
view_again = jax.jit(view_of)
"""The view of a depth image that a keyframe kept."""


# Frames ------------------------------------------------------------------------------------------


def prepare(frame: Frame, masked: Bool[np.ndarray, "h w"] | None = None) -> PreparedFrame:
    """A frame at working size, with its oriented points.

    Args:
        frame: The frame.
        masked: Pixels that may show the object, in place of its own mask; None for that mask.
    """
    halvings = 0
    while frame.depth.shape[1] >> halvings > WORKING_WIDTH:
        halvings += 1
    image = DepthImage(jnp.asarray(frame.depth), intrinsics_of(frame.intrinsics))
    view = _view(*image, halvings)
    mask = frame.mask if masked is None else masked
    shape = view.depth.shape
    may_show = jnp.ones(shape, bool) if mask is None else resized(mask, shape)
    numbers = frame.instances
    if numbers is not None:
        step = numbers.shape[1] // shape[1]
        numbers = numbers[step // 2 :: step, step // 2 :: step][: shape[0], : shape[1]]
    return PreparedFrame(view, may_show, image if halvings else None, None, numbers)


@partial(jax.jit, static_argnums=2)
def _view(depth, intrinsics, halvings: int):
    for _ in range(halvings):
        depth, intrinsics = halved(depth, intrinsics)
    return view_of(depth, intrinsics)


def resized(mask: Bool[np.ndarray, "h w"], shape: tuple[int, ...]) -> Bool[Array, "_ _"]:
    """The mask at a whole fraction of its size: True where most of the pixels are."""
    k = mask.shape[1] // shape[1]
    h, w = shape[0] * k, shape[1] * k
    return jnp.asarray(mask[:h, :w].reshape(shape[0], k, shape[1], k).mean(axis=(1, 3)) > 0.5)


def as_pose(T: Float[np.ndarray, "4 4"]) -> jaxlie.SE3:
    """A 4x4 matrix of NumPy as a pose in JAX."""
    return jaxlie.SE3.from_matrix(jnp.float32(T)).normalize()
