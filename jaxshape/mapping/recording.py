"""A recording from its first frame to its last: the object is found, frames are followed. [host]

    start = find_start(sequence, prior, Prompt(click=(320, 240)))
    for progress in follow(sequence, start, mapper):
        ...                              # after every frame; write, draw, or stop and go on later
    state, reconstruction = mapper.finish(progress.state)

Whatever is wrong with one frame, a damaged file or a pose in doubt, costs that frame alone and is
written down in its `FrameLog`.
"""

from collections.abc import Iterable, Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxshape.data.boxes import Box, points_in_box
from jaxshape.data.sequences import Frame, Sequence, SequenceError
from jaxshape.geometry import camera
from jaxshape.geometry.camera import Intrinsics
from jaxshape.mapping import placement
from jaxshape.mapping.incremental import Keyframe, Mapper, Shot, State, Step
from jaxshape.mapping.placement import Placement
from jaxshape.mapping.planes import Floor, camera_points, dominant_planes, floor_plane
from jaxshape.mapping.segmentation import Prompt, Segmentation, segment, segment_inside
from jaxshape.mapping.sight import pooled, sight
from jaxshape.mapping.views import halved, view_of
from jaxshape.model.weights import ShapePrior
from jaxshape.refine.reconstruction import Reconstruction

WORKING_WIDTH = 400
"""Images wider than this are halved: tracking needs no more than 320 x 240 pixels."""

SURE = 0.5
"""Confidence of a segmentation from which a frame may be the first."""

SURE_OF_PROMPT = 0.1
"""The same where the user said what to look at."""

FIRST_FRAMES = 10
"""Frames among which the first that shows the object well is looked for."""

PLACE_AGAIN = (2, 3, 5, 8, 13)
"""Numbers of keyframes after which the object is placed anew."""

_FLOOR_MARGIN = 0.02  # metres above the floor below which nothing counts as the object
_ROOM = 0.15  # by which a box that was estimated is enlarged before the object is cut out with it


class Start(NamedTuple):
    """The object as it was found in one frame, the first of the map."""

    index: int
    """Of the frame."""
    masked: Bool[np.ndarray, "h w"] | None
    """Pixels of that frame that show the object; None where the box alone tells."""
    box: Box
    T_world_camera: Float[np.ndarray, "4 4"]
    T_level_world: Float[np.ndarray, "4 4"] | None
    """To a frame with the same origin and +y up; None where the box was given and stays."""
    floor: float
    """Height of the floor in the level frame, in metres; NaN where it is not known."""
    placement: Placement | None
    notes: tuple[str, ...]
    """What was found and how sure that is, in sentences."""
    warnings: tuple[str, ...]
    """Those of the notes that a user should look at."""


class FrameLog(NamedTuple):
    """What became of one frame."""

    index: int
    name: str
    status: str
    """keyframe, tracked, lost or unreadable."""
    reason: str
    keyframe: int
    """The keyframe, counted from 0, that the pose is relative to."""
    T_keyframe_camera: Float[np.ndarray, "4 4"] | None
    """None where the frame has no pose."""
    figures: dict[str, float]
    """Inlier fraction, overlap, rmse in metres and conditioning of the alignment, and seconds."""


class Progress(NamedTuple):
    """A map and what became of the frames so far."""

    state: State
    start: Start
    logs: tuple[FrameLog, ...]
    shape: Reconstruction | None = None
    """As last refined, a batch of one; None after an earlier run's progress was read."""


# The object -------------------------------------------------------------------------------------


def find_start(
    sequence: Sequence,
    prior: ShapePrior,
    prompt: Prompt,
    *,
    box: Box | None = None,
    first: int = 0,
    use_pose: bool = True,
) -> Start:
    """Find the object in the first frame that shows it well, from `first` on.

    With a box nothing is searched for: it lies in the world of the given poses or, without these,
    of the camera of the first frame. Else the object is cut out of the frame (`segment`) and placed
    by the prior (`place`), upright on the floor if that is seen.

    Raises `SequenceError` where no frame is good enough.
    """
    use_pose = use_pose and sequence.has_poses
    if box is not None:
        index, frame = _first_readable(sequence, first, use_pose)
        T = _world_pose(frame, use_pose)
        return Start(index, frame.mask, box, T, None, np.nan, None, (), ())
    reasons = []
    for index in range(first, min(first + FIRST_FRAMES, len(sequence))):
        try:
            frame = sequence[index]
        except SequenceError as problem:
            reasons.append(f"{sequence.names[index]}: {problem}")
            continue
        if use_pose and frame.T_world_camera is None:
            reasons.append(f"{frame.name}: It has no pose.")
            continue
        found = segment(frame.depth, frame.color, sequence.intrinsics, prompt, frame.mask)
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


def _first_readable(sequence: Sequence, first: int, use_pose: bool) -> tuple[int, Frame]:
    problem: Exception | None = None
    for index in range(first, len(sequence)):
        try:
            frame = sequence[index]
        except SequenceError as error:
            problem = error
            continue
        if not use_pose or frame.T_world_camera is not None:
            return index, frame
    raise problem or SequenceError("No frame of the recording has a pose.")


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
    floor = _floor(frame, sequence, found)
    up, of_up = _up(floor, T_world_camera, use_pose)
    cut = f"{frame.name}: {found.reason}"
    doubts = [cut] * (found.confidence < SURE) + [of_up] * (floor is None)
    T_level_world = np.eye(4)
    T_level_world[:3, :3] = _rotation_onto_y(up)
    shot = prepare(frame, sequence.intrinsics)
    start = Start(
        index=index,
        masked=found.segmented,
        box=Box(np.eye(4), np.ones(3)),
        T_world_camera=T_world_camera,
        T_level_world=T_level_world,
        floor=_floor_height(floor, T_level_world @ T_world_camera),
        placement=None,
        notes=(cut, of_up),
        warnings=tuple(doubts),
    )
    masked = _resized(found.segmented, shot.view.depth.shape)
    sights = [(shot.view.depth, masked, shot.view.intrinsics, T_world_camera)]
    return _placed(start, prior, sights)


def _floor(frame: Frame, sequence: Sequence, found: Segmentation) -> Floor | None:
    points = camera_points(frame.depth, sequence.intrinsics)
    known = frame.depth > 0
    planes = dominant_planes(points[known])
    return floor_plane(points[known], planes, points[found.segmented & known])


def _up(
    floor: Floor | None, T_world_camera: Float[np.ndarray, "4 4"], has_poses: bool
) -> tuple[Float[np.ndarray, " 3"], str]:
    """The upward direction in the world, and where it comes from."""
    if floor is not None:
        up = T_world_camera[:3, :3] @ np.asarray(floor.plane.normal, np.float64)
        return up, f"Up is the normal of the floor ({floor.confidence:.0%} sure)."
    if has_poses:
        return np.array([0.0, 1.0, 0.0]), "No floor is seen; the world's +y is taken as up."
    up = -T_world_camera[:3, 1]
    return up, "No floor is seen; the camera of the first frame is taken as held level."


def _floor_height(floor: Floor | None, T_level_camera: Float[np.ndarray, "4 4"]) -> float:
    """y of the floor in the level frame, where it is sure; else NaN."""
    if floor is None or floor.confidence < SURE:
        return np.nan
    on_floor = -floor.plane.offset * np.asarray(floor.plane.normal, np.float64)
    return float((T_level_camera[:3, :3] @ on_floor + T_level_camera[:3, 3])[1])


def _rotation_onto_y(up: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation that takes `up` to +y, and turns as little else as it can."""
    y = up / np.linalg.norm(up)
    sideways = np.eye(3)[np.argmin(np.abs(y))]
    x = np.eye(3)[0] if abs(y[0]) < 0.9 else sideways
    z = np.cross(x, y)
    z /= np.linalg.norm(z)
    return np.stack([np.cross(y, z), y, z])


# Placement --------------------------------------------------------------------------------------


def placed_again(progress_start: Start, prior: ShapePrior, state: State) -> Start:
    """The start with its box estimated from all keyframes, from its earlier placement on."""
    sights = [
        (one.depth, one.segmented, one.intrinsics, np.asarray(one.T_world_camera.as_matrix()))
        for one in state.keyframes
    ]
    return _placed(progress_start, prior, sights)


def _placed(start: Start, prior: ShapePrior, sights: list) -> Start:
    assert start.T_level_world is not None
    known = start.placement or placement.nothing_known(prior)
    each = [
        _sight(jax.random.key(number), depth, masked, intrinsics)
        for number, (depth, masked, intrinsics, _) in enumerate(sights)
    ]
    poses = [
        jaxlie.SE3.from_matrix(jnp.float32(start.T_level_world @ T_world_camera))
        for *_, T_world_camera in sights
    ]
    seen = _pooled(_stacked(each), _stacked(poses))
    found = _place(prior, seen, jnp.float32(start.floor), known)
    T_level_object = np.asarray(found.T_world_object.as_matrix(), np.float64)
    box = Box(np.linalg.inv(start.T_level_world) @ T_level_object, np.asarray(found.size, float))
    return start._replace(placement=found, box=_without_floor(box, start.floor))


def _stacked(trees: list[Any]) -> Any:
    return jax.tree.map(lambda *x: jnp.stack(x), *trees)


_sight = jax.jit(sight)
_pooled = jax.jit(pooled)
_place = jax.jit(placement.place)


def _without_floor(box: Box, floor: float) -> Box:
    """The box, with what lies on the floor excluded."""
    if not np.isfinite(floor):
        return box
    bottom = -box.size[1] / 2
    slab = [[-9.0, -9.0, -9.0], [9.0, bottom + _FLOOR_MARGIN, 9.0]]
    return box._replace(exclude=np.array([slab]))


# Frames ------------------------------------------------------------------------------------------


def prepare(
    frame: Frame, K: Float[np.ndarray, "3 3"], masked: Bool[np.ndarray, "h w"] | None = None
) -> Shot:
    """A frame at working size, with its oriented points; `masked` in place of its own mask."""
    intrinsics = Intrinsics(*jnp.float32([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]))
    halvings = 0
    while frame.depth.shape[1] >> halvings > WORKING_WIDTH:
        halvings += 1
    view = _view(jnp.asarray(frame.depth), intrinsics, halvings)
    mask = frame.mask if masked is None else masked
    if mask is None:
        return Shot(view, jnp.ones(view.depth.shape, bool))
    return Shot(view, _resized(mask, view.depth.shape))


@partial(jax.jit, static_argnums=2)
def _view(depth, intrinsics, halvings: int):
    for _ in range(halvings):
        depth, intrinsics = halved(depth, intrinsics)
    return view_of(depth, intrinsics)


def _resized(mask: Bool[np.ndarray, "h w"], shape: tuple[int, ...]) -> Bool[Array, "_ _"]:
    """The mask at a whole fraction of its size: True where most of the pixels are."""
    k = mask.shape[1] // shape[1]
    h, w = shape[0] * k, shape[1] * k
    return jnp.asarray(mask[:h, :w].reshape(shape[0], k, shape[1], k).mean(axis=(1, 3)) > 0.5)


def follow(
    sequence: Sequence,
    start: Start,
    mapper: Mapper,
    prior: ShapePrior,
    *,
    chosen: Iterable[int] | None = None,
    use_poses: bool = False,
    earlier: Progress | None = None,
) -> Iterator[Progress]:
    """Track and map the chosen frames, by default all from the start's on; yields after each.

    With `use_poses` the given poses are taken, and only frames without one are tracked. `earlier`
    is the progress of a run that was cut short, after whose last frame this one goes on.
    """
    chosen = range(start.index, len(sequence)) if chosen is None else chosen
    progress = earlier or _begin(sequence, start, mapper, use_poses)
    if earlier is None:
        yield progress
    done = progress.logs[-1].index
    for index in (i for i in chosen if i > done):
        progress = _next(sequence, index, mapper, progress, use_poses)
        if progress.logs[-1].status == "keyframe":
            progress = _placed_anew(progress, mapper, prior)
        yield progress


def _begin(sequence: Sequence, start: Start, mapper: Mapper, use_poses: bool) -> Progress:
    frame = sequence[start.index]
    shot = prepare(frame, sequence.intrinsics, start.masked)
    state, step = mapper.init(
        shot, start.box, as_pose(start.T_world_camera), room=room(start), poses_are_given=use_poses
    )
    log = FrameLog(start.index, frame.name, "keyframe", "", 0, np.eye(4), _figures(step))
    return Progress(state, start, (log,), step.shape)


def as_pose(T: Float[np.ndarray, "4 4"]) -> jaxlie.SE3:
    """A pose of the host in JAX."""
    return jaxlie.SE3.from_matrix(jnp.float32(T)).normalize()


def room(start: Start) -> float:
    """By how much the box is enlarged to cut out the object: not where it was given."""
    return 0.0 if start.T_level_world is None else _ROOM


def _next(
    sequence: Sequence, index: int, mapper: Mapper, progress: Progress, use_poses: bool
) -> Progress:
    state, logs = progress.state, progress.logs
    last = len(state.keyframes) - 1
    try:
        frame = sequence[index]
    except SequenceError as problem:
        name = sequence.names[index]
        log = FrameLog(index, name, "unreadable", str(problem), last, None, {})
        return progress._replace(logs=(*logs, log))
    given = frame.T_world_camera if use_poses else None
    shot = prepare(frame, sequence.intrinsics)
    # A mask, or a box that was given, says what is the object; one that was found is not sure.
    is_estimated = progress.start.T_level_world is not None and frame.mask is None
    cut = partial(_cut, frame, sequence, state.keyframes) if is_estimated else None
    state, step = mapper.step(state, shot, None if given is None else as_pose(given), cut)
    relative = None
    if step.T_world_camera is not None:
        keyframe = state.keyframes[-1].T_world_camera
        relative = np.asarray((keyframe.inverse() @ step.T_world_camera).as_matrix(), np.float64)
    log = FrameLog(
        index=index,
        name=frame.name,
        status=step.status,
        reason=step.reason,
        keyframe=len(state.keyframes) - 1,
        T_keyframe_camera=relative,
        figures=_figures(step),
    )
    return Progress(state, progress.start, (*logs, log), step.shape or progress.shape)


def _cut(
    frame: Frame, sequence: Sequence, keyframes: tuple[Keyframe, ...], box: Box, T: jaxlie.SE3
) -> Bool[Array, "_ _"]:
    """The clusters of a frame that lie mostly in the object's box and are nothing seen before."""
    others = np.concatenate([_others(one, box) for one in keyframes[:1] + keyframes[1:][-8:]])
    T_world_camera = np.asarray(T.as_matrix(), np.float64)
    found = segment_inside(frame.depth, sequence.intrinsics, box, T_world_camera, others)
    return _resized(found, keyframes[0].depth.shape)


def _others(keyframe: Keyframe, box: Box) -> Float[np.ndarray, "n 3"]:
    """World points in the object's box that a keyframe took for something else."""
    points = np.asarray(_world_points(keyframe), np.float64)[::3, ::3]
    other = (~np.asarray(keyframe.masked) & (np.asarray(keyframe.depth) > 0))[::3, ::3]
    points = points[other]
    return points[points_in_box(points, box)]


@jax.jit
def _world_points(keyframe: Keyframe) -> Float[Array, "h w 3"]:
    known = jnp.where(jnp.isfinite(keyframe.depth), keyframe.depth, 0)
    points = camera.unproject(keyframe.intrinsics, known)
    return camera.transform(keyframe.T_world_camera, points)


def _figures(step: Step) -> dict[str, float]:
    figures = {f"seconds_{part}": seconds for part, seconds in step.seconds.items()}
    if step.alignment is not None:
        for name in ("inlier_fraction", "overlap", "rmse", "conditioning"):
            figures[name] = float(getattr(step.alignment, name))
    return figures


def _placed_anew(progress: Progress, mapper: Mapper, prior: ShapePrior) -> Progress:
    """The progress with the object's box estimated again, where that is due."""
    is_estimated = progress.start.T_level_world is not None
    if not is_estimated or len(progress.state.keyframes) not in PLACE_AGAIN:
        return progress
    start = placed_again(progress.start, prior, progress.state)
    state, shape = mapper.moved(progress.state, start.box, room=room(start))
    return progress._replace(state=state, start=start, shape=shape)


def trajectory(progress: Progress) -> dict[int, Float[np.ndarray, "4 4"]]:
    """T_world_camera of every frame that has a pose, from where its keyframe is now."""
    poses = {}
    for log in progress.logs:
        if log.T_keyframe_camera is not None:
            keyframe = progress.state.keyframes[log.keyframe].T_world_camera
            T = np.asarray(keyframe.as_matrix(), np.float64)
            poses[log.index] = T @ log.T_keyframe_camera
    return poses
