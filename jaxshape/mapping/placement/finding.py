"""The object in the first frame that shows it: cut out, and its frame found. [host]

find_start     which frame, which pixels, and where the object stands in the world
on_the_floor   the same, once a later keyframe shows the floor
refitted       the same, once later keyframes show where it ends
placed_again   the same box, estimated from all keyframes so far
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxshape import checks
from jaxshape.data.boxes import Box
from jaxshape.data.sequences import Frame, Sequence, SequenceError
from jaxshape.mapping.placement import placing
from jaxshape.mapping.placement.faces import (
    Cutout,
    between,
    cutouts,
    faces_of,
    fits,
    fitted,
    object_points,
    tallest,
)  # fmt: skip
from jaxshape.mapping.placement.placing import Placement, PlacementConfig, turn
from jaxshape.mapping.placement.rays import pooled, sample_rays
from jaxshape.mapping.segmentation.planes import (
    Floor,
    Plane,
    along_walls,
    camera_points,
    dominant_planes,
    floor_plane,
    height_above,
)  # fmt: skip
from jaxshape.mapping.segmentation.segment import Prompt, Segmentation, segment
from jaxshape.mapping.tracking.keyframes import Keyframe, as_pose, prepare, resized
from jaxshape.model.shapes import ShapePrior

SURE = 0.5
"""Least confidence of a segmentation for its frame to be the first."""

SURE_OF_PROMPT = 0.1
"""Least confidence of a segmentation for its frame to be the first if the user gave a prompt."""

SURE_OF_FRONT = 0.01
"""Least margin over boxes with other fronts, in nats per point, for the front to be sure."""

FIRST_FRAMES = 10
"""Number of frames that are searched for the first one that shows the object well."""

_NEARLY_LEVEL = np.cos(np.radians(50))  # largest angle by which people tilt cameras down
_FLOOR_MARGIN = 0.02  # metres above the floor below which nothing counts as the object
_STEP = 0.04  # metres: least difference in height between two distinct floors
_USUAL = PlacementConfig()
_WITHOUT_POSES = "add --poses none to track the camera from the first frame on"
_ROOM = 0.15  # share by which an estimated box is enlarged before it cuts out the object


class Start(NamedTuple):
    """The object that was found in the first frame of the map.

    Attributes:
        index: Number of the frame in the recording, from 0.
        masked: Pixels of that frame that show the object `[h w]`; None where the box alone defines
            the object.
        core: Pixels among them that surely show the object, whatever later frames show `[h w]`;
            None likewise.
        box: The object's box in the world.
        T_world_camera: Pose of the frame `[4 4]`.
        T_level_world: World to a frame with the same origin and +y up `[4 4]`; None where the box
            was given and stays.
        floor: Height of the floor in the level frame, in metres; NaN where it is not known.
        placement: The placement that the prior found, in the level frame; None where the box was
            given.
        notes: Sentences about the findings and how sure they are.
        warnings: The notes that a user should look at.
    """

    index: int
    masked: Bool[np.ndarray, "h w"] | None
    core: Bool[np.ndarray, "h w"] | None
    box: Box
    T_world_camera: Float[np.ndarray, "4 4"]
    T_level_world: Float[np.ndarray, "4 4"] | None
    floor: float
    placement: Placement | None
    notes: tuple[str, ...]
    warnings: tuple[str, ...]


def room(start: Start) -> float:
    """Share by which the box is enlarged to cut out the object: 0 where the box was given."""
    return 0.0 if start.T_level_world is None else _ROOM


def with_room(start: Start) -> Box:
    """The box that the object is cut out with.

    Args:
        start: The object, with its latest box.
    """
    return start.box._replace(size=(1 + room(start)) * start.box.size)


def find_start(
    sequence: Sequence,
    prior: ShapePrior,
    prompt: Prompt,
    *,
    box: Box | None = None,
    first: int = 0,
    use_pose: bool = True,
) -> Start:
    """Find the object in the first frame that shows it well. [host]

    With a box nothing is searched for. Without one the object is cut out of the frame (`segment`)
    and placed by the prior (`place`), upright on the floor if that is seen.

    Args:
        sequence: The recording, from `open_sequence`.
        prior: The shape prior, of whose class the object is.
        prompt: Where the object is in the image; `Prompt()` looks in the middle of several frames.
        box: The object's box, in the world of the given poses or, without these, of the camera of
            the first frame; None to find it.
        first: Number of the first frame to look at, from 0.
        use_pose: Whether the world is that of the given poses, where there are any.

    Returns:
        The frame, the pixels that show the object, and its box.

    Raises:
        SequenceError: No frame shows the object well enough, can be read, or has a pose where poses
            are used.
        ValueError: No pixel of the image can meet the prompt, or there is no first frame.
    """
    checks.whole("first", first, 0, len(sequence) - 1, "the recording has no more frames")
    use_pose = use_pose and sequence.has_poses
    if box is not None:
        index, frame = first_readable(sequence, first, use_pose)
        T = _world_pose(frame, use_pose)
        said = (
            f"The map begins with {frame.name}: {index - first} frames before it cannot be read or "
            "have no pose.",
        ) * (index > first)
        return Start(index, frame.mask, frame.mask, box, T, None, np.nan, None, said, said)
    reasons = []
    for index in range(first, min(first + FIRST_FRAMES, len(sequence))):
        try:
            frame = sequence[index]
        except SequenceError as problem:
            reasons.append(f"{sequence.names[index]}: {problem}")
            continue
        if use_pose and frame.T_world_camera is None:
            reasons.append(f"{frame.name}: It has no pose; {_WITHOUT_POSES}.")
            continue
        found = segment(frame.depth, frame.color, frame.intrinsics, prompt, frame.mask)
        if found.confidence >= (SURE_OF_PROMPT if _is_prompted(prompt) else SURE):
            return _place_first(sequence, prior, index, frame, found, use_pose)
        reasons.append(f"{frame.name}: {found.reason}")
        if _is_prompted(prompt):
            break  # a place in one image means nothing in another
    raise SequenceError(
        "The object was not found; say where it is with --click, --region, --depth-range or --box, "
        "or give masks. " + " ".join(reasons[:3])
    )


def _is_prompted(prompt: Prompt) -> bool:
    return prompt != Prompt()


def first_readable(sequence: Sequence, first: int, use_pose: bool) -> tuple[int, Frame]:
    """The first frame from a number on that can be read, and its number.

    Args:
        sequence: The recording.
        first: Number of the first frame to look at, from 0.
        use_pose: Whether the frame has to have a pose.

    Raises:
        SequenceError: There is none.
    """
    problem: Exception | None = None
    for index in range(first, len(sequence)):
        try:
            frame = sequence[index]
        except SequenceError as error:
            problem = error
            continue
        if not use_pose or frame.T_world_camera is not None:
            return index, frame
    raise problem or SequenceError(f"No frame from number {first} on has a pose; {_WITHOUT_POSES}.")


def _world_pose(frame: Frame, use_pose: bool) -> Float[np.ndarray, "4 4"]:
    if use_pose and frame.T_world_camera is not None:
        return np.asarray(frame.T_world_camera, np.float64)
    return np.eye(4)


def _place_first(
    sequence: Sequence,
    prior: ShapePrior,
    index: int,
    frame: Frame,
    found: Segmentation,
    use_pose: bool,
) -> Start:
    T_world_camera = _world_pose(frame, use_pose)
    floor, vertical = _floor_and_vertical(frame, found)
    up, of_up = _up(floor, vertical, T_world_camera, use_pose)
    cut = f"{frame.name}: {found.reason}"
    doubts = [cut] * (found.confidence < SURE) + [of_up] * (_sure(floor) is None)
    T_level_world = np.eye(4)
    T_level_world[:3, :3] = rotation_onto_y(up)
    prepared = prepare(frame)
    start = Start(
        index=index,
        masked=found.segmented,
        core=found.core,
        box=Box(np.eye(4), np.ones(3)),
        T_world_camera=T_world_camera,
        T_level_world=T_level_world,
        floor=_floor_height(floor, T_level_world @ T_world_camera),
        placement=None,
        notes=(cut, of_up),
        warnings=tuple(doubts),
    )
    masked = resized(found.segmented, prepared.view.depth.shape)
    seen = Cutout(prepared.view.depth, masked, prepared.view.intrinsics, T_world_camera)
    start = _placed(start, prior, [seen])
    if start.placement is None:
        raise SequenceError(
            f"{frame.name}: the object was segmented, but too little of it was seen to find its "
            "box; give another --first frame, --click elsewhere, or its --box."
        )
    return _with_doubt_of_front(start)


def _with_doubt_of_front(start: Start) -> Start:
    assert start.placement is not None
    if start.placement.margin >= SURE_OF_FRONT:
        return start
    doubt = (
        "The front of the object is not sure: the object is symmetric, or the first frame does not "
        "show its front."
    )
    return start._replace(notes=(*start.notes, doubt), warnings=(*start.warnings, doubt))


def _floor_and_vertical(
    frame: Frame, found: Segmentation
) -> tuple[Floor | None, Float[np.ndarray, " 3"] | None]:
    """The floor, and the direction in which walls stand, as far as the frame shows them."""
    points = camera_points(frame.depth, frame.intrinsics)
    known = frame.depth > 0
    planes = dominant_planes(points[known])
    floor = floor_plane(points[known], planes, points[found.segmented & known])
    return floor, along_walls(planes)


def _sure(floor: Floor | None) -> Floor | None:
    """The floor, if it is sure."""
    return floor if floor is not None and floor.confidence >= SURE else None


def _up(
    floor: Floor | None,
    vertical: Float[np.ndarray, " 3"] | None,
    T_world_camera: Float[np.ndarray, "4 4"],
    has_poses: bool,
) -> tuple[Float[np.ndarray, " 3"], str]:
    """The upward direction in the world, and where it comes from.

    A sure floor takes precedence over walls, and walls over a level surface that may be a table
    top. If none of them is seen, the axes of the world or of the image are used.
    """
    R_world_camera = T_world_camera[:3, :3]
    if vertical is not None and _sure(floor) is None:
        return R_world_camera @ vertical, "No floor is sure; the walls give the up direction."
    if floor is not None:
        up = R_world_camera @ np.asarray(floor.plane.normal, np.float64)
        return up, f"Up is the normal of the floor ({floor.confidence:.0%} sure)."
    of_camera = -R_world_camera[:, 1]
    if has_poses:
        axis, cosine = _nearest_axis(of_camera)
        if cosine > _NEARLY_LEVEL:
            name = "xyz"[int(np.argmax(np.abs(axis)))]
            sign = "+" if axis.sum() > 0 else "-"
            return axis, (
                f"No floor is seen; the world's {sign}{name} is taken as up, the axis nearest to "
                "the image's."
            )
    return of_camera, "No floor is seen; the camera of the first frame is assumed to be level."


def _nearest_axis(up: Float[np.ndarray, " 3"]) -> tuple[Float[np.ndarray, " 3"], float]:
    """The axis of the world, of either sign, nearest to a direction, and the cosine to it."""
    axis = np.zeros(3)
    axis[np.argmax(np.abs(up))] = np.sign(up[np.argmax(np.abs(up))])
    return axis, float(axis @ up)


def _floor_height(floor: Floor | None, T_level_camera: Float[np.ndarray, "4 4"]) -> float:
    """y of the floor in the level frame, where it is sure; else NaN."""
    floor = _sure(floor)
    if floor is None:
        return np.nan
    on_floor = -floor.plane.offset * np.asarray(floor.plane.normal, np.float64)
    return float((T_level_camera[:3, :3] @ on_floor + T_level_camera[:3, 3])[1])


def rotation_onto_y(up: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """The smallest rotation that takes a direction to +y.

    Args:
        up: The direction `[3]`, of any length.
    """
    y = up / np.linalg.norm(up)
    sideways = np.eye(3)[np.argmin(np.abs(y))]
    x = np.eye(3)[0] if abs(y[0]) < 0.9 else sideways
    z = np.cross(x, y)
    z /= np.linalg.norm(z)
    return np.stack([np.cross(y, z), y, z])


# A floor that is seen later ---------------------------------------------------------------------


def on_the_floor(start: Start, keyframes: tuple[Keyframe, ...]) -> Start:
    """The start on the floor that the keyframes show; unchanged where they show no better one.

    Of several floors, the most certain one is used. All measured points of the object must lie
    above it, and no higher than the prior's largest objects reach.

    Args:
        start: The object, with its latest box.
        keyframes: The keyframes of the map.

    Returns:
        The start with up direction and box adapted to the floor; the same one if nothing changes.
    """
    assert start.T_level_world is not None
    points = object_points(cutouts(keyframes))
    floors = [floor_of(one, points) for one in keyframes if one.parts is not None]
    sure = [one for one in floors if one.confidence >= SURE]
    if not sure:
        return start
    best = max(sure, key=lambda one: one.confidence)
    if abs(_height_at(best.plane, start) - start.floor) < _STEP:  # False for NaN
        return start
    return _standing_on(start, best.plane)


def _height_at(floor: Plane, start: Start) -> float:
    """Height, in the level frame, of a floor below the middle of the box."""
    assert start.T_level_world is not None
    middle = start.box.T_world_object[:3, 3]
    below = middle - (floor.normal @ middle + floor.offset) * floor.normal
    return float((start.T_level_world[:3, :3] @ below + start.T_level_world[:3, 3])[1])


def floor_of(keyframe: Keyframe, points: Float[np.ndarray, "n 3"]) -> Floor:
    """The floor of a keyframe in the world, and how sure it is that the object stands on it.

    Args:
        keyframe: The keyframe, with its parts.
        points: Points of the object in the world `[n 3]`, in metres.
    """
    assert keyframe.parts is not None
    T = np.asarray(keyframe.T_world_camera.as_matrix(), np.float64)
    normal = T[:3, :3] @ keyframe.parts.floor[:3]
    offset = float(keyframe.parts.floor[3] - normal @ T[:3, 3])
    plane = Plane(normal, offset, 0.0)
    height = height_above(plane, points)
    if not len(points) or not np.isfinite(offset):
        return Floor(plane, 0.0)
    below = float(np.clip(1 - np.mean(height < -_STEP) / 0.05, 0, 1))
    within = np.percentile(height, 99) < tallest()
    return Floor(plane, keyframe.parts.evidence * below * within)


def _standing_on(start: Start, floor: Plane) -> Start:
    """The start in a level frame whose up is the normal of a floor, with the box standing on it."""
    assert start.T_level_world is not None
    T_level_world = np.eye(4)
    T_level_world[:3, :3] = rotation_onto_y(np.asarray(floor.normal, np.float64))
    T_level_object = T_level_world @ start.box.T_world_object
    front = T_level_object[:3, 2]
    T_level_object[:3, :3] = np.asarray(turn(jnp.arctan2(front[0], front[2])), np.float64)
    box = Box(np.linalg.inv(T_level_world) @ T_level_object, start.box.size)
    height = -floor.offset  # of the floor, along its normal, from the origin
    lower, upper = -box.size / 2, box.size / 2
    lower[1] = height - T_level_object[1, 3]
    said = "Up and the floor come from a later keyframe, the first one that shows them well."
    kept = tuple(one for one in start.warnings if one not in start.notes[:2])
    start = start._replace(
        T_level_world=T_level_world,
        floor=height,
        notes=tuple(dict.fromkeys((*start.notes, said))),
        warnings=kept,
    )
    return _in_box(start, without_floor(between(box, lower, upper), height))


# A face that is seen later -----------------------------------------------------------------------


def refitted(start: Start, keyframes: tuple[Keyframe, ...]) -> Start:
    """The start with its box fitted to where the keyframes saw the object end.

    Args:
        start: The object, with its latest box.
        keyframes: The keyframes of the map.

    Returns:
        The start; the same one where its box fits.
    """
    faces = faces_of(start.box, cutouts(keyframes))
    if start.placement is None or fits(start.box, faces):
        return start
    return _in_box(start, fitted(start.box, faces))


# Placement --------------------------------------------------------------------------------------


def placed_again(
    start: Start,
    prior: ShapePrior,
    keyframes: tuple[Keyframe, ...],
    config: PlacementConfig = _USUAL,
) -> Start:
    """The start with its box estimated from all keyframes, beginning at its earlier placement.

    Args:
        start: The object, with its latest box.
        prior: The shape prior of its class.
        keyframes: The keyframes of the map.
        config: Settings of the placement: sizes of the class, and the length of the search.
    """
    return _placed(start, prior, cutouts(keyframes), config)


def _placed(
    start: Start,
    prior: ShapePrior,
    frames: list[Cutout],
    config: PlacementConfig = _USUAL,
) -> Start:
    """The start with the box that the prior finds; unchanged where nothing can be placed.

    Its faces lie where the object was seen to end.
    """
    assert start.T_level_world is not None
    known = start.placement or placing.nothing_known(prior)
    each = [
        _sample_rays(jax.random.key(number), jnp.asarray(depth), jnp.asarray(masked), intrinsics)
        for number, (depth, masked, intrinsics, _) in enumerate(frames)
    ]
    poses = [as_pose(start.T_level_world @ one.T_world_camera) for one in frames]
    seen = _pooled(_stacked(each), _stacked(poses))
    found = _place(prior, seen, jnp.float32(start.floor), known, config)
    if not np.isfinite(found.misfit):
        return start
    T_level_object = np.asarray(found.T_world_object.as_matrix(), np.float64)
    box = Box(np.linalg.inv(start.T_level_world) @ T_level_object, np.asarray(found.size, float))
    box = without_floor(box, start.floor)
    return _in_box(start._replace(placement=found), fitted(box, faces_of(box, frames)))


def _in_box(start: Start, box: Box) -> Start:
    """The start with this box, and with its placement moved to the same box."""
    assert start.placement is not None and start.T_level_world is not None
    T_level_object = as_pose(start.T_level_world @ box.T_world_object)
    found = start.placement._replace(T_world_object=T_level_object, size=jnp.float32(box.size))
    return start._replace(placement=found, box=box)


def _stacked(trees: list[Any]) -> Any:
    return jax.tree.map(lambda *x: jnp.stack(x), *trees)


_sample_rays = jax.jit(sample_rays)
_pooled = jax.jit(pooled)
_place = jax.jit(placing.place, static_argnums=4)


def without_floor(box: Box, floor: float) -> Box:
    """The box without the floor and a thin layer above it.

    Args:
        box: The box.
        floor: Height of the floor in the level frame, in metres; NaN where it is not known.
    """
    if not np.isfinite(floor):
        return box
    bottom = -box.size[1] / 2
    slab = [[-9.0, -9.0, -9.0], [9.0, bottom + _FLOOR_MARGIN, 9.0]]
    return box._replace(exclude=np.array([slab]))
