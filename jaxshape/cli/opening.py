"""The recording that a command works on, and the options that say how to read it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from jaxshape import checks
from jaxshape.cli.common import console, require
from jaxshape.cli.inspecting import ConventionName


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """Options of all commands that work on a recording."""

    frames: Positional[Path]
    """Folder of a recording; `jaxshape inspect` describes its content."""
    first: int = 0
    """Number of the first frame, from 0."""
    every: int = 1
    """Use every n-th frame, 1 or more."""
    depth_scale: float | None = None
    """Depth units per metre, above 0; by default detected, or that of the layout."""
    convention: tuple[ConventionName, ...] = ()
    """Conventions in which poses and depth are written; detected by default."""
    guess_camera: bool = False
    """If the folder has no camera, use the usual camera of such recordings."""

    def __post_init__(self) -> None:
        checks.whole("first", self.first, 0)
        checks.whole("every", self.every, 1)

    def opened(self) -> Any:
        """Open and inspect the recording (`Inspection`): how it is to be read, and warnings.

        Refuses a guessed camera unless allowed, and a first frame that does not exist.
        """
        from jaxshape.data.sequences import open_sequence
        from jaxshape.data.sequences.inspection import inspect_sequence

        sequence = open_sequence(self.frames, depth_scale=self.depth_scale)
        with console.status("inspecting the recording"):
            require(
                self.guess_camera or not sequence.camera_is_guess,
                f"{str(self.frames)!r} holds no camera, and a focal length that is wrong by 5 % "
                "bends the surface: write fx 0 cx / 0 fy cy / 0 0 1 to cam_K.txt there, or add "
                f"--guess-camera to use that of {sequence.camera}.",
            )
            keep_scale = self.depth_scale is not None
            found = inspect_sequence(sequence, self.convention or None, keep_scale=keep_scale)
        count = len(found.sequence)
        require(
            self.first < count,
            f"--first is {self.first}, but there are {count} frames, counted from 0.",
        )
        return found

    def uses_poses(self, found: Any, poses: str) -> bool:
        """Whether all given poses are used; refuses options that contradict the recording.

        `found` is the recording, from `opened`, and `poses` the option --poses.
        """
        from jaxshape.data.sequences.inspection import BADLY

        has_poses, read = found.sequence.has_poses, found.poses
        if poses in ("given", "first"):
            require(
                has_poses, f"--poses is {poses}, but {str(self.frames)!r} has none; leave it out."
            )
        if poses in ("none", "first") or not has_poses:
            return False
        best = read.reading.best
        hint = "" if best is None else f"with {best.convention.options} it is {best.share:.0%}; "
        require(
            read.reading.pairs == 0 or read.agreement >= BADLY,
            f"The poses in {str(self.frames)!r} agree with the depth images on "
            f"{read.agreement:.0%} of the pixels only, and would tear the surface: {hint}"
            "name their convention with --convention, or add --poses none to track the camera.",
        )
        return True
