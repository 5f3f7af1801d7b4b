"""Score refinement methods on meshes seen along an orbit (paper, section 4.1). [host]"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Key

from jaxshape import checks, limits
from jaxshape.data.camera_config import CameraConfig
from jaxshape.data.capture import camera_distance, capture, fused_grids, sensor_of
from jaxshape.data.dataset import hash_seed
from jaxshape.data.meshes import Model, Skipped, in_metres
from jaxshape.data.virtual_cameras import virtual_camera
from jaxshape.geometry import camera
from jaxshape.geometry.fusing import fusion_named
from jaxshape.geometry.grid import RESOLUTION
from jaxshape.geometry.grids import Grids, binary
from jaxshape.geometry.overlap import iou
from jaxshape.model.shapes import ShapePrior
from jaxshape.results.metrics import bounds, occluded_scores, shape_scores
from jaxshape.search.config import RefineConfig
from jaxshape.search.devices import over_devices
from jaxshape.search.reconstruction import (
    Reconstruction,
    all_measured,
    fit_surface,
    reconstruct,
    refiner_for,
)

OBJECTS_AT_A_TIME = 16
"""Objects refined together on each device: enough to fill it, few enough to show progress."""


@dataclass(frozen=True)
class EvaluateConfig(CameraConfig):
    """Settings of an evaluation, besides the meshes and the weights.

    Attributes:
        frames: Numbers of frames to fuse, each 1 or more: the first k of the orbit.
        methods: Names of the searches, see `jaxshape.search.methods`; "encoder" searches nothing.
        camera: Name of the depth camera, see `jaxshape.data.virtual_cameras`.
        noise: Give the depth images the faults of the camera's sensor; None gives them to all
            cameras except the paper's.
        fusion: Method that turns frames into F and M, "distance" or "points"; None for points where
            the paper's camera has no noise, distances elsewhere.
        ceiling: Add to the bounds the best shape that the code space can hold (`fit_surface`),
            independent of the measurement.
        refine: Settings of the searches.
        seed: Seed of noise, surface samples and searches, 0 or more.
    """

    frames: tuple[int, ...] = (1, 4, 8, 18)
    methods: tuple[str, ...] = ("encoder", "gradient", "cma")
    ceiling: bool = False
    refine: RefineConfig = field(default_factory=RefineConfig)
    seed: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.seed("seed", self.seed)
        if not self.frames:
            checks.refuse("frames", self.frames, "numbers of frames, 1 or more each")
        for number in self.frames:
            checks.whole("frames", number, 1, limits.FRAMES, "that is ten full orbits")


NOTHING = "For some number of frames, no pixel hits the mesh: it is too thin for the camera."


class Case(NamedTuple):
    """One object after one number of frames; batched over both.

    Attributes:
        grids: F and M `[*case x y z]`: binary from points, soft from signed distances.
        surface: True surface voxels `[*case x y z]`.
    """

    grids: Grids
    surface: Bool[Array, "*case x y z"]


def observe(model: Model, config: EvaluateConfig, resolution: int = RESOLUTION) -> Case | None:
    """Fuse the first k frames of an orbit at 30 degrees elevation, for every k of the settings.

    Args:
        model: The mesh, in metres; if its size fits no object, it is scaled to a diagonal of 1 m.
        config: Settings of the evaluation.
        resolution: Voxels along each axis of the grids.

    Returns:
        The grids; None where some number of frames measured nothing.
    """
    mesh, device = in_metres(model.mesh), virtual_camera(config.camera)
    # Independent of the other meshes, so that the scores of a mesh do not depend on them.
    seed = hash_seed(config.seed, *model.name.encode())
    captured = capture(
        mesh,
        camera.orbit(max(config.frames), camera_distance(mesh, device)),
        noise=config.is_noisy,
        seed=seed,
        camera=device,
        resolution=resolution,
    )
    fusing, numbers = fusion_named(config.fused_by, resolution), tuple(sorted(config.frames))
    grids = fused_grids(captured, fusing, numbers, sensor_of(device))
    if not all_measured(binary(grids).occupied):
        return None
    order = np.array([numbers.index(k) for k in config.frames])
    grids = jax.tree.map(lambda x: x[order], grids)
    return Case(grids, jnp.broadcast_to(captured.surface, grids.occupied.shape))


def evaluate(
    prior: ShapePrior, models: Sequence[Model | Skipped], config: EvaluateConfig
) -> Iterator[dict[str, Any] | Skipped]:
    """Score each mesh in turn.

    Meshes are refined in batches; the last batch is filled up with its own first cases so that one
    compiled program serves all.

    Args:
        prior: The shape prior.
        models: The meshes, of which a batch at a time is taken (`LoadedWhenNeeded`).
        config: Settings of the evaluation.

    Yields:
        The scores of each mesh, as written under `per_mesh` in the results file; a mesh that cannot
        be used, or of which nothing is measured, is `Skipped`.
    """
    run, fit = by_each_method(prior, config), jax.jit(fit_surface)
    group = max(1, OBJECTS_AT_A_TIME * jax.local_device_count() // len(config.frames))
    size = min(group, len(models)) * len(config.frames)
    for start in range(0, len(models), group):
        seen = []
        for model in models[start : start + group]:
            if isinstance(model, Skipped):
                yield model
            elif (case := observe(model, config, prior.resolution)) is None:
                yield Skipped(model.name, "nothing measured", NOTHING)
            else:
                seen.append((model, case))
        if not seen:
            continue
        keys = jnp.concatenate([case_keys(m.name, config.frames, config.seed) for m, _ in seen])
        cases = jax.tree.map(lambda *x: jnp.concatenate(x), *[case for _, case in seen])
        keys, filled = jax.tree.map(lambda x: fill(x, size), (keys, cases))
        found = jax.device_get(run(keys, prior, filled.grids))
        found = {name: found[name] for name in config.methods}  # JAX has sorted the names
        cases = jax.device_get(cases)
        ceilings = None
        if config.ceiling:
            surfaces = filled.surface[:: len(config.frames)]
            ceilings = iou(fit(prior, surfaces), surfaces)
        for i, (model, _) in enumerate(seen):
            rows = range(i * len(config.frames), (i + 1) * len(config.frames))
            frames = {
                str(k): _scores(jax.tree.map(lambda x, row=row: x[row], cases), found, row)
                for k, row in zip(config.frames, rows, strict=True)
            }
            if ceilings is not None:
                for scores in frames.values():
                    scores["bounds"]["ceiling"] = float(ceilings[i])
            about = {"name": model.name, "content": model.digest, "metadata": model.metadata}
            yield about | {"frames": frames}


def by_each_method(
    prior: ShapePrior, config: EvaluateConfig
) -> Callable[..., dict[str, Reconstruction]]:
    """A compiled `reconstruct` by every method.

    All methods are in one program, in which XLA computes their common parts only once: the first
    code, its decoded shape and the target.

    Args:
        prior: The shape prior.
        config: Settings of the evaluation.

    Raises:
        ValueError: There is no such method.
    """
    refiners = {name: refiner_for(name, prior, config.refine) for name in config.methods}

    def run(prior, rows):
        keys, grids = rows
        F, M = grids.occupied, grids.occluded
        return {
            name: reconstruct(keys, prior, F, M, refiner, config.refine)
            for name, refiner in refiners.items()
        }

    return jax.jit(lambda keys, prior, grids: over_devices(run, prior, (keys, grids)))


def case_keys(name: str, frames: Sequence[int], seed: int = 0) -> Key[Array, " case"]:
    """Random keys that depend on the mesh and the number of frames, not on the batch."""
    return jnp.stack([jax.random.key(hash_seed(seed, k, *name.encode())) for k in frames])


def fill(rows: Array, size: int) -> Array:
    """Repeat the first rows until there are `size`."""
    return rows[jnp.arange(size) % len(rows)]


def _scores(case: Case, found: dict[str, Any], row: int) -> dict[str, Any]:
    scores: dict[str, Any] = {}
    for method, result in found.items():
        shape = shape_scores(result.completed[row], case.surface)
        hidden = occluded_scores(
            result.composed[row], result.fill_logits[row], case.grids.occluded, case.surface
        )
        scores[method] = {
            "iou": shape.iou,
            "iou_composed": float(iou(result.composed[row], case.surface)),
            "iou_occluded": float(hidden.iou),
            "cross_entropy_occluded": float(hidden.cross_entropy),
            "chamfer_l1": shape.chamfer_l1,
            "f_score": shape.f_score,
            "objective": float(result.objective[row]),
        }
    occupied, occluded, _ = binary(case.grids)
    limits = bounds(occupied, occluded, case.surface)
    scores["bounds"] = {name: float(value) for name, value in limits._asdict().items()}
    return scores


def summarize(per_mesh: Sequence[dict[str, Any]], config: EvaluateConfig) -> dict[str, Any]:
    """Means over meshes: `means[k][method][score]`, and the bounds."""
    return {
        str(k): {
            method: {
                score: float(np.mean([m["frames"][str(k)][method][score] for m in per_mesh]))
                for score in per_mesh[0]["frames"][str(k)][method]
            }
            for method in (*config.methods, "bounds")
        }
        for k in config.frames
    }
