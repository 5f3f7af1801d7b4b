"""ScanNet (Dai et al., CVPR 2017), as its SensReader exports scenes."""

from jaxshape.data.sequences.cameras import Calibration
from jaxshape.data.sequences.listing import (
    Contents,
    Listed,
    depth_images,
    files_in,
    frame_files,
    has_depth_folder,
    miscounted_poses,
    partners,
)
from jaxshape.data.sequences.poses import read_matrix, read_pose

_CAMERA = "intrinsic/intrinsic_depth.txt"


def fits(contents: Contents) -> bool:
    return has_depth_folder(contents) and (contents.folder / _CAMERA).is_file()


def list_frames(contents: Contents) -> Listed:
    """`depth/N.png` in millimetres, `color/N.jpg`, `pose/N.txt`, `intrinsic/intrinsic_depth.txt`.

    Poses are camera to world, with -inf where tracking was lost. The colour camera has more pixels
    and is a few millimetres from the depth camera; its images are treated as registered to the
    depth images.
    """
    depth = depth_images(contents)
    offered = files_in(contents, ("pose", "poses"), (".txt",))
    poses = partners(depth, offered)
    K = read_matrix(contents.folder / _CAMERA, 4)[:3, :3]
    K[:2, 2] += 0.5  # their coordinates start at the centre of the first pixel
    return Listed(
        files=frame_files(contents, depth),
        depth_scale=1000.0,
        read_pose=(lambda index: read_pose(poses[index])) if any(poses) else None,
        calibration=Calibration(K[None], None, _CAMERA),
        findings=miscounted_poses(map(bool, poses), len(offered)),
    )
