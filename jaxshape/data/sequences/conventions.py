"""Other conventions in which recordings are written, by name, and their conversion into ours.

Ours: T_world_camera in metres, x right, y down, z forward; quaternions x y z w; depth along z.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxshape.data.sequences.frames import Sequence
from jaxshape.data.sequences.poses import StoredByColumns

Pose = Float[np.ndarray, "4 4"]
Depth = Float[np.ndarray, "h w"]
Matrix = Float[np.ndarray, "3 3"]

AS_GIVEN = "as-given"
"""Name of our own convention, for users who state it instead of having it detected."""


class Rule(NamedTuple):
    """A convention of poses or of depth images.

    Attributes:
        meaning: A human-readable sentence without its full stop.
        to_ours: Function from a pose, or a depth image and its camera matrix, to our convention.
    """

    meaning: str
    to_ours: Callable[..., Float[np.ndarray, "_ _"]]


def _from_wxyz(T: Pose) -> Pose:
    """The correct pose, after its quaternion w x y z was read as x y z w."""
    w, x, y, z = Rotation.from_matrix(T[:3, :3]).as_quat()
    return _with_rotation(T, Rotation.from_quat([x, y, z, w]).as_matrix())


def _with_rotation(T: Pose, R: Float[np.ndarray, "3 3"]) -> Pose:
    turned = T.copy()
    turned[:3, :3] = R
    return turned


def _from_rotation_by_columns(T: Pose) -> Pose:
    return _with_rotation(T, T[:3, :3].T)


def _in_units(per_metre: float, T: Pose) -> Pose:
    scaled = T.copy()
    scaled[:3, 3] /= per_metre
    return scaled


def _from_opengl(T: Pose) -> Pose:
    return T @ np.diag([1.0, -1.0, -1.0, 1.0])


def _from_ray(depth: Depth, K: Matrix) -> Depth:
    (h, w), (fx, fy, cx, cy) = depth.shape, (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    x, y = (np.arange(w) + 0.5 - cx) / fx, (np.arange(h)[:, None] + 0.5 - cy) / fy
    return (depth / np.sqrt(1 + x**2 + y**2)).astype(depth.dtype)


def _from_mirrored(depth: Depth, K: Matrix) -> Depth:
    del K
    return np.ascontiguousarray(depth[:, ::-1])


POSE_RULES = {
    "wxyz": Rule("quaternions are w x y z, not x y z w", _from_wxyz),
    "transposed": Rule("rotations are transposed: stored by columns", _from_rotation_by_columns),
    "centimetres": Rule("translations are in centimetres", partial(_in_units, 100.0)),
    "millimetres": Rule("translations are in millimetres", partial(_in_units, 1000.0)),
    "inverted": Rule("poses map world to camera", np.linalg.inv),
    "opengl": Rule("cameras look along -z with y up, as in OpenGL, ARKit and NeRF", _from_opengl),
}
"""Conventions of poses, in the order in which they are converted."""

DEPTH_RULES = {
    "mirrored": Rule("depth images are mirrored left to right", _from_mirrored),
    "ray": Rule("depth is measured along each ray, not along z", _from_ray),
}
"""Conventions of depth images, in the order in which they are converted."""

CONVENTIONS = (*POSE_RULES, *DEPTH_RULES)
"""Names of all conventions."""


@dataclass(frozen=True)
class Convention:
    """A convention of a whole recording.

    Attributes:
        names: Names, among `CONVENTIONS`, of the differences from ours; empty for our own.
        depth_scale: Depth units per metre, above 0; None for the scale of the recording.
    """

    names: tuple[str, ...] = ()
    depth_scale: float | None = None

    def __post_init__(self) -> None:
        if unknown := [name for name in self.names if name not in CONVENTIONS]:
            raise ValueError(
                f"There is no convention {unknown[0]!r}; give some of {', '.join(CONVENTIONS)}."
            )

    @property
    def meaning(self) -> str:
        """The differences from ours, in words."""
        parts = [
            (POSE_RULES | DEPTH_RULES)[name].meaning for name in CONVENTIONS if name in self.names
        ]
        if self.depth_scale is not None:
            parts.append(f"a metre has {self.depth_scale:g} depth units")
        return " and ".join(parts)

    @property
    def options(self) -> str:
        """The options of the command line that state it."""
        scale = "" if self.depth_scale is None else f"--depth-scale {self.depth_scale:g}"
        names = f"--convention {' '.join(self.names)}" if self.names else ""
        return " ".join(filter(None, (names, scale)))


def our_pose(T: Pose, names: tuple[str, ...]) -> Pose:
    """A pose in our convention.

    Args:
        T: The pose as it was read `[4 4]`, rigid.
        names: Names of conventions; depth conventions are ignored.
    """
    for name, rule in POSE_RULES.items():
        T = rule.to_ours(T) if name in names else T
    return T


def our_depth(depth: Depth, K: Matrix, names: tuple[str, ...]) -> Depth:
    """A depth image in our convention.

    Args:
        depth: The image as it was read `[h w]`.
        K: Camera matrix of the image.
        names: Names of conventions; pose conventions are ignored.
    """
    for name, rule in DEPTH_RULES.items():
        depth = rule.to_ours(depth, K) if name in names else depth
    return depth


def read_as(sequence: Sequence, convention: Convention) -> Sequence:
    """The recording, with frames turned into our convention when they are read.

    Args:
        sequence: The recording as it is written.
        convention: The convention in which it is written.
    """
    names = convention.names
    if any(name in POSE_RULES for name in names):
        sequence = replace(sequence, read_pose=partial(_pose, sequence.read_pose, names))
    if any(name in DEPTH_RULES for name in names):
        sequence = replace(sequence, correct_depth=partial(our_depth, names=names))
    return replace(sequence, depth_scale=convention.depth_scale or sequence.depth_scale)


def _pose(read: Callable[[int], Pose | None], names: tuple[str, ...], index: int) -> Pose | None:
    """A pose in our convention; a matrix stored by columns is transposed as a whole."""
    try:
        T = read(index)
    except StoredByColumns as stored:
        if "transposed" not in names:
            raise
        return our_pose(stored.T, tuple(name for name in names if name != "transposed"))
    return None if T is None else our_pose(T, names)
