"""7-Scenes (Shotton et al., CVPR 2013): for each number a depth image, a colour image, a pose."""

import re
from pathlib import Path

from jaxshape.data.sequences.frames import Finding, FrameFiles
from jaxshape.data.sequences.listing import Contents, Listed
from jaxshape.data.sequences.poses import read_pose

_NAME = re.compile(r"frame-(\d+)\.(depth\.png|pose\.txt)", re.IGNORECASE)


def fits(contents: Contents) -> bool:
    return any(_NAME.fullmatch(name) for name in contents.files)


def list_frames(contents: Contents) -> Listed:
    """`frame-N.depth.png` with `.pose.txt`, `.color.png` or `.jpg`, and `.mask.png` of the same
    name, in capital or small letters."""
    present = {name.lower(): contents.folder / name for name in sorted(contents.files)}
    numbers: dict[str, set[str]] = {"depth.png": set(), "pose.txt": set()}
    for match in filter(None, map(_NAME.fullmatch, present)):
        numbers[match[2]].add(match[1])
    names = [f"frame-{number}" for number in sorted(numbers["depth.png"], key=int)]

    def first_of(*files: str) -> Path | None:
        return next((present[file] for file in files if file in present), None)

    poses = [first_of(f"{name}.pose.txt") for name in names]
    return Listed(
        files=tuple(
            FrameFiles(
                name=name,
                depth=present[f"{name}.depth.png"],
                color=first_of(*(f"{name}.color{end}" for end in (".png", ".jpg", ".jpeg"))),
                mask=first_of(f"{name}.mask.png"),
            )
            for name in names
        ),
        depth_scale=1000.0,
        read_pose=(lambda index: read_pose(poses[index])) if any(poses) else None,
        findings=_without_depth(sorted(numbers["pose.txt"] - numbers["depth.png"], key=int)),
    )


def _without_depth(numbers: list[str]) -> tuple[Finding, ...]:
    if not numbers:
        return ()
    return (
        Finding(
            f"poses without a depth image: {len(numbers)}, the first of frame-{numbers[0]}",
            "Copy the images again from their source, if the recording has them.",
        ),
    )
