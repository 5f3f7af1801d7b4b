"""`jaxshape demo` and `jaxshape reconstruct`: one object from its depth frames."""

import pkgutil
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import Positional

from jaxshape.cli.common import console, progress_bar, require
from jaxshape.cli.options import checked_search
from jaxshape.refine.config import RefineConfig

# Found as files: importing the package of the methods would import JAX.
METHODS = ", ".join(
    family.name
    for family in pkgutil.iter_modules([str(Path(__file__).parents[1] / "refine/methods")])
)
VARIANTS = "cma:ipop, cma:bipop, gradient:OPTIMISER of optax, evosax:STRATEGY, hybrid:OPTIMISER"


@dataclass(frozen=True, kw_only=True)
class Rebuild:
    """What the commands that rebuild one object have in common."""

    method: Annotated[
        str,
        tyro.conf.arg(
            metavar="METHOD",
            help=f"How the first code is searched on: encoder (not at all), {METHODS}, or a "
            f"variant: {VARIANTS}.",
        ),
    ] = "cma"
    search: tyro.conf.OmitArgPrefixes[RefineConfig] = RefineConfig()
    weights: Path | None = None
    """Weights to use instead of those that come with the package."""
    seed: int = 0
    """Of all random numbers."""

    def prepare(self) -> tuple[Any, Callable[..., Any]]:
        """The shape prior and the search, so that bad options are refused before any work."""
        from jaxshape.model.weights import load_prior
        from jaxshape.refine.reconstruction import reconstruct_jit, refiner_for

        config, prior = checked_search(self.search), load_prior(self.weights)
        return prior, reconstruct_jit(refiner_for(self.method, prior, config), config)

    def rebuild(
        self,
        prepared: tuple[Any, Callable[..., Any]],
        observation: Any,
        figures: dict[str, Any],
        output: Path,
        start: float,
    ) -> dict[str, Any]:
        """Encode, search, and write the files of one observed object; returns result.json."""
        import jax
        import jax.numpy as jnp

        from jaxshape.refine.reconstruction import require_measured
        from jaxshape.results.output import write_result

        require_measured(observation.occupied)
        prior, run = prepared
        with console.status("searching the space of shapes"):
            grids = jnp.asarray(observation.occupied)[None], jnp.asarray(observation.occluded)[None]
            keys = jax.random.key(self.seed)[None]
            reconstruction = jax.block_until_ready(run(keys, prior, *grids))
        figures |= {"method": self.method, "seed": self.seed, "search": asdict(self.search)}
        figures["seconds"] = round(time.perf_counter() - start, 2)
        with console.status("drawing"):
            result = write_result(output, observation, reconstruction, figures)
        stopped = f", stopped by {result['stop']}" if result["stop"] else ""
        print(
            f"objective: encoder {result['objective_encoder']:.4f}, "
            f"refined {result['objective_refined']:.4f} nats per voxel "
            f"after {result['iterations']} iterations{stopped}"
        )
        trace = "trace.npz, " if result["stop"] else ""
        print(f"wrote mesh.glb, grid.npz, {trace}overview.png, result.json to {output}")
        return result


@dataclass(frozen=True, kw_only=True)
class Demo(Rebuild):
    """Rebuild a procedural chair nobody trained on from a noisy orbit of depth frames, and compare
    with the truth.

    Example: jaxshape demo --seed 3
    """

    frames: int = 6
    """Depth frames along the orbit, 20 degrees apart."""
    output: Path = Path("out/demo")
    """Folder for mesh.glb, grid.npz, trace.npz, result.json and overview.png."""

    def run(self) -> None:
        start = time.perf_counter()
        import jax
        import numpy as np

        from jaxshape.data.capture import capture, measure_frames
        from jaxshape.data.chairs import random_chair
        from jaxshape.data.dataset import TEST_SEEDS
        from jaxshape.geometry import camera, fusion
        from jaxshape.results.output import Observation

        require(self.frames >= 1, f"--frames is {self.frames}; give 1 or more.")
        require(self.seed >= 0, f"--seed is {self.seed}; give a number that is not negative.")
        prepared = self.prepare()
        mesh = random_chair(TEST_SEEDS + self.seed)
        # As near as a Kinect's 57 degrees allow: what it measures gets worse with distance squared.
        T_object_camera = jax.jit(lambda: camera.orbit(self.frames, float(mesh.scale)))()
        seen = capture(mesh, T_object_camera, noise=True, seed=self.seed)
        merged = jax.jit(fusion.merge_all)(measure_frames(seen))
        observation = Observation(
            depth=list(np.asarray(seen.depth)[:6]),
            occupied=np.asarray(fusion.occupied(merged)),
            occluded=np.asarray(fusion.occluded(merged)),
            frame=seen.frame,
            T_world_object=np.eye(4),
            truth=np.asarray(seen.surface),
        )
        figures = {"object": f"procedural chair {TEST_SEEDS + self.seed}", "frames": self.frames}
        result = self.rebuild(prepared, observation, figures, self.output, start)
        print(
            f"IoU with the true surface: encoder {result['iou_encoder']:.3f}, "
            f"refined {result['iou_refined']:.3f}, composed {result['iou_composed']:.3f}"
        )


@dataclass(frozen=True, kw_only=True)
class Reconstruct(Rebuild):
    """Rebuild an object from depth frames with known poses.

    Example: jaxshape reconstruct scan/ --box scan/box.json --every 5
    """

    frames: Positional[Path]
    """Folder of frame-N.depth.png, frame-N.pose.txt and camera-intrinsics.txt (7-Scenes layout);
    frame-N.mask.png beside them tells the object from the rest."""
    box: Path | None = None
    """JSON file with the object's box: {"T_world_object": 4x4, "size": [x, y, z]}. The object
    frame has +y up and its front along +z. Needed where there are no masks."""
    every: int = 1
    """Use every n-th frame."""
    depth_scale: float = 1000.0
    """Depth units in a metre."""
    min_hits: int = 1
    """Depth points that make a voxel occupied; more than 1 suppresses stray points."""
    isotropic: bool = False
    """Scale all axes alike, as the paper does on real data, instead of filling the box."""
    output: Path = Path("out/reconstruct")
    """Folder for mesh.glb, grid.npz, trace.npz, result.json and overview.png."""

    def run(self) -> None:
        start = time.perf_counter()

        from jaxshape.data.boxes import read_box
        from jaxshape.data.sequences import open_sequence, poses_look_inverted
        from jaxshape.results.scan import observe_sequence

        require(self.every >= 1, f"--every is {self.every}; give 1 or more.")
        require(self.min_hits >= 1, f"--min-hits is {self.min_hits}; give 1 or more.")
        prepared = self.prepare()
        sequence = open_sequence(self.frames, depth_scale=self.depth_scale)
        box = read_box(self.box) if self.box else None
        require(
            not poses_look_inverted(sequence),
            f"The poses in {str(self.frames)!r} look like world to camera: the frames agree better "
            "when each is inverted. Write camera to world.",
        )
        with progress_bar("frames") as bar:
            chosen = range(0, len(sequence), self.every)
            watched = bar.track(chosen, task_id=bar.add_task("fuse", note=""))
            observation = observe_sequence(
                sequence, watched, box, min_hits=self.min_hits, isotropic=self.isotropic
            )
        figures = {"object": str(self.frames), "frames": len(chosen)}
        self.rebuild(prepared, observation, figures, self.output, start)
