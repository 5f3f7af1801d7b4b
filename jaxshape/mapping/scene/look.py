"""A look around: what all keyframes of a scene show, and the pixels of each object in it. [host]"""

from collections.abc import Sequence
from typing import NamedTuple

import jaxlie
import numpy as np
from jaxtyping import Bool, Int

from jaxshape.mapping.map.cutting import parts_in
from jaxshape.mapping.placement.faces import Cutout
from jaxshape.mapping.placement.finding import rotation_onto_y
from jaxshape.mapping.scene.things import Thing, Tracks, associate
from jaxshape.mapping.scene.world import (
    CHANGED,
    LEAST_CELLS,
    Level,
    cells_met,
    cells_of,
    clusters_of,
    keys_of,
    located,
)
from jaxshape.mapping.segmentation.parts import Parts
from jaxshape.mapping.tracking.keyframes import Keyframe, PreparedFrame

SURE_FLOOR = 0.5
"""Least evidence for a level plane of a keyframe to be the floor of the room."""


class Shown(NamedTuple):
    """A keyframe, and its pixels that show neither floor nor walls.

    Attributes:
        view: The keyframe, with the pixels of all things.
        parts: Its parts.
    """

    view: Cutout
    parts: Parts


class Located(NamedTuple):
    """A keyframe, and the cells that its pixels lie in.

    Attributes:
        keyframe: The keyframe.
        marked: Its pixels above the floor that show things `[h w]`; none where no floor is known.
        keys: Key of the cell that each of these pixels lies in `[n]`.
    """

    keyframe: Shown
    marked: Bool[np.ndarray, "h w"]
    keys: Int[np.ndarray, " n"]

    def pixels(self, thing: Thing) -> Bool[np.ndarray, "h w"]:
        """The pixels that show an object: pixels in its cells, or with its number.

        Args:
            thing: The object.
        """
        view, parts = self.keyframe
        if thing.is_numbered:
            numbered = parts.are_numbered & (parts.labels == thing.number)
            return np.asarray(view.segmented, bool) & numbered
        found = self.marked.copy()
        found[found] = np.isin(self.keys, thing.keys)
        return found


def with_cells(keyframe: Shown, level: Level | None) -> Located:
    """Find the cells of all pixels of a keyframe, for any number of objects.

    Args:
        keyframe: The keyframe.
        level: The level frame; None before a floor was seen.
    """
    if level is None:
        return Located(keyframe, np.zeros(np.shape(keyframe.view.depth), bool), np.zeros(0, int))
    marked, index = located(keyframe.view, level)
    return Located(keyframe, marked, keys_of(index))


class Look(NamedTuple):
    """The objects that are visible in a scene once a keyframe is added.

    Attributes:
        new: The new keyframe.
        level: The level frame; None before a floor was seen.
        tracks: The tracked objects.
    """

    new: Located
    level: Level | None
    tracks: Tracks

    def pixels(self, number: int) -> Bool[np.ndarray, "h w"]:
        """The pixels of the new keyframe that show an object.

        Args:
            number: Number of the object; no object has the number 0.
        """
        thing = next((one for one in self.tracks.things if one.number == number), None)
        return np.zeros_like(self.new.marked) if thing is None else self.new.pixels(thing)


def look_around(
    keyframes: Sequence[Keyframe],
    new: tuple[PreparedFrame, jaxlie.SE3] | None,
    level: Level | None,
    tracks: Tracks,
) -> Look:
    """Find the objects that all keyframes show together.

    Args:
        keyframes: The keyframes so far, with their parts.
        new: One more frame, and its pose; None to look at the keyframes alone.
        level: The level frame, if it is known.
        tracks: The tracked objects so far.
    """
    views = shown(keyframes)
    if new is not None:
        prepared, T = new
        parts, pose = scene_parts(prepared), np.asarray(T.as_matrix(), np.float64)
        view = Cutout(prepared.view.depth, parts.labels != 0, prepared.view.intrinsics, pose)
        views = [*views, Shown(view, parts)]
    level = level or _level(views[-1])
    if level is not None:
        tracks = _associated(views, level, tracks)
    return Look(with_cells(views[-1], level), level, tracks)


def scene_parts(prepared: PreparedFrame) -> Parts:
    """The parts of a frame, with tables as objects; if a mask numbers objects, its parts.

    Args:
        prepared: The frame.
    """
    parts = parts_in(prepared, with_tables=False)
    if prepared.instances is not None:
        return parts._replace(labels=prepared.instances, are_numbered=True)
    return parts._replace(labels=np.where(np.asarray(prepared.masked), parts.labels, 0))


def shown(keyframes: Sequence[Keyframe]) -> list[Shown]:
    """The keyframes of a scene, with the pixels of all that is neither floor nor wall.

    Args:
        keyframes: The keyframes, with their parts.
    """
    found = []
    for one in keyframes:
        assert one.parts is not None
        T = np.asarray(one.T_world_camera.as_matrix(), np.float64)
        view = Cutout(one.depth, one.parts.labels != 0, one.intrinsics, T)
        found.append(Shown(view, one.parts))
    return found


def _associated(views: Sequence[Shown], level: Level, tracks: Tracks) -> Tracks:
    """The objects: the numbered objects of masks if there are any, else clusters of the room."""
    if not any(one.parts.are_numbered for one in views):
        cells = cells_of([one.view for one in views], level)
        return associate(tracks, clusters_of(cells, level))
    cells = cells_of([one.view for one in views], level)
    changed = keys_of(cells.index[cells.is_changed])
    found = [_numbered(n, views, level, changed) for n in _numbers(views)]
    things = tuple(one for one in found if len(one.keys) >= LEAST_CELLS)
    known = {one.number for one in tracks.things}
    events = [f"Object {one.number} appeared." for one in things if one.number not in known]
    return Tracks(things, (*tracks.events, *events), max((one.number for one in things), default=0))


def _numbers(views: Sequence[Shown]) -> list[int]:
    labels = [one.parts.labels for one in views if one.parts.are_numbered]
    return [int(n) for n in np.unique(np.concatenate([one.ravel() for one in labels])) if n > 0]


def _numbered(
    number: int, views: Sequence[Shown], level: Level, changed: Int[np.ndarray, " n"]
) -> Thing:
    """The object of a number, and the cells that its pixels lie in."""
    met = [
        cells_met(one.view._replace(segmented=one.parts.labels == number), level)
        for one in views
        if one.parts.are_numbered
    ]
    index = np.unique(np.concatenate(met), axis=0)
    keys = np.sort(keys_of(index))
    is_moved = bool(len(keys) and np.isin(keys, changed).mean() > CHANGED)
    return Thing(number, keys, index, is_moved, False, True)


def _level(keyframe: Shown) -> Level | None:
    """The level frame of the floor that a keyframe shows; None where it shows none for sure."""
    parts, T_world_camera = keyframe.parts, keyframe.view.T_world_camera
    if parts.evidence < SURE_FLOOR or not np.isfinite(parts.floor).all():
        return None
    normal = T_world_camera[:3, :3] @ parts.floor[:3]
    height = float(normal @ T_world_camera[:3, 3] - parts.floor[3])
    T = np.eye(4)
    T[:3, :3] = rotation_onto_y(normal)
    return Level(T, height)
