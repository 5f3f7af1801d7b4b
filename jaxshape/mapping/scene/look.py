"""A look around: what all keyframes of a scene show, and the pixels of each object in it. [host]"""

from collections.abc import Sequence
from typing import NamedTuple

import jaxlie
import numpy as np
from jaxtyping import Bool

from jaxshape.mapping.map.cutting import parts_in
from jaxshape.mapping.placement.faces import Cutout, world_points
from jaxshape.mapping.placement.finding import rotation_onto_y
from jaxshape.mapping.scene.things import Thing, Told, told_apart
from jaxshape.mapping.scene.world import CELL, Level, above_floor, cells_of, clusters_of, keys_of
from jaxshape.mapping.segmentation.parts import Parts
from jaxshape.mapping.tracking.keyframes import Keyframe, PreparedFrame

SURE_FLOOR = 0.5
"""Evidence from which a level plane of a keyframe is the floor of the room."""


class Look(NamedTuple):
    """What is seen of a scene once a keyframe is added.

    Attributes:
        parts: Parts of the new keyframe.
        view: The new keyframe, with the pixels of all things.
        level: The level frame; None before a floor was seen.
        told: The objects.
    """

    parts: Parts
    view: Cutout
    level: Level | None
    told: Told

    def pixels(self, number: int) -> Bool[np.ndarray, "h w"]:
        """The pixels of the new keyframe that show an object.

        Args:
            number: Number of the object; none has the number 0.
        """
        thing = next((one for one in self.told.things if one.number == number), None)
        if thing is None:
            return np.zeros(np.shape(self.view.depth), bool)
        return self.pixels_in(thing, self.view)

    def pixels_in(self, thing: Thing, view: Cutout) -> Bool[np.ndarray, "h w"]:
        """The pixels of a keyframe whose points lie in or beside the cells of an object.

        Args:
            thing: The object.
            view: The keyframe, with the pixels of all things.
        """
        found = np.array(view.segmented, bool)
        if self.level is None:
            return np.zeros_like(found)
        points = world_points(view)[found]
        R, t = self.level.T_level_world[:3, :3], self.level.T_level_world[:3, 3]
        points = points @ R.T + t
        z = np.asarray(view.depth, np.float64)[found]
        own = np.isin(keys_of(np.floor(points / CELL).astype(int)), thing.keys)
        found[found] = own & above_floor(points, z, self.level)
        return found


def look_around(
    keyframes: Sequence[Keyframe],
    new: tuple[PreparedFrame, jaxlie.SE3] | None,
    level: Level | None,
    told: Told,
) -> Look:
    """What all keyframes show, and which objects that are.

    Args:
        keyframes: The keyframes so far, with their parts.
        new: One more, and its pose; None to look at those alone.
        level: The level frame, if it is known.
        told: The objects so far.
    """
    views = shown(keyframes)
    if new is None:
        parts, last = keyframes[-1].parts, views[-1]
        assert parts is not None
    else:
        prepared, T = new
        parts = parts_in(prepared, with_tables=False)
        pose = np.asarray(T.as_matrix(), np.float64)
        last = Cutout(prepared.view.depth, parts.labels != 0, prepared.view.intrinsics, pose)
        views = [*views, last]
    level = level or _level(last, parts)
    if level is not None:
        told = told_apart(told, clusters_of(cells_of(views, level), level))
    return Look(parts, last, level, told)


def shown(keyframes: Sequence[Keyframe]) -> list[Cutout]:
    """The keyframes of a scene, with the pixels of all that is neither floor nor wall.

    Args:
        keyframes: The keyframes, with their parts.
    """
    return [
        Cutout(
            one.depth,
            np.zeros(one.depth.shape, bool) if one.parts is None else one.parts.labels != 0,
            one.intrinsics,
            np.asarray(one.T_world_camera.as_matrix(), np.float64),
        )
        for one in keyframes
    ]


def _level(view: Cutout, parts: Parts) -> Level | None:
    """The level frame of the floor that a keyframe shows; None where it shows none for sure."""
    if parts.evidence < SURE_FLOOR or not np.isfinite(parts.floor).all():
        return None
    normal = view.T_world_camera[:3, :3] @ parts.floor[:3]
    height = float(normal @ view.T_world_camera[:3, 3] - parts.floor[3])
    T = np.eye(4)
    T[:3, :3] = rotation_onto_y(normal)
    return Level(T, height)
