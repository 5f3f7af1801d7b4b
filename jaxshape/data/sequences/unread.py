"""Unread entries of a recording: not regular files, files that look like poses or a camera, and
images that belong to no depth image."""

import re
from collections.abc import Iterator

from jaxshape.data.sequences.frames import Finding
from jaxshape.data.sequences.listing import (
    COLOR_FOLDERS,
    COLOR_SUFFIXES,
    MASK_FOLDERS,
    Contents,
    Listed,
    color_images,
    folder_of,
    list_folder,
    mask_images,
)

_POSES = re.compile(
    r"pose|traj|odom|groundtruth|ground_truth|transforms.*json|scene_gt|extrinsic|cameras?\.txt"
    r"|images\.(txt|bin)|slam",
    re.IGNORECASE,
)
_CAMERA = re.compile(
    r"intrinsic|calib|scene_camera|camera|cam_k|metadata|info\.txt|transforms.*json", re.IGNORECASE
)
_KINDS = (
    ".txt", ".json", ".csv", ".log", ".yaml", ".yml", ".tum", ".bin", ".freiburg", ".xml",
    ".npy", ".npz", ".pkl", ".mat", ".h5",
)  # fmt: skip
_OURS = ("keyframes.json", "result.json")


def unread(
    contents: Contents, *, has_poses: bool, has_camera: bool, earlier: tuple[Finding, ...] = ()
) -> Iterator[Finding]:
    """Remarks on files of a recording that are not used.

    Args:
        contents: The folder.
        has_poses: Whether poses were found; if so, files that look like poses are not reported.
        has_camera: Whether a camera was found.
        earlier: Earlier remarks; files that they name are left out.
    """
    if contents.others:
        yield Finding(
            "not read, because they are not regular files: "
            + ", ".join(sorted(contents.others)[:4]),
            "Broken links, pipes and devices are skipped; copy the files again, if they belong to "
            "the recording.",
        )
    named = " ".join(evidence for evidence, _ in earlier)
    unnamed = frozenset(name for name in contents.files if name not in named)
    contents = contents._replace(files=unnamed)
    if not has_poses and (found := _like(_POSES, contents)):
        yield Finding(
            f"no poses are read, though {found} may hold them",
            "Poses are read from groundtruth.txt beside depth.txt, poses/N.txt, trajectory.log or "
            "an Open3D trajectory.json: write one of these; otherwise the camera is tracked.",
        )
    if not has_camera and (found := _like(_CAMERA, contents)):
        yield Finding(
            f"no camera is read, though {found} may hold it",
            "Write fx 0 cx / 0 fy cy / 0 0 1 to cam_K.txt in the folder.",
        )


def unmatched(contents: Contents, listed: Listed) -> Iterator[Finding]:
    """Remarks on colour images and masks that were not found for depth images.

    Images that are paired by time are left to the inspection of a recording.
    """
    files = listed.files
    alone = sum(one.color is None for one in files)
    colors = len(color_images(contents)) if alone and listed.color_delays is None else 0
    if colors or listed.color_delays is None and 0 < alone < len(files):
        there = f", although there are {colors} of them" if colors else ""
        yield Finding(
            f"{alone} of {len(files)} depth images have no colour image{there}",
            "Give images that were taken together the same number, and list them if the recording "
            "has a list. If one kind is counted from 0 and the other from 1, all colours are a "
            "frame late.",
        )
    elif listed.color_delays is None and alone == len(files):
        yield from _of_other_kinds(contents, COLOR_FOLDERS)
    if not any(one.mask for one in files):
        if masks := len(mask_images(contents)):
            yield Finding(
                f"none of {masks} masks is read",
                "Give each mask the name of its depth image, and list it if the recording has a "
                "list.",
            )
        else:
            yield from _of_other_kinds(contents, MASK_FOLDERS)


def _of_other_kinds(contents: Contents, names: tuple[str, ...]) -> Iterator[Finding]:
    """A remark on a folder of images in which no file is of a kind that is read."""
    folder = folder_of(contents, names)
    if folder is not None and (files := sorted(list_folder(folder).files)):
        yield Finding(
            f"none of {len(files)} files in {folder.name}/ is read, {files[0]} among them",
            f"Save them as {', '.join(COLOR_SUFFIXES)}.",
        )


def _like(pattern: re.Pattern[str], contents: Contents) -> str:
    """Names that match, in words; at most four."""
    files = (name for name in contents.files if name.lower().endswith(_KINDS) and name not in _OURS)
    folders = (f"{name}/" for name in contents.folders)
    found = sorted(filter(pattern.search, (*files, *folders)))
    return ", ".join(found[:4]) + (", ..." if len(found) > 4 else "")
