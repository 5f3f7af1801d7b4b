"""`jaxshape reconstruct`: one object from a recording."""

import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from jaxshape import checks
from jaxshape.claim import Output
from jaxshape.cli.common import console, progress_bar, require, warn
from jaxshape.cli.opening import Recorded
from jaxshape.cli.rebuild import Rebuild, draw, report_objective
from jaxshape.mapping.config import MappingConfig, TrackingConfig


@dataclass(frozen=True, kw_only=True)
class Reconstruct(Rebuild, Recorded):
    """Rebuild an object from an RGB-D recording: find it, track the camera, map it.

    The object is found automatically if it is alone and central, or by a click, a region, a depth
    range, masks beside the images, or its box. Poses are used if they are given. The same command
    resumes a run that was killed; `jaxshape view` shows it while it runs. The last lines state how
    reliable the result is; the exit status is 3 if it failed.

    Examples: jaxshape reconstruct scan/

    jaxshape reconstruct scan/ --click 320 240 --poses none

    jaxshape reconstruct scan/ --box box.json --every 5

    jaxshape reconstruct scan/ --list, then jaxshape reconstruct scan/ --object 2
    """

    click: tuple[float, float] | None = None
    """Column and row of a pixel of the first frame that shows the object."""
    region: tuple[float, float, float, float] | None = None
    """Left, top, right and bottom of a part of the first frame that contains only the object."""
    depth_range: tuple[float, float] | None = None
    """Nearest and farthest depth of the object in the first frame, in metres."""
    list_objects: Annotated[bool, tyro.conf.arg(name="list")] = False
    """Only number the objects of the first frame, in objects.png."""
    object: int | None = None
    """Number of the object, as shown by --list."""
    box: Path | None = None
    """JSON file with the object's box: {"T_world_object": 4x4, "size": [x, y, z]}. The object
    frame has +y up and its front along +z; the world is that of the poses or, without poses, the
    frame of the first camera."""
    poses: Literal["auto", "given", "first", "none"] = "auto"
    """Which of the recorded poses to use: all (auto: if there are any), only the first, or none."""
    tracking: tyro.conf.OmitArgPrefixes[TrackingConfig] = TrackingConfig()
    mapping: tyro.conf.OmitArgPrefixes[MappingConfig] = MappingConfig()
    fresh: bool = False
    """Start again even if the output folder has an unfinished run."""
    output: Path = Path("out/reconstruct")
    """Folder for mesh.glb, mesh.ply, grid.npz, trajectory.txt, keyframes.json, result.json,
    report.html and more."""

    def __post_init__(self) -> None:
        Recorded.__post_init__(self)
        if self.object is not None:
            checks.whole("object", self.object, 1)
        Rebuild.__post_init__(self)

    @property
    def writes(self) -> Output:
        """The output folder."""
        return Output(self.output, goes_on=True, reads=self.frames)

    def run(self) -> None:
        start = time.perf_counter()

        import numpy as np

        from jaxshape.data.boxes import read_box
        from jaxshape.geometry.grids import binary
        from jaxshape.mapping.map.mapper import build_mapper
        from jaxshape.mapping.map.recording import follow
        from jaxshape.mapping.map.state import grids_of
        from jaxshape.mapping.placement.finding import find_start
        from jaxshape.mapping.placement.placing import PlacementConfig
        from jaxshape.mapping.segmentation.segment import Prompt, check_prompt
        from jaxshape.model.weights import fingerprint
        from jaxshape.results.checkpoint import load_state, remove_state, save_state
        from jaxshape.results.progress import write_progress
        from jaxshape.search.reconstruction import require_measured

        prior, refiner, search = self.prepare()
        placer = self.placer(prior)
        found = self.opened()
        sequence = found.sequence
        if self.list_objects:
            return self._list_objects(sequence)
        prompt = Prompt(self.click, self.region, self.depth_range, self.object)
        check_prompt(prompt, sequence.shape)
        box = read_box(self.box) if self.box else None
        use_poses = self.uses_poses(found, self.poses)
        mapper = build_mapper(prior, refiner, search, self.mapping, self.tracking, seed=self.seed)
        figures: dict[str, Any] = {
            "object": str(self.frames),
            **self.settings(prior, self.mapping.fusion),
        }
        figures |= {"mapping": asdict(self.mapping), "tracking": asdict(self.tracking)}
        settings = figures | {
            "box": None if box is None else [x.tolist() for x in box],
            "prompt": asdict(prompt),
            "poses": self.poses,
            "frames": [self.first, self.every, len(sequence)],
            "depth_scale": sequence.depth_scale,
            "convention": self.convention,
            "prior": fingerprint(prior),
        }
        figures["warnings"] = [warning.sentence for warning in found.warnings]
        for warning in figures["warnings"]:
            warn(warning)
        earlier = None
        if not self.fresh:
            earlier = load_state(self.output, sequence, prior, settings, self.mapping)
        if earlier is None:
            with console.status("finding the object"):
                seen = find_start(
                    sequence,
                    placer,
                    prompt,
                    box=box,
                    first=self.first,
                    use_pose=self.poses != "none",
                )
        else:
            seen = earlier.start
            console.print(f"resuming after frame {earlier.logs[-1].name}", markup=False)
        for note in seen.notes:
            console.print(note, highlight=False, markup=False)
        chosen = range(seen.index, len(sequence), self.every)
        progress, next_write = earlier, time.perf_counter() + _SECONDS_BETWEEN_WRITES
        with progress_bar("frames") as bar:
            task = bar.add_task("follow", total=len(chosen), note="")
            for progress in follow(
                sequence,
                seen,
                mapper,
                placer,
                chosen=chosen,
                use_poses=use_poses,
                earlier=earlier,
            ):
                bar.update(task, completed=len(progress.logs), note=_note(progress))
                if progress.logs[-1].status != "keyframe" or progress.shape is None:
                    continue  # files in the folder stay until something is measured
                save_state(self.output, progress, settings)
                began = time.perf_counter()
                if began > next_write:
                    seconds = {"seconds": round(began - start, 2)}
                    write_progress(self.output, sequence, progress, figures | seconds, running=True)
                    took = time.perf_counter() - began
                    next_write = time.perf_counter() + max(_SECONDS_BETWEEN_WRITES, 10 * took)
        assert progress is not None  # there is at least the first frame
        with console.status("searching the space of shapes"):
            state, shape = mapper.finish(progress.state)
        progress = progress._replace(state=state, shape=shape)
        require_measured(np.asarray(binary(grids_of(state)).occupied))
        figures["seconds"] = round(time.perf_counter() - start, 2)
        usual = PlacementConfig().typical_size if self.is_of_package else None
        result = write_progress(
            self.output, sequence, progress, figures, running=False, usual=usual
        )
        self._conclude(progress, result)
        remove_state(self.output)
        if result["verdict"] == "failed":
            sys.exit(3)

    def _list_objects(self, sequence: Any) -> None:
        """Write a picture of the objects in the first frame, and print the size of each."""
        from jaxshape.mapping.placement.finding import first_readable
        from jaxshape.mapping.segmentation.proposals import propose
        from jaxshape.report.proposals import write_proposals

        use_pose = self.poses != "none" and sequence.has_poses
        _, frame = first_readable(sequence, self.first, use_pose)
        found = propose(frame.depth, frame.intrinsics)
        require(bool(found), f"{frame.name} shows only floor and walls; give another --first.")
        picture = self.output / "objects.png"
        write_proposals(picture, frame.depth, frame.color, [one.segmented for one in found])
        for number, one in enumerate(found, 1):
            size = " x ".join(f"{extent:.2f}" for extent in one.size)
            print(f"{number}: {size} m (width, height, depth), {one.distance:.2f} m away")
        print(f"wrote {picture} of {frame.name}; choose an object with --object and its number")

    def _conclude(self, progress: Any, result: dict[str, Any]) -> None:
        """Draw the pictures and the report, and print a summary."""
        from jaxshape.results.progress import observation_of
        from jaxshape.results.summary import verdict_in_words

        observation = observation_of(progress.state)
        with console.status("drawing"):
            draw(self.output, observation, progress.shape, result)
        lost = result["frames_lost"] + result["frames_unreadable"]
        print(
            f"{result['frames']} frames, {result['keyframes']} of them keyframes, {lost} left out"
        )
        for log in progress.logs:
            if log.status in ("lost", "unreadable"):
                said = f"{log.name}: {log.status}, {log.reason}"
                console.print(said, highlight=False, markup=False, soft_wrap=True)
        report_objective(result)
        print(verdict_in_words(result))
        print(f"wrote mesh.glb, trajectory.txt, result.json, report.html and more to {self.output}")


_SECONDS_BETWEEN_WRITES = 3.0
"""Least time between two writes of the files; they never take more than a tenth of the time."""


def _note(progress: Any) -> str:
    return f"{len(progress.state.keyframes)} keyframes"
