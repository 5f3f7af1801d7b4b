"""A recording of a room with several objects, from its first frame to its last. [host]

    classes = build_classes(priors, ...)
    for scene in follow_scene(sequence, classes):
        ...                                # after every frame
    scene = finish_scene(scene, classes)   # classes, fronts, and the last search

Objects share their keyframes with the map that tracks the camera. This map holds no object and is
made first, so that frames are tracked before the first object is found.
"""

from collections.abc import Iterable, Iterator
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool

from jaxshape.data.boxes import Box
from jaxshape.data.sequences import Sequence
from jaxshape.geometry.grids import Grids
from jaxshape.mapping.map.mapper import placed_in
from jaxshape.mapping.map.recording import (
    Followed,
    FrameLog,
    Progress,
    advance,
    as_figures,
    chosen_frames,
)
from jaxshape.mapping.map.several import Member, Parts, finish_all, refine_all
from jaxshape.mapping.map.state import grids_of
from jaxshape.mapping.placement.finding import Start, first_readable, room
from jaxshape.mapping.scene.boxing import boxed, fits, placed, turned_box
from jaxshape.mapping.scene.classes import Decision, SceneClasses, decide, unfilled
from jaxshape.mapping.scene.look import Located, Look, look_around, scene_parts, shown, with_cells
from jaxshape.mapping.scene.things import Thing, Tracks
from jaxshape.mapping.scene.world import Level
from jaxshape.mapping.tracking.keyframes import Cut, PreparedFrame, as_pose, prepare

AHEAD = 1.5
"""Distance in metres from the first camera to the point about which its turns are measured before
there is an object."""


VIEWS, LITTLE = 2, 0.05
"""Number of keyframes that must show an object before its class is decided, and the least share of
pixels for a keyframe to show it, relative to the keyframe with most pixels of the object."""


class SceneObject(NamedTuple):
    """An object of a scene.

    Attributes:
        thing: Its number, and the cells that it fills.
        progress: Its map and its box; its logs are the logs of the scene.
        decision: Its class and how sure that is; None before it was decided.
    """

    thing: Thing
    progress: Progress
    decision: Decision | None = None

    @property
    def name(self) -> str:
        """Class and number, as "chair-2"; "object-2" for one of no class."""
        kind = self.decision.name if self.decision else None
        return f"{kind or 'object'}-{self.thing.number}"


class Scene(NamedTuple):
    """A room and the objects in it.

    Attributes:
        camera: The map that tracks the camera: it has all keyframes, and no object.
        objects: The objects, in the order of their numbers.
        level: The level frame; None before a floor was seen.
        tracks: The tracked objects: which appeared, were joined, parted and moved.
    """

    camera: Progress
    objects: tuple[SceneObject, ...]
    level: Level | None
    tracks: Tracks

    @property
    def logs(self) -> tuple[FrameLog, ...]:
        """Outcome of each frame so far."""
        return self.camera.logs


def follow_scene(
    sequence: Sequence,
    classes: SceneClasses,
    *,
    chosen: Iterable[int] | None = None,
    first: int = 0,
    use_poses: bool = False,
) -> Iterator[Scene]:
    """Track and map a room with all its objects. [host]

    Args:
        sequence: The recording, from `open_sequence`.
        classes: The classes that objects may be of, from `build_classes`.
        chosen: Numbers of the frames to use, in increasing order; None for all from the first on.
        first: Number of the first frame, from 0.
        use_poses: Whether the given poses are used; then only frames without one are tracked.

    Yields:
        The scene after each frame.

    Raises:
        ValueError: A chosen number is not that of a frame.
    """
    every = chosen_frames(sequence, chosen, first)
    begun, scene = _begin(sequence, classes, first, use_poses)
    yield scene
    for index in (i for i in every if i > begun):
        scene = _next(sequence, index, classes, scene, use_poses)
        yield scene


def _begin(
    sequence: Sequence, classes: SceneClasses, first: int, use_poses: bool
) -> tuple[int, Scene]:
    """The number of the first frame, and the scene after that frame."""
    index, frame = first_readable(sequence, first, use_poses)
    prepared = prepare(frame)
    T = np.eye(4) if not use_poses else np.asarray(frame.T_world_camera, np.float64)
    ahead = np.eye(4)
    ahead[:3, 3] = T[:3, 3] + AHEAD * T[:3, 2]
    found = scene_parts(prepared)
    nothing = prepared._replace(masked=jnp.zeros_like(prepared.masked), parts=found)
    state, step = classes.unknown.init(
        nothing, Box(ahead, np.ones(3)), as_pose(T), poses_are_given=use_poses
    )
    start = Start(index, None, None, state.place.box, T, None, np.nan, None, (), ())
    log = FrameLog(index, frame.name, "keyframe", "", 0, np.eye(4), as_figures(step))
    scene = Scene(Progress(state, start, (log,)), (), None, Tracks())
    return index, _with_look(scene, look_around(state.keyframes, None, None, Tracks()), classes)


def _next(
    sequence: Sequence, index: int, classes: SceneClasses, scene: Scene, use_poses: bool
) -> Scene:
    """The scene after one more frame."""
    looks: list[Look] = []
    recut = partial(_recut, scene, looks)
    followed = [
        Followed(scene.camera, classes.unknown.parts, is_fused=False),
        *(Followed(one.progress, _parts(one, classes)) for one in scene.objects),
    ]
    camera, *others = advance(sequence, index, followed, use_poses, recut)
    objects = tuple(
        one._replace(progress=progress) for one, progress in zip(scene.objects, others, strict=True)
    )
    scene = scene._replace(camera=camera, objects=objects)
    return _with_look(scene, looks[0], classes) if looks else scene


def _recut(scene: Scene, looks: list[Look], prepared: PreparedFrame, progress: Progress) -> Cut:
    """How an object is cut out of a new keyframe: by one look around, shared by all objects."""
    number = next((one.thing.number for one in scene.objects if one.progress is progress), 0)

    def cut(T: jaxlie.SE3):
        if not looks:
            keyframes = scene.camera.state.keyframes
            looks.append(look_around(keyframes, (prepared, T), scene.level, scene.tracks))
        return looks[0].new.keyframe.parts, jnp.asarray(looks[0].pixels(number))

    return cut


def _parts(one: SceneObject, classes: SceneClasses) -> Parts:
    """Prior and settings of an object's class."""
    known = classes.named(one.decision.name if one.decision else None)
    return (known.mapper if known else classes.unknown).parts


# Objects ---------------------------------------------------------------------------------------


def _with_look(scene: Scene, look: Look, classes: SceneClasses) -> Scene:
    """The scene with its objects as a look around found them."""
    known = {one.thing.number: one for one in scene.objects}
    scene = scene._replace(level=look.level, tracks=look.tracks)
    views = [with_cells(one, look.level) for one in shown(scene.camera.state.keyframes)]
    changed, objects = [], []
    for thing in sorted(look.tracks.things, key=lambda one: one.number):
        if thing.is_moved:
            continue
        before = known.get(thing.number)
        one = _appeared(scene, thing) if before is None else before._replace(thing=thing)
        again = _boxed_anew(scene, one, views, classes)
        objects.append(again or one)
        changed += [len(objects) - 1] if again else []
    objects = _refined(objects, changed, classes)
    return scene._replace(objects=tuple(objects))


def _appeared(scene: Scene, thing: Thing) -> SceneObject:
    """A new object: a box around its cells and the shared keyframes, not yet mapped."""
    assert scene.level is not None
    camera = scene.camera
    box = boxed(thing, scene.level)
    start = camera.start._replace(
        box=box, T_level_world=scene.level.T_level_world, floor=scene.level.floor
    )
    return SceneObject(thing, camera._replace(start=start, shape=None))


def _boxed_anew(
    scene: Scene, one: SceneObject, views: list[Located], classes: SceneClasses
) -> SceneObject | None:
    """The object in a new box around its cells; None if the present box still fits."""
    assert scene.level is not None
    progress = one.progress
    pixels = [view.pixels(one.thing) for view in views]
    is_new = progress.state.place.box is scene.camera.state.place.box
    before = [np.asarray(k.segmented) for k in progress.state.keyframes]
    if not is_new and fits(progress.start.box, one.thing, scene.level, pixels, before):
        return None
    box = boxed(one.thing, scene.level)
    start = progress.start._replace(box=box)
    return _placed_in(one, start, [jnp.asarray(x) for x in pixels], classes)


def _placed_in(
    one: SceneObject,
    start: Start,
    pixels: list[Bool[Array, "h w"]],
    classes: SceneClasses,
) -> SceneObject:
    """The object mapped anew in the box of a start."""
    parts = _parts(one, classes)
    state = placed_in(parts, one.progress.state, start.box, room=room(start), segmented=pixels)
    return one._replace(progress=one.progress._replace(state=state, start=start, shape=None))


def _refined(
    objects: list[SceneObject], which: list[int], classes: SceneClasses, *, is_long: bool = False
) -> list[SceneObject]:
    """The objects with some shapes searched; objects of one class go through one call."""
    members = [Member(_parts(objects[i], classes), objects[i].progress.state) for i in which]
    states, shapes = refine_all(members, is_long=is_long)
    found = list(objects)
    for i, state, shape in zip(which, states, shapes, strict=True):
        progress = found[i].progress._replace(state=state, shape=shape)
        found[i] = found[i]._replace(progress=progress)
    return found


# The end ---------------------------------------------------------------------------------------


def finish_scene(scene: Scene, classes: SceneClasses) -> Scene:
    """The scene with the class, the front, the box and the shape of each object. [host]

    Args:
        scene: The scene after its last frame, from `follow_scene`.
        classes: The classes that objects may be of.

    Returns:
        The finished scene. An object of no class has the measured surface as its shape.
    """
    objects = [_placed_by_class(one, classes) for one in _decided(scene.objects, classes)]
    members = [Member(_parts(one, classes), one.progress.state) for one in objects]
    carrier = Member(classes.unknown.parts, scene.camera.state, is_fused=False)
    (camera, *states), (_, *shapes) = finish_all([carrier, *members])
    finished = []
    for one, state, shape in zip(objects, states, shapes, strict=True):
        if shape is None:
            shape = unfilled(grids_of(state), state.code)
        finished.append(one._replace(progress=one.progress._replace(state=state, shape=shape)))
    return scene._replace(camera=scene.camera._replace(state=camera), objects=tuple(finished))


def _decided(objects: tuple[SceneObject, ...], classes: SceneClasses) -> list[SceneObject]:
    """The objects with their classes; all of them go through one call for each class."""
    if not objects:
        return []
    grids = [grids_of(one.progress.state) for one in objects]
    stacked = Grids(
        jnp.stack([one.occupied for one in grids]), jnp.stack([one.occluded for one in grids])
    )
    sizes = np.stack([one.progress.start.box.size for one in objects])
    decisions = decide({one.name: one.prior for one in classes.known}, stacked, sizes)
    return [
        one._replace(decision=d if _is_seen_well(one) else d._replace(name=None, quarters=0))
        for one, d in zip(objects, decisions, strict=True)
    ]


def _is_seen_well(one: SceneObject) -> bool:
    """Whether several keyframes show an object: a fragment seen once may look like anything."""
    counts = np.array([int(k.segmented.sum()) for k in one.progress.state.keyframes])
    return int((counts > LITTLE * counts.max(initial=1)).sum()) >= VIEWS


def _placed_by_class(one: SceneObject, classes: SceneClasses) -> SceneObject:
    """An object of a class, in the box that its prior finds, its front as decided."""
    known = classes.named(one.decision.name if one.decision else None)
    if known is None or one.decision is None:
        return one
    start, keyframes = one.progress.start, one.progress.state.keyframes
    start = start._replace(box=turned_box(start.box, one.decision.quarters))
    start = placed(start, known, keyframes)
    return _placed_in(one, start, [k.segmented for k in keyframes], classes)
