"""`jaxshape demo`, and the options that it shares with `jaxshape reconstruct`."""

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from jaxshape import checks, limits
from jaxshape.claim import Output
from jaxshape.cli.common import console
from jaxshape.cli.options import Seen
from jaxshape.data.camera_config import CameraConfig
from jaxshape.data.config import FamilyName
from jaxshape.geometry.config import FusionName
from jaxshape.search.config import RefineConfig, objective_for
from jaxshape.search.names import families

VARIANTS = (
    "cma:ipop, cma:bipop, gradient:OPTIMISER of optax, evosax:STRATEGY, "
    "evosax:STRATEGY@POPULATION, hybrid:OPTIMISER"
)


@dataclass(frozen=True, kw_only=True)
class Rebuild:
    """Options of all commands that rebuild one object."""

    method: Annotated[
        str | None,
        tyro.conf.arg(
            metavar="METHOD",
            help="The search that starts from the first code: encoder (no search), "
            f"{', '.join(families())}, a variant ({VARIANTS}), or your own function by its import "
            "path, package.module:function. None stands for gradient:adam, or for encoder with a "
            "network that is conditioned on the measurement.",
        ),
    ] = None
    search: tyro.conf.OmitArgPrefixes[RefineConfig] = RefineConfig(samples=16)
    weights: Path | None = None
    """Weights to use instead of those that come with the package."""
    seed: int = 0
    """Seed of all random numbers, 0 or more."""

    def __post_init__(self) -> None:
        checks.seed("seed", self.seed)

    def prepare(self, family: FamilyName = "chair") -> tuple[Any, Any, RefineConfig]:
        """The prior, the search and its settings; bad options are refused here, before any work."""
        from jaxshape.model.weights import load_prior
        from jaxshape.search.reconstruction import refiner_for

        prior = load_prior(self.weights_for(family))
        return prior, refiner_for(self.method_for(prior), prior, self.search), self.search

    def placer(self, prior: Any) -> Any:
        """The prior that finds an object's frame.

        For the package's chairs it is the auto-encoder. It finds fronts and sizes better, in half
        the time: a decoder conditioned on the measurement explains it in any frame.
        """
        from jaxshape.model.weights import load_prior

        is_usual = self.weights is None or str(self.weights) == "chair"
        return load_prior("chair-autoencoder") if is_usual else prior

    @property
    def is_of_package(self) -> bool:
        """Whether the weights are those of the package, for chairs and other seats."""
        from jaxshape.model.weights import PACKAGED

        return self.weights is None or str(self.weights) in PACKAGED

    def method_for(self, prior: Any) -> str:
        """The requested method, or the default of the prior."""
        from jaxshape.search.reconstruction import usual_method

        return self.method or usual_method(prior)

    def weights_for(self, family: FamilyName = "chair") -> str:
        """The requested weights file, or the name of the package's weights for a family."""
        from jaxshape.model.weights import packaged_for

        return str(self.weights) if self.weights else packaged_for(family)

    def settings(
        self, prior: Any, fusion: FusionName, family: FamilyName = "chair"
    ) -> dict[str, Any]:
        """Settings of the search for result.json, with the objective for this fusion method."""
        objective = self.search.objective or objective_for(fusion)
        search = asdict(self.search) | {"objective": objective}
        weights = self.weights_for(family)
        settings = {"method": self.method_for(prior), "seed": self.seed, "search": search}
        return settings | {"weights": weights}

    def searched(self, prior: Any, refiner: Any, config: RefineConfig, grids: Any) -> Any:
        """The `Reconstruction` of one object, a batch of one, from its F and M (`Grids`)."""
        import jax

        from jaxshape.search.reconstruction import reconstruct_jit

        with console.status("searching the space of shapes"):
            run = reconstruct_jit(refiner, config)
            key = jax.random.key(self.seed)[None]
            found = run(key, prior, grids.occupied[None], grids.occluded[None])
            return jax.block_until_ready(found)


def written(folder: Path, observation: Any, found: Any, figures: dict[str, Any]) -> dict[str, Any]:
    """Write a result's files, picture and report; returns the content of result.json."""
    from jaxshape.results.output import write_result

    with console.status("drawing"):
        result = write_result(folder, observation, found, figures)
        draw(folder, observation, found, result)
    return result


def draw(folder: Path, observation: Any, found: Any, result: dict[str, Any]) -> None:
    """Write the picture and the report of a result after its other files."""
    from jaxshape.report.page import write_report
    from jaxshape.report.panels import write_overview

    write_overview(folder, observation, found, result)
    write_report(folder)


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
    """Rebuild a procedural object that is not in the training set from simulated Kinect frames
    along an orbit, and compare with the truth.

    Examples: jaxshape demo --seed 3

    jaxshape demo --family table --camera iphone-lidar --frames 12

    jaxshape demo --camera paper --no-symmetry --objective paper
    """

    family: FamilyName = "chair"
    """Class of the object. Without --weights, the network for chairs also rebuilds tables."""
    frames: int = 6
    """Depth frames along the orbit, 20 degrees apart, 1 to 180 (ten turns)."""
    seen: tyro.conf.OmitArgPrefixes[Seen] = Seen()
    output: Path = Path("out/demo")
    """Folder for mesh.glb, mesh.ply, grid.npz, trace.npz, result.json, overview.png and
    report.html."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.whole("frames", self.frames, 1, limits.FRAMES, "that is ten full orbits")

    @property
    def writes(self) -> Output:
        """The output folder."""
        return Output(self.output)

    def run(self) -> None:
        start = time.perf_counter()
        from jaxshape.data.families import TEST_SEEDS, Procedural
        from jaxshape.search.reconstruction import require_measured

        seen = self.seen.config()
        prior, refiner, config = self.prepare(self.family)
        with console.status(f"filming a {self.family}"):
            shown = Procedural(self.family, TEST_SEEDS + self.seed)
            grids, observation = self.film(shown.make(), seen, prior.resolution)
        require_measured(observation.occupied)
        found = self.searched(prior, refiner, config, grids)
        figures = {"object": f"procedural {self.family} {shown.seed}", "frames": self.frames}
        figures |= {"camera": seen.camera, "noise": seen.is_noisy, "fusion": seen.fused_by}
        figures |= self.settings(prior, seen.fused_by, self.family)
        figures |= {"seconds": round(time.perf_counter() - start, 2)}
        result = written(self.output, observation, found, figures)
        report_objective(result)
        print(f"wrote mesh.glb, grid.npz, result.json, overview.png, report.html to {self.output}")
        print(
            f"IoU with the true surface: encoder {result['iou_encoder']:.3f}, "
            f"refined {result['iou_refined']:.3f}, composed {result['iou_composed']:.3f}"
        )

    def film(self, mesh: Any, seen: CameraConfig, resolution: int) -> tuple[Any, Any]:
        """F and M of the mesh (`Grids`), and its frames for the report (`Observation`)."""
        import jax
        import numpy as np

        from jaxshape.data.capture import camera_distance, capture, fused_frames, sensor_of
        from jaxshape.data.virtual_cameras import virtual_camera
        from jaxshape.geometry import camera
        from jaxshape.geometry.fusing import fusion_named
        from jaxshape.geometry.grids import binary
        from jaxshape.results.output import Observation

        device = virtual_camera(seen.camera)
        distance = camera_distance(mesh, device)
        captured = capture(
            mesh,
            jax.jit(lambda: camera.orbit(self.frames, distance))(),
            noise=seen.is_noisy,
            seed=self.seed,
            camera=device,
            resolution=resolution,
        )
        fusing, sensor = fusion_named(seen.fused_by, resolution), sensor_of(device)
        state, grids = fused_frames(captured, fusing, sensor)
        shown = binary(grids)
        return grids, Observation(
            depth=list(np.asarray(captured.depth)[:6]),
            occupied=np.asarray(shown.occupied),
            occluded=np.asarray(shown.occluded),
            frame=captured.frame,
            T_world_object=np.eye(4),
            truth=np.asarray(captured.surface),
            field=state if seen.fused_by == "distance" else None,
            soft=grids if seen.fused_by == "distance" else None,
            sensor=sensor,
        )
