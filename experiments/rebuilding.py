"""Rebuild the object of a recording as `jaxshape reconstruct` does, and judge the result."""

from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import runs
from jaxshape.data.sequences import Sequence
from jaxshape.mapping.config import MappingConfig, TrackingConfig
from jaxshape.mapping.map.doubts import doubts_of, unseen_of
from jaxshape.mapping.map.mapper import Mapper, build_mapper
from jaxshape.mapping.map.recording import Progress, follow
from jaxshape.mapping.placement.finding import Start
from jaxshape.model.shapes import ShapePrior
from jaxshape.model.weights import load_prior
from jaxshape.results.output import ShapeMesh, only, shape_mesh
from jaxshape.results.progress import floor_height, observation_of, seen_views
from jaxshape.results.verdict import judged, quality_of
from jaxshape.search.config import RefineConfig


@dataclass(frozen=True)
class Config(runs.Config):
    """Settings of experiments on a recording."""

    recording: Path = Path("kitchen/frames")
    """A recording with poses."""
    box: Path = Path("experiments/kitchen_chair_box.json")
    """The object's box in the world of these poses, measured by hand."""


def middle_pixel(shown: np.ndarray) -> tuple[float, float]:
    """The pixel to click, u and v: the true pixel nearest to the middle of all true pixels."""
    row, column = np.nonzero(shown)
    middle = np.argmin(np.hypot(row - np.median(row), column - np.median(column)))
    return float(column[middle]) + 0.5, float(row[middle]) + 0.5


def usual() -> tuple[ShapePrior, Mapper]:
    """The default prior that places chairs, and the default mapper."""
    mapper = build_mapper(load_prior(), None, RefineConfig(), MappingConfig(), TrackingConfig())
    return load_prior("chair-autoencoder"), mapper


def rebuilt(
    sequence: Sequence,
    start: Start,
    placer: ShapePrior,
    mapper: Mapper,
    *,
    use_poses: bool,
    chosen: range | None = None,
) -> Progress:
    """Follow a recording to its end and finish its map; `chosen` frames of it, or all."""
    steps = follow(sequence, start, mapper, placer, use_poses=use_poses, chosen=chosen)
    (progress,) = deque(steps, maxlen=1)
    state, shape = mapper.finish(progress.state)
    return progress._replace(state=state, shape=shape)


def meshed(progress: Progress) -> ShapeMesh:
    """The mesh of a finished map."""
    assert progress.shape is not None
    one = only(progress.shape)
    return shape_mesh(observation_of(progress.state), one.composed, one.fill_logits)


def judgement(progress: Progress, found: ShapeMesh) -> dict[str, Any]:
    """The judgement of a result: size, warnings, verdict, reasons, figures of quality."""
    assert progress.shape is not None
    quality = quality_of(
        found.mesh,
        found.measured,
        seen_views(progress.state),
        axial=progress.state.fusing.sensor.axial,
        is_mirrored=bool(only(progress.shape).symmetric),
        floor=floor_height(progress.start),
        unseen=unseen_of(progress),
    )
    verdict = judged(quality)
    return {
        "size": progress.start.box.size.round(4).tolist(),
        "warnings": [*progress.start.warnings, *doubts_of(progress)],
        "verdict": verdict.word,
        "reasons": verdict.reasons,
        "quality": {k: v for k, v in quality._asdict().items() if k != "size"},
    }
