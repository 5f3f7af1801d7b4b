"""`jaxshape demo`, and what it has in common with `jaxshape reconstruct`."""

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from jaxshape.cli.common import console, require
from jaxshape.search.config import RefineConfig
from jaxshape.search.names import families

VARIANTS = (
    "cma:ipop, cma:bipop, gradient:OPTIMISER of optax, evosax:STRATEGY, "
    "evosax:STRATEGY@POPULATION, hybrid:OPTIMISER"
)


@dataclass(frozen=True, kw_only=True)
class Rebuild:
    """Options of all commands that rebuild one object."""

    method: Annotated[
        str,
        tyro.conf.arg(
            metavar="METHOD",
            help="How the first code is searched on: encoder (not at all), "
            f"{', '.join(families())}, a variant ({VARIANTS}), or a function of yours by its "
            "import path, package.module:function.",
        ),
    ] = "cma"
    search: tyro.conf.OmitArgPrefixes[RefineConfig] = RefineConfig()
    weights: Path | None = None
    """Weights to use instead of those that come with the package."""
    seed: int = 0
    """Seed of all random numbers, 0 or more."""

    def prepare(self) -> tuple[Any, Any, RefineConfig]:
        """The prior, the search and its settings, so that bad options are refused before work."""
        from jaxshape.model.weights import load_prior
        from jaxshape.search.reconstruction import refiner_for

        prior = load_prior(self.weights)
        return prior, refiner_for(self.method, prior, self.search), self.search

    def settings(self) -> dict[str, Any]:
        """Settings of the search for result.json."""
        return {"method": self.method, "seed": self.seed, "search": asdict(self.search)}


def report_objective(result: dict[str, Any]) -> None:
    """Print the objective before and after the search."""
    stopped = f", stopped by {result['stop']}" if result["stop"] else ""
    print(
        f"objective: encoder {result['objective_encoder']:.4f}, "
        f"refined {result['objective_refined']:.4f} nats per voxel "
        f"after {result['iterations']} iterations{stopped}"
    )


@dataclass(frozen=True, kw_only=True)
class Demo(Rebuild):
    """Rebuild a procedural chair nobody trained on from a noisy orbit of depth frames, and compare
    with the truth.

    Example: jaxshape demo --seed 3
    """

    frames: int = 6
    """Depth frames along the orbit, 20 degrees apart, 1 or more."""
    output: Path = Path("out/demo")
    """Folder for mesh.glb, mesh.ply, grid.npz, trace.npz, result.json, overview.png and
    report.html."""

    def run(self) -> None:
        start = time.perf_counter()
        import jax
        import jax.numpy as jnp
        import numpy as np

        from jaxshape.data.capture import capture, measure_frames
        from jaxshape.data.chairs import random_chair
        from jaxshape.data.dataset import TEST_SEEDS
        from jaxshape.geometry import camera, fusion
        from jaxshape.report.page import write_report
        from jaxshape.report.panels import write_overview
        from jaxshape.results.output import Observation, write_result
        from jaxshape.search.reconstruction import reconstruct_jit, require_measured

        require(self.frames >= 1, f"--frames is {self.frames}; give 1 or more.")
        require(self.seed >= 0, f"--seed is {self.seed}; give a number that is not negative.")
        prior, refiner, config = self.prepare()
        mesh = random_chair(TEST_SEEDS + self.seed)
        # As near as a Kinect's 57 degrees allow: what it measures gets worse with distance squared.
        T_object_camera = jax.jit(lambda: camera.orbit(self.frames, float(mesh.scale)))()
        seen = capture(
            mesh,
            T_object_camera,
            noise=True,
            seed=self.seed,
            resolution=prior.resolution,
        )
        merged = jax.jit(fusion.merge_all)(measure_frames(seen))
        observation = Observation(
            depth=list(np.asarray(seen.depth)[:6]),
            occupied=np.asarray(fusion.occupied(merged)),
            occluded=np.asarray(fusion.occluded(merged)),
            frame=seen.frame,
            T_world_object=np.eye(4),
            truth=np.asarray(seen.surface),
        )
        require_measured(observation.occupied)
        with console.status("searching the space of shapes"):
            grids = jnp.asarray(observation.occupied)[None], jnp.asarray(observation.occluded)[None]
            run = reconstruct_jit(refiner, config)
            found = jax.block_until_ready(run(jax.random.key(self.seed)[None], prior, *grids))
        figures = {"object": f"procedural chair {TEST_SEEDS + self.seed}", "frames": self.frames}
        figures |= self.settings() | {"seconds": round(time.perf_counter() - start, 2)}
        with console.status("drawing"):
            result = write_result(self.output, observation, found, figures)
            write_overview(self.output, observation, found, result)
            write_report(self.output)
        report_objective(result)
        print(f"wrote mesh.glb, grid.npz, result.json, overview.png, report.html to {self.output}")
        print(
            f"IoU with the true surface: encoder {result['iou_encoder']:.3f}, "
            f"refined {result['iou_refined']:.3f}, composed {result['iou_composed']:.3f}"
        )
