r"""One chair rebuilt from five first frames, with all, one or no given pose: is it the same chair?

    python experiments/first_frames.py --recording kitchen/frames \
        --box experiments/kitchen_chair_box.json

The slatted chair of `real_recording`, half hidden by a table. Each run begins at another frame,
with a click at the pixel that shows the middle of the chair, and goes to the end of the recording.
A run agrees if all extents are within 3 cm of those measured by hand. A run that does not agree
must say so: its verdict must not be good, or it must warn of sides that were not seen.

Results: experiments/results/first_frames.json, run by run: a killed experiment resumes.
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from jaxshape.data.boxes import Box, points_in_box, read_box
from jaxshape.data.sequences import Frame, Sequence, SequenceError, open_sequence
from jaxshape.files import write_json
from jaxshape.mapping.map.mapper import Mapper
from jaxshape.mapping.placement.finding import find_start
from jaxshape.mapping.segmentation.planes import camera_points
from jaxshape.mapping.segmentation.segment import Prompt
from jaxshape.model.shapes import ShapePrior
from jaxshape.process import prepare_process
from rebuilding import judgement, meshed, middle_pixel, rebuilt, usual
from runs import earlier

RESULTS = Path(__file__).parent / "results"
WAYS = ("given", "first", "none")
NEAR = 0.03
"""Largest error of an extent, in metres."""


@dataclass(frozen=True)
class Config:
    """Settings of the experiment."""

    recording: Path = Path("kitchen/frames")
    """A recording with poses."""
    box: Path = Path("experiments/kitchen_chair_box.json")
    """The object's box in the world of these poses."""
    first: tuple[str, ...] = ("000000", "000040", "000100", "000160", "000200")
    """Numbers in the names of the first frames."""
    results: Path = RESULTS
    smoke: bool = False
    """A test run: one first frame, given poses, every fourth frame."""


def main(config: Config) -> None:
    prepare_process()
    metrics = run(config)
    for name, one in metrics["runs"].items():
        print(name.ljust(14), _row(one))
    print(metrics["summary"])


def _row(one: dict[str, Any]) -> str:
    if "failed" in one:
        return one["failed"]
    size = " x ".join(f"{x:.2f}" for x in one["size"])
    quality = one["quality"]
    return (
        f"{size} m, {100 * quality['floor_gap']:+.0f} cm from the floor, {quality['pieces']} pieces"
        f", {quality['explained']:.0%} explained, {one['verdict']}, {len(one['warnings'])} warnings"
    )


def run(config: Config) -> dict[str, Any]:
    """Run every start in each way, and resume from earlier results of the same settings."""
    path = config.results / "first_frames.json"
    firsts = config.first[: 1 if config.smoke else None]
    settings = {"recording": config.recording.name, "box": config.box.name, "first": list(firsts)}
    done = earlier(path, settings, "runs")
    sequence, box = open_sequence(config.recording), read_box(config.box)
    placer, mapper = usual()
    for first in firsts:
        for way in WAYS[: 1 if config.smoke else None]:
            name = f"{first} {way}"
            if name not in done:
                index = next(i for i, one in enumerate(sequence.names) if first in one)
                chosen = range(index, len(sequence), 4 if config.smoke else 1)
                done[name] = _rebuild(way, sequence, box, chosen, placer, mapper)
                write_json(path, {"settings": settings, "summary": summary(done), "runs": done})
                print(name, _row(done[name]), flush=True)
    return {"settings": settings, "summary": summary(done), "runs": done}


def summary(runs: dict[str, dict[str, Any]]) -> dict[str, int]:
    """Numbers of runs that agree with the hand-measured size, and of wrong runs without warning."""
    ended = [one for one in runs.values() if "failed" not in one]
    wrong = [one for one in ended if np.abs(one["off"]).max() > NEAR]
    unsaid = [one for one in wrong if one["verdict"] == "good" and not one["warnings"]]
    return {
        "runs": len(runs),
        "refused": len(runs) - len(ended),
        "same chair": len(ended) - len(wrong),
        "another": len(wrong),
        "another and not said": len(unsaid),
    }


def _rebuild(
    way: str, sequence: Sequence, box: Box, chosen: range, placer: ShapePrior, mapper: Mapper
) -> dict[str, Any]:
    began = time.process_time()
    frame = sequence[chosen.start]
    prompt = Prompt(click=middle_of(frame, box))
    try:
        start = find_start(sequence, placer, prompt, first=chosen.start, use_pose=way != "none")
        progress = rebuilt(sequence, start, placer, mapper, use_poses=way == "given", chosen=chosen)
        result = judgement(progress, meshed(progress))
    except SequenceError as failure:
        return {"failed": str(failure)}
    off = np.array(result["size"]) - box.size
    seconds = round(time.process_time() - began, 1)
    return {"click": prompt.click, "off": off.round(4).tolist(), **result, "cpu_seconds": seconds}


def middle_of(frame: Frame, box: Box) -> tuple[float, float]:
    """The pixel of the object, u and v, that is nearest to the middle of all its pixels."""
    points = camera_points(frame.depth, frame.intrinsics)
    T = np.asarray(frame.T_world_camera)
    shown = points_in_box(points @ T[:3, :3].T + T[:3, 3], box)
    return middle_pixel(shown)


if __name__ == "__main__":
    main(tyro.cli(Config))
