"""Read RGB-D recordings in common layouts. [host]

A layout is two functions: whether a folder `fits` it, and one that lists the files of each frame.
Images are read and checked one frame at a time, on request, so a long sequence never fills the
memory. In the order of data: `frames` (what is read), `text`, `poses`, `trajectories`, `cameras`,
`listing` (which images belong together), the room `layouts` with a file for each kind of recording,
`unread` (files without use), `conventions` (other ways to write poses and depth), `evidence` (the
agreement of poses and images), `hypotheses` (the conventions under which they agree), `figures` and
`inspection` (statistics and warnings of a recording).

Depth images and colour images are assumed to be registered to one camera, as all these layouts
promise. A colour image of another size but the same aspect is scaled to the depth image.
"""

from collections.abc import Callable
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxshape import limits
from jaxshape.data.sequences.cameras import (
    Camera,
    default_camera,
    distorted,
    find_camera,
    guessed,
    other_cameras,
    scaled_cameras,
)
from jaxshape.data.sequences.frames import Finding as Finding
from jaxshape.data.sequences.frames import Frame as Frame
from jaxshape.data.sequences.frames import FrameFiles as FrameFiles
from jaxshape.data.sequences.frames import Sequence as Sequence
from jaxshape.data.sequences.frames import SequenceError as SequenceError
from jaxshape.data.sequences.frames import read_depth as read_depth
from jaxshape.data.sequences.frames import read_shape, same_aspect, size, usual_shape
from jaxshape.data.sequences.layouts import (
    arrays,
    bop,
    folders,
    icl_nuim,
    nerfstudio,
    realsense,
    record3d,
    replica,
    scannet,
    seven_scenes,
    stray_scanner,
    tum,
    wild_rgbd,
)
from jaxshape.data.sequences.listing import Contents, Listed, list_folder
from jaxshape.data.sequences.poses import check_rigid as check_rigid
from jaxshape.data.sequences.trajectories import Pinhole as Pinhole
from jaxshape.data.sequences.trajectories import Trajectory as Trajectory
from jaxshape.data.sequences.trajectories import read_trajectory as read_trajectory
from jaxshape.data.sequences.trajectories import write_trajectory as write_trajectory
from jaxshape.data.sequences.unread import unmatched, unread


class Layout(NamedTuple):
    """One kind of recording on disk.

    Attributes:
        needs: The files that it requires, in a few words.
        fits: Whether a folder is of this layout.
        list_frames: Lists the files of each frame of a folder.
    """

    needs: str
    fits: Callable[[Contents], bool]
    list_frames: Callable[[Contents], Listed]


LAYOUTS: dict[str, Layout] = {
    "7-scenes": Layout("frame-N.depth.png", seven_scenes.fits, seven_scenes.list_frames),
    "tum": Layout("depth.txt (lines of `time file`)", tum.fits, tum.list_frames),
    "nerfstudio": Layout("transforms.json", nerfstudio.fits, nerfstudio.list_frames),
    "bop": Layout("depth/*.png, scene_camera.json", bop.fits, bop.list_frames),
    "wildrgb-d": Layout("depth/*.png, cam_poses.txt", wild_rgbd.fits, wild_rgbd.list_frames),
    "stray-scanner": Layout(
        "depth/*.png, odometry.csv", stray_scanner.fits, stray_scanner.list_frames
    ),
    "record3d": Layout("depth/*.exr, metadata.json", record3d.fits, record3d.list_frames),
    "scannet": Layout(
        "depth/*.png, intrinsic/intrinsic_depth.txt", scannet.fits, scannet.list_frames
    ),
    "replica": Layout("results/depth*.png, traj.txt", replica.fits, replica.list_frames),
    "icl-nuim": Layout("depth/*.png, *.gt.freiburg", icl_nuim.fits, icl_nuim.list_frames),
    "realsense": Layout("*_Depth_TIME.raw", realsense.fits, realsense.list_frames),
    "npz": Layout("one .npz with depth, K", arrays.fits, arrays.list_frames),
    "redwood": Layout("depth/N-TIME.png", folders.fits_redwood, folders.list_redwood),
    "bundlesdf": Layout("depth/*.png, cam_K.txt", folders.fits_bundlesdf, folders.list_bundlesdf),
    "open3d": Layout("depth/*.png", folders.fits_open3d, folders.list_open3d),
}
"""Layouts in the order in which they are tried: the last fits any folder with depth images."""

FILES = (".npz", ".r3d")
"""Suffixes of files that are a recording by themselves."""


def open_sequence(
    path: str | Path, *, depth_scale: float | None = None, layout: str | None = None
) -> Sequence:
    """Open a folder of RGB-D frames without reading its images. [host]

    Images and poses are checked when their frame is read. If the folder holds no camera, the usual
    camera of such recordings is used; `findings` tell if this is a guess.

    Args:
        path: Folder of the recording, or an `.npz` file of arrays.
        depth_scale: Depth units per metre, above 0; None for that of the files or the layout.
        layout: Name of the layout, a key of `LAYOUTS`; None for the first that fits.

    Returns:
        The recording: `len`, indexing and iteration read one frame at a time.

    Raises:
        SequenceError: No layout fits, files are missing, or the intrinsics do not fit the images.
    """
    contents = _contents_of(Path(path))
    name = _layout_of(contents) if layout is None else _checked_layout(layout)
    listed = LAYOUTS[name].list_frames(contents)
    if not listed.files:
        raise SequenceError(_nothing_fits(contents))
    shape = _shape_of(listed)
    camera, cameras, doubts = _cameras(contents, listed, shape)
    scales = (depth_scale, camera.depth_scale, listed.depth_scale)
    scale = float(next(one for one in scales if one is not None))
    if not 1e-9 < scale < 1e9:
        raise SequenceError(
            f"The depth scale is {scale:g}; expected the number of depth units in a metre, which "
            "is positive: 1000 for millimetres."
        )
    has_poses = listed.read_pose is not None
    default = listed.camera if listed.camera and camera.source == listed.camera.source else None
    doubts += (
        *other_cameras(camera, contents.folder, contents.files, shape),
        *unmatched(contents, listed),
        *unread(contents, has_poses=has_poses, has_camera=default is None, earlier=listed.findings),
    )
    files, remarks = _without_other_colors(listed, shape)
    return Sequence(
        layout=name,
        intrinsics=camera.intrinsics,
        camera=camera.source,
        files=files,
        read_pose=listed.read_pose or _no_pose,
        has_poses=has_poses,
        shape=shape,
        depth_scale=scale,
        times=listed.times,
        color_delays=listed.color_delays,
        findings=listed.findings + doubts + remarks,
        cameras=cameras,
        camera_is_guess=default is not None and not default.sure,
    )


def _contents_of(path: Path) -> Contents:
    """The entries of a folder, or the file that is itself a recording."""
    if path.suffix.lower() in FILES and path.is_file():
        return Contents(path.parent, frozenset({path.name}), frozenset())
    if not path.is_dir():
        raise SequenceError(f"{path} is not a folder; give the one that holds the recording.")
    return list_folder(path)


def _no_pose(index: int) -> None:
    del index


# Which layout? ---------------------------------------------------------------------------------


def _fitting(contents: Contents) -> str | None:
    return next((name for name, layout in LAYOUTS.items() if layout.fits(contents)), None)


def _layout_of(contents: Contents) -> str:
    if (name := _fitting(contents)) is None:
        raise SequenceError(_nothing_fits(contents))
    return name


def _checked_layout(name: str) -> str:
    if name not in LAYOUTS:
        raise SequenceError(f"There is no layout {name!r}; give one of {', '.join(LAYOUTS)}.")
    return name


def _nothing_fits(contents: Contents) -> str:
    """A sentence with the files found, the files each layout needs, and a nearby folder that
    fits."""
    folder, seen = contents.folder, sorted(contents.folders) + sorted(contents.files)
    found = f"{', '.join(seen[:4])}{', ...' if len(seen) > 4 else ''}" if seen else "nothing"
    needs = "; ".join(f"{name}: {layout.needs}" for name, layout in LAYOUTS.items())
    nearby = _fitting_nearby(contents)
    remedy = f"give {nearby}, which fits" if nearby else "give the folder that holds those"
    return f"{folder} holds no recording but {found}; expected one of {needs}. Please {remedy}."


def _fitting_nearby(contents: Contents) -> Path | None:
    """A folder that fits, among the first sub-folders at two levels, then the parent."""
    below = _subfolders(contents.folder)
    deeper = (two for one in below for two in _subfolders(one))
    nearby = (*below, *islice(deeper, 200), contents.folder.resolve().parent)
    return next((one for one in nearby if _may_fit(one)), None)


def _subfolders(folder: Path) -> list[Path]:
    with suppress(OSError):  # no permission to read it
        return [folder / name for name in sorted(list_folder(folder).folders)[:50]]
    return []


def _may_fit(folder: Path) -> bool:
    with suppress(OSError):
        return _fitting(list_folder(folder)) is not None
    return False


# Properties that all images share
# -------------------------------------------------------------------------


def _shape_of(listed: Listed) -> tuple[int, int]:
    """Height and width of most of the first depth images whose headers can be read."""
    depth = [files.depth for files in listed.files]
    # If none can be read, the first one says why.
    return usual_shape(depth, limits.DEPTH_PIXELS) or read_shape(depth[0], limits.DEPTH_PIXELS)


def _cameras(
    contents: Contents, listed: Listed, shape: tuple[int, int]
) -> tuple[Camera, Float[np.ndarray, "n 3 3"] | None, tuple[Finding, ...]]:
    """The camera of the first frame, the cameras of all frames if they differ, and doubts."""
    if listed.calibration is None:
        camera, doubts = _camera(contents, listed, shape)
        return camera, None, doubts
    cameras = scaled_cameras(listed.calibration, shape)
    camera = Camera(cameras[0], listed.calibration.source)
    return camera, cameras if len(cameras) > 1 else None, ()


def _camera(
    contents: Contents, listed: Listed, shape: tuple[int, int]
) -> tuple[Camera, tuple[Finding, ...]]:
    beside = list_folder(contents.folder).files  # also beside a file that is a recording by itself
    camera = find_camera(contents.folder, beside, shape)
    if camera is not None:
        return camera, distorted(camera.distortion, camera.source)
    if listed.camera is None:
        raise SequenceError(
            f"camera-intrinsics.txt is missing; expected the 3x3 camera matrix in "
            f"{contents.folder} or in its parent folder: write it there."
        )
    camera = default_camera(listed.camera, contents.folder, shape)
    doubts = () if listed.camera.sure else (guessed(camera),)
    return camera, (*doubts, *distorted(camera.distortion, camera.source))


def _without_other_colors(
    listed: Listed, shape: tuple[int, int]
) -> tuple[tuple[FrameFiles, ...], tuple[Finding, ...]]:
    """Leave out all colour images, if most of the first ones are of another aspect than depth."""
    seen = usual_shape(files.color for files in listed.files if files.color) or shape
    if same_aspect(seen, shape):
        return listed.files, ()
    finding = Finding(
        f"colour images are {size(seen)} pixels and depth images {size(shape)}, another aspect, so "
        "they do not show the same; colour is left out",
        "Register the depth images to the colour images, or the other way round.",
    )
    return tuple(files._replace(color=None) for files in listed.files), (finding,)
