"""ICL-NUIM (Handa et al., ICRA 2014): rendered rooms, in its TUM-compatible form."""

import numpy as np
from scipy.spatial.transform import Rotation

from jaxshape.data.sequences.cameras import DefaultCamera
from jaxshape.data.sequences.documents import rows_of
from jaxshape.data.sequences.frames import SequenceError
from jaxshape.data.sequences.listing import (
    Contents,
    Listed,
    depth_images,
    frame_files,
    has_depth_folder,
    last_number,
    miscounted_poses,
)
from jaxshape.data.sequences.poses import known

_CAMERA = (481.2, 480.0, 319.5, 239.5)
_MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
"""The poses use the renderer's frames: y points up in the camera and in the world."""


def fits(contents: Contents) -> bool:
    return has_depth_folder(contents) and _poses(contents) is not None


def _poses(contents: Contents) -> str | None:
    return next((name for name in sorted(contents.files) if name.endswith(".gt.freiburg")), None)


def list_frames(contents: Contents) -> Listed:
    """`depth/N.png` in units of 1/5000 m, `rgb/N.png`, and lines `N x y z qx qy qz qw`."""
    depth = depth_images(contents)
    source = contents.folder / str(_poses(contents))
    rows = {row[0]: np.array(row[1:]) for row in rows_of(source, (8,))}
    numbers = list(map(last_number, depth))

    def read(index: int):
        row = rows.get(numbers[index])
        if row is None:
            return None
        if not abs(np.linalg.norm(row[3:]) - 1) <= 1e-2:
            raise SequenceError(
                f"Pose {numbers[index]} of {source} has the quaternion {row[3:].tolist()}; expected"
                " one of length 1: copy the file again."
            )
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = Rotation.from_quat(row[3:]).as_matrix(), row[:3]
        return known(_MIRROR @ T @ _MIRROR, f"Pose {numbers[index]} of {source}")

    return Listed(
        files=frame_files(contents, depth),
        depth_scale=5000.0,
        read_pose=read,
        camera=DefaultCamera(_CAMERA, "ICL-NUIM's renderer", sure=True),
        findings=miscounted_poses([one in rows for one in numbers], len(rows)),
    )
