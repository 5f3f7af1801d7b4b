"""`jaxshape scene`: all objects of a room from a recording."""

import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import tyro

from jaxshape import checks
from jaxshape.claim import Output
from jaxshape.cli.common import console, progress_bar, warn
from jaxshape.cli.opening import Recorded
from jaxshape.mapping.config import MappingConfig, TrackingConfig
from jaxshape.search.config import RefineConfig


@dataclass(frozen=True, kw_only=True)
class BuildScene(Recorded):
    """Rebuild all objects of a room from an RGB-D recording, each of its own class.

    Everything that has the size of furniture and stands on the floor or on a table becomes an
    object. The priors decide its class and which way it faces; an object of no known class is kept
    as measured, without completion. Objects that moved during the recording are left out.

    Examples: jaxshape scene room/

    jaxshape scene room/ --prior table table.safetensors

    jaxshape scene room/ --every 5 --poses none
    """

    prior: dict[str, Path] = field(default_factory=dict)
    """Further classes and their weights, in addition to those of the package: NAME FILE ..."""
    method: str | None = None
    """Search method, as in `jaxshape reconstruct`; None for the default of each network."""
    search: tyro.conf.OmitArgPrefixes[RefineConfig] = RefineConfig(samples=16)
    seed: int = 0
    """Seed of all random numbers, 0 or more."""
    poses: Literal["auto", "none"] = "auto"
    """Which of the recorded poses to use: all (auto: if there are any), or none."""
    tracking: tyro.conf.OmitArgPrefixes[TrackingConfig] = TrackingConfig()
    mapping: tyro.conf.OmitArgPrefixes[MappingConfig] = MappingConfig()
    output: Path = Path("out/scene")
    """Folder for scene.glb, scene.json, mesh.ply, objects.png, objects/, report.html and more."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.seed("seed", self.seed)

    @property
    def writes(self) -> Output:
        """The output folder."""
        return Output(self.output, reads=self.frames)

    def run(self) -> None:
        start = time.perf_counter()
        from jaxshape.mapping.scene.classes import build_classes
        from jaxshape.mapping.scene.following import finish_scene, follow_scene
        from jaxshape.model.weights import load_scene_priors
        from jaxshape.report.page import write_report
        from jaxshape.results.scene_files import write_scene, write_scene_progress

        priors, placers = load_scene_priors(self.prior)
        classes = build_classes(
            priors,
            placers=placers,
            method=self.method,
            search=self.search,
            mapping=self.mapping,
            track=self.tracking,
            seed=self.seed,
        )
        found = self.opened()
        sequence = found.sequence
        use_poses = self.uses_poses(found, self.poses)
        figures: dict[str, Any] = {
            "object": str(self.frames),
            "seed": self.seed,
            "classes": list(priors),
            "mapping": asdict(self.mapping),
            "tracking": asdict(self.tracking),
            "warnings": [warning.sentence for warning in found.warnings],
        }
        for warning in figures["warnings"]:
            warn(warning)
        chosen = range(self.first, len(sequence), self.every)
        scene = None
        with progress_bar("frames") as bar:
            task = bar.add_task("follow", total=len(chosen), note="")
            for scene in follow_scene(
                sequence, classes, chosen=chosen, first=self.first, use_poses=use_poses
            ):
                note = f"{len(scene.objects)} objects"
                bar.update(task, completed=len(scene.logs), note=note)
                if scene.logs[-1].status == "keyframe":
                    write_scene_progress(self.output, sequence, scene, figures)
        assert scene is not None  # there is at least the first frame
        with console.status("deciding what the objects are"):
            scene = finish_scene(scene, classes)
        figures["seconds"] = round(time.perf_counter() - start, 2)
        with console.status("writing"):
            result = write_scene(self.output, sequence, scene, figures)
            self._picture(sequence, scene)
            write_report(self.output)
        self._conclude(result)

    def _picture(self, sequence: Any, scene: Any) -> None:
        """Write objects.png: the keyframe that shows the objects best."""
        import numpy as np

        from jaxshape.report.proposals import write_proposals

        if not scene.objects:
            return
        logs = [log for log in scene.logs if log.status == "keyframe"]
        shown = [
            [np.asarray(one.progress.state.keyframes[k].segmented) for one in scene.objects]
            for k in range(len(logs))
        ]
        k = max(range(len(logs)), key=lambda k: sum(np.sqrt(one.sum()) for one in shown[k]))
        keyframe = scene.camera.state.keyframes[k]
        color = sequence[logs[k].index].color
        h, w = keyframe.depth.shape
        if color is not None:
            step = color.shape[1] // w
            color = color[step // 2 :: step, step // 2 :: step][:h, :w]
        numbers = [one.thing.number for one in scene.objects]
        picture = self.output / "objects.png"
        write_proposals(picture, np.asarray(keyframe.depth), color, shown[k], numbers)

    def _conclude(self, result: dict[str, Any]) -> None:
        """Print a summary: a line for each object."""
        from jaxshape.results.summary import objects_in_words

        print(f"{result['frames']} frames, {result['keyframes']} of them keyframes")
        for line in objects_in_words(result):
            print(line)
        for warning in result["warnings"]:
            warn(warning)
        print(f"wrote scene.glb, scene.json, objects.png, report.html and more to {self.output}")
