"""From a recorded RGB-D sequence with known poses to the measurement of one object. [host]"""

from collections.abc import Iterable

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Bool, Float

from jaxshape.data.boxes import Box, points_in_box
from jaxshape.data.sequences import Frame, Sequence, SequenceError
from jaxshape.geometry import camera, fusion, grid
from jaxshape.geometry.camera import Intrinsics
from jaxshape.results.output import Observation

FRAMES_TO_SHOW = 6


def observe_sequence(
    sequence: Sequence,
    chosen: Iterable[int],
    box: Box | None,
    *,
    min_hits: int = 1,
    isotropic: bool = False,
) -> Observation:
    """Fuse the chosen frames of a sequence into the grid of the object's box.

    The object is what lies in the box and, where a frame has a mask, in the mask. Without a box,
    masks are needed: the box is then that of the masked points, upright in a world whose +y is up
    and which the object faces along +z. Frames are read one at a time.
    """
    chosen = list(chosen)
    intrinsics = _intrinsics(sequence)
    box = box or _box_of_masks(sequence, chosen, intrinsics)
    fit = grid.fit_box_isotropic if isotropic else grid.fit_box
    frame = fit(jnp.float32(-box.size / 2), jnp.float32(box.size / 2))
    T_object_world = np.linalg.inv(box.T_world_object)
    merged, shown = fusion.nothing_measured(), []
    every = max(1, len(chosen) // FRAMES_TO_SHOW)
    for i, index in enumerate(chosen):
        image = sequence[index]
        segmented = _segment(image, box, intrinsics)
        pose = jaxlie.SE3.from_matrix(jnp.float32(T_object_world @ image.T_world_camera))
        merged = _add_frame(merged, image.depth, segmented, intrinsics, pose, frame)
        if i % every == 0 and len(shown) < FRAMES_TO_SHOW:
            shown.append(_crop(image.depth, segmented))
    return Observation(
        depth=shown,
        occupied=np.asarray(fusion.occupied(merged, min_hits)),
        occluded=np.asarray(fusion.occluded(merged, min_hits)),
        frame=frame,
        T_world_object=box.T_world_object,
        truth=None,
    )


@jax.jit
def _add_frame(merged, depth, segmented, intrinsics, T_object_camera, frame):
    new = fusion.measure(depth, segmented, intrinsics, T_object_camera, frame)
    return fusion.merge(merged, new)


def _intrinsics(sequence: Sequence) -> Intrinsics:
    K = sequence.intrinsics
    return Intrinsics(*jnp.float32([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]))


def _world_points(image: Frame, intrinsics: Intrinsics) -> Float[np.ndarray, "h w 3"]:
    points = np.asarray(camera.unproject(intrinsics, jnp.asarray(image.depth)), np.float64)
    return points @ image.T_world_camera[:3, :3].T + image.T_world_camera[:3, 3]


def _segment(image: Frame, box: Box, intrinsics: Intrinsics) -> Bool[np.ndarray, "h w"]:
    inside = points_in_box(_world_points(image, intrinsics), box) & (image.depth > 0)
    return inside if image.mask is None else inside & image.mask


def _box_of_masks(sequence: Sequence, chosen: list[int], intrinsics: Intrinsics) -> Box:
    """The upright box of 98 % of the masked points along each axis, a little enlarged."""
    clouds = []
    for index in chosen:
        image = sequence[index]
        if image.mask is not None:
            points = _world_points(image, intrinsics)[image.mask & (image.depth > 0)]
            clouds.append(points[:: max(1, len(points) // 5000)])
    points = np.concatenate(clouds) if clouds else np.zeros((0, 3))
    if len(points) == 0:
        raise SequenceError(
            "No frame has a mask with valid depth in it, so nothing tells the object from the "
            "rest: give its box with --box, or write frame-N.mask.png beside the depth images."
        )
    lower, upper = np.percentile(points, [1, 99], axis=0)
    T_world_object = np.eye(4)
    T_world_object[:3, 3] = (lower + upper) / 2
    return Box(T_world_object, 1.04 * (upper - lower))


def _crop(
    depth: Float[np.ndarray, "h w"], segmented: Bool[np.ndarray, "h w"]
) -> Float[np.ndarray, "a b"]:
    """The part of a depth image that shows the object; all else as background."""
    if not segmented.any():
        return depth
    rows, columns = (np.flatnonzero(segmented.any(axis)) for axis in (1, 0))
    window = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    return np.where(segmented, depth, np.inf)[window]
