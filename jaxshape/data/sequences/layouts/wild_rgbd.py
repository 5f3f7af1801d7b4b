"""WildRGB-D (Xia et al., CVPR 2024): objects filmed with an iPhone all around, with masks."""

import numpy as np

from jaxshape.data.sequences.cameras import Calibration
from jaxshape.data.sequences.documents import matrix_of, read_json_object, rows_of, shape_of
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

_POSES = "cam_poses.txt"


def fits(contents: Contents) -> bool:
    return _POSES in contents.files and has_depth_folder(contents)


def list_frames(contents: Contents) -> Listed:
    """`rgb/ depth/ masks/`, `cam_poses.txt` (number, 16 numbers), and the camera in `metadata`.

    Depth is in millimetres; poses are camera to world, with OpenCV's axes.
    """
    depth = depth_images(contents)
    source = contents.folder / _POSES
    poses = {row[0]: np.reshape(row[1:], (4, 4)) for row in rows_of(source, (17,))}
    if not poses:
        raise SequenceError(
            f"{source} holds no pose; expected a line for each image: copy it again."
        )
    numbers = list(map(last_number, depth))

    def read(index: int):
        T = poses.get(numbers[index])
        return None if T is None else known(T, f"Pose {numbers[index]} of {source}")

    return Listed(
        files=frame_files(contents, depth),
        depth_scale=1000.0,
        read_pose=read,
        calibration=_calibration(contents),
        findings=miscounted_poses([one in poses for one in numbers], len(poses)),
    )


def _calibration(contents: Contents) -> Calibration | None:
    if "metadata" not in contents.files:
        return None
    source = contents.folder / "metadata"
    about = read_json_object(source)
    K = matrix_of(about.get("K"), (3, 3), source, "K")
    if not np.array_equal(K[2], (0, 0, 1)):  # it is stored by columns
        K = K.T.copy()
    K[:2, 2] += 0.5  # their coordinates start at the centre of the first pixel
    return Calibration(K[None], shape_of(about.get("h"), about.get("w"), source), source.name)
