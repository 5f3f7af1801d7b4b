"""The `jaxshape` command. [host]

Each subcommand is a frozen dataclass whose fields are its options and whose `run` does the work.
Bad input ends with one sentence on standard error and exit status 2, and leaves earlier output as
it was. JAX, and all that needs it, is imported inside `run`, so that `--help` answers at once.
"""

import json
import math
import os
import pkgutil
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from tyro.conf import Positional, subcommand

from jaxshape.process import prepare_process
from jaxshape.refine.config import RefineConfig

console = Console(stderr=True)
"""Progress, warnings and errors; what a command answers goes to standard output."""

# Found as files: importing the package of the methods would import JAX.
METHODS = ", ".join(
    family.name for family in pkgutil.iter_modules([str(Path(__file__).parent / "refine/methods")])
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

        config, prior = _checked(self.search), load_prior(self.weights)
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

        _require(self.frames >= 1, f"--frames is {self.frames}; give 1 or more.")
        _require(self.seed >= 0, f"--seed is {self.seed}; give a number that is not negative.")
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


@dataclass(frozen=True)
class Dataset:
    output: Path
    """Folder of the dataset; a build that was killed goes on when asked for again."""
    chairs: int = 8000
    """Procedural chairs to make, unless --meshes is given."""
    meshes: Path | None = None
    """Mesh, archive or folder (ShapeNet, ModelNet, ...) to use instead of procedural chairs."""
    up: str = "y"
    """Axis of the meshes that points up: x, y, z, -x, -y or -z."""
    front: str = "z"
    """Axis of the meshes along which the object's front looks."""
    views: int = 18
    """Random views of each object."""
    noisy: float = 0.5
    """Share of the objects whose views get the faults of a real depth sensor."""
    workers: int = os.cpu_count() or 1
    """Processes."""
    seed: int = 0
    """Of views, noise and surface samples."""

    def run(self) -> None:
        from jaxshape.data.archives import list_meshes
        from jaxshape.data.dataset import TEST_SEEDS, DatasetConfig, build_dataset
        from jaxshape.data.meshes import axes_to_canonical

        _require(1 <= self.chairs <= TEST_SEEDS, f"--chairs is {self.chairs}; give 1 to 1000000.")
        _require(self.views >= 1, f"--views is {self.views}; give 1 or more.")
        _require(self.workers >= 1, f"--workers is {self.workers}; give 1 or more.")
        axes_to_canonical(self.up, self.front)
        objects: Sequence[Any] = list_meshes(self.meshes) if self.meshes else range(self.chairs)
        config = DatasetConfig(self.views, self.noisy, self.up, self.front, self.seed)
        with progress_bar("objects") as bar:
            task = bar.add_task("dataset", total=len(objects), note="")
            done = None
            for done in build_dataset(self.output, objects, config, workers=self.workers):
                note = f"{len(done.skipped)} skipped" if done.skipped else ""
                bar.update(task, completed=done.objects, note=note)
        _report_skipped(done.skipped if done else [])
        _require(
            done is None or len(done.skipped) < len(objects),
            f"None of the {len(objects)} meshes could be used; see the reasons above.",
        )


@dataclass(frozen=True)
class Train:
    dataset: Path
    """Folder made by `jaxshape dataset`."""
    output: Path
    """Folder for weights.safetensors, card.json, metrics.jsonl and the checkpoint."""
    steps: int = 6000
    """Batches."""
    batch: int = 32
    """Pairs in a batch."""
    learning_rate: float = 1e-3
    """Peak of Adam's step size; it decays along a cosine."""
    max_views: int = 18
    """Inputs fuse 1 to this many random views."""
    encoder: tuple[int, int, int, int] = (32, 64, 128, 256)
    """Channels of the encoder."""
    decoder: tuple[int, int, int] = (128, 64, 32)
    """Channels of the decoder."""
    code: int = 100
    """Numbers in a code."""
    bfloat16: bool = False
    """Compute convolutions in bfloat16; fast where the hardware has it."""
    report_every: int = 100
    """Steps between checkpoints; a killed run goes on from the last when asked for again."""
    seed: int = 0
    """Of the first weights and of the batches."""

    def run(self) -> None:
        from jaxshape.data.dataset import open_dataset
        from jaxshape.files import atomic_path
        from jaxshape.model.autoencoder import Architecture
        from jaxshape.model.training import TrainConfig, finished_prior, read_metrics, train
        from jaxshape.model.weights import save_prior

        config = TrainConfig(
            Architecture(self.encoder, self.decoder, self.code),
            self.steps,
            self.batch,
            self.learning_rate,
            self.max_views,
            self.bfloat16,
            self.report_every,
            self.seed,
        )
        data = open_dataset(self.dataset)
        with progress_bar("steps") as bar:
            task = bar.add_task("train", total=self.steps, note="compiling")
            for report in train(self.output, data, config):
                note = (
                    f"loss {report.loss:.4f}  IoU {report.iou:.3f}  "
                    f"{report.samples_per_second:.0f} samples/s"
                )
                bar.update(task, completed=report.step, note=note)
        metrics = read_metrics(self.output)
        card = {
            "data": json.loads((self.dataset / "dataset.json").read_text()),
            "command": " ".join(["jaxshape", *sys.argv[1:]]),
            "seed": self.seed,
            "samples": self.steps * self.batch,
            "training_loss": metrics[-1].loss,
            "training_iou": metrics[-1].iou,
            "training_seconds": round(sum(m.seconds for m in metrics)),
            "licence": "Apache-2.0",
        }
        prior = finished_prior(self.output, data, config)
        save_prior(self.output / "weights.safetensors", prior, card)
        with atomic_path(self.output / "card.json") as path:
            path.write_text(json.dumps(card, indent=2))
        print(f"wrote {self.output / 'weights.safetensors'}")


@dataclass(frozen=True, kw_only=True)
class Reconstruct(Rebuild):
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

        _require(self.every >= 1, f"--every is {self.every}; give 1 or more.")
        _require(self.min_hits >= 1, f"--min-hits is {self.min_hits}; give 1 or more.")
        prepared = self.prepare()
        sequence = open_sequence(self.frames, depth_scale=self.depth_scale)
        box = read_box(self.box) if self.box else None
        _require(
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


@dataclass(frozen=True)
class Evaluate:
    output: Path
    """JSON file for config, per_mesh and means."""
    meshes: Path | None = None
    """Mesh, archive (.zip, .sh3f) or folder of meshes; none should have been trained on."""
    chairs: int = 0
    """Procedural test chairs to use instead of --meshes."""
    frames: str = "1,4,8,18"
    """Numbers of frames to fuse, with commas: the first k of an orbit in steps of 20 degrees."""
    methods: str = "encoder,gradient,cma"
    """Methods to score, with commas; those of `jaxshape reconstruct --method`."""
    up: str = "y"
    """Axis of the meshes that points up: x, y, z, -x, -y or -z."""
    front: str = "z"
    """Axis of the meshes along which the object's front looks."""
    noise: bool = False
    """Add the faults of a real depth sensor."""
    weights: Path | None = None
    """Weights to use instead of those that come with the package."""
    search: tyro.conf.OmitArgPrefixes[RefineConfig] = RefineConfig()
    seed: int = 0
    """Of noise, surface samples and searches."""

    def run(self) -> None:
        start = time.perf_counter()
        from jaxshape.data.archives import list_meshes
        from jaxshape.data.dataset import TEST_SEEDS
        from jaxshape.data.meshes import Skipped, axes_to_canonical
        from jaxshape.files import atomic_path
        from jaxshape.model.weights import load_prior
        from jaxshape.results import evaluation

        frames = _numbers(self.frames, "--frames")
        config = evaluation.EvaluateConfig(
            frames, tuple(self.methods.split(",")), self.noise, _checked(self.search), self.seed
        )
        axes_to_canonical(self.up, self.front)
        _require(
            (self.meshes is None) != (self.chairs == 0) and self.chairs >= 0,
            "Give either --meshes PATH or --chairs NUMBER, to say what to evaluate on.",
        )
        test_seeds = range(TEST_SEEDS, TEST_SEEDS + self.chairs)
        sources = list_meshes(self.meshes) if self.meshes else test_seeds
        prior = load_prior(self.weights)
        evaluation.by_each_method(prior, config)  # refuses unknown methods before meshes are read
        models, skipped = _load_models(sources, self.up, self.front)
        settings = json.dumps(
            vars(self) | {"weights": evaluation.fingerprint(prior)}, default=str, sort_keys=True
        )
        per_mesh = evaluation.read_journal(self.output, settings)
        scored = {scores["name"] for scores in per_mesh}
        left = [model for model in models if model.name not in scored]
        with progress_bar("meshes") as bar:
            task = bar.add_task("evaluate", total=len(models), completed=len(scored), note="")
            for scores in evaluation.evaluate(prior, left, config):
                if isinstance(scores, Skipped):
                    skipped.append(scores)
                    _report_skipped([scores])
                else:
                    per_mesh.append(scores)
                    evaluation.write_journal(self.output, settings, per_mesh)
                bar.update(task, advance=1)
        _require(bool(per_mesh), "No mesh could be scored; see the reasons above.")
        means = evaluation.summarize(per_mesh, config)
        content = {
            "config": {
                **asdict(config),
                "meshes": str(self.meshes) if self.meshes else f"{self.chairs} procedural chairs",
                "weights": str(self.weights) if self.weights else "chair (packaged)",
                "seconds": round(time.perf_counter() - start, 1),
            },
            "skipped": [s._asdict() for s in skipped],
            "per_mesh": per_mesh,
            "means": means,
        }
        with atomic_path(self.output) as path:
            path.write_text(json.dumps(content, indent=1))
        evaluation.remove_journal(self.output)
        Console().print(_table(means, len(per_mesh)))


@dataclass(frozen=True)
class Plot:
    results: Positional[tuple[Path, ...]]
    """Folders made by `jaxshape reconstruct` or `jaxshape demo`; several are compared."""
    output: Path | None = None
    """Picture to write, .png, .svg or .pdf; trace.png in the (first) folder where not given."""

    def run(self) -> None:
        from jaxshape.results.plots import compare_searches, plot_search
        from jaxshape.results.traces import read_search

        _require(bool(self.results), "Give one result folder or more.")
        searches = [read_search(folder) for folder in self.results]
        output = self.output or self.results[0] / "trace.png"
        if len(searches) == 1:
            plot_search(output, searches[0])
        else:
            compare_searches(output, searches)
        print(f"wrote {output}")


# ------------------------------------------------------------------ shared by the commands


def _load_models(sources, up: str, front: str):
    """Load meshes, and refuse a set that seems to lie on its side."""
    from jaxshape.data.dataset import load_object
    from jaxshape.data.meshes import Skipped, lying_on_its_side

    with progress_bar("meshes") as bar:
        task = bar.add_task("read", note="")
        found = [load_object(s, up=up, front=front) for s in bar.track(sources, task_id=task)]
    skipped = [f for f in found if isinstance(f, Skipped)]
    models = [f for f in found if not isinstance(f, Skipped)]
    _report_skipped(skipped)
    _require(
        bool(models),
        f"None of the {len(sources)} meshes can be used; the first is {skipped[0].name!r}: "
        f"{skipped[0].reason}. {skipped[0].detail}"
        if skipped
        else "",
    )
    lying = [model.name for model in models if lying_on_its_side(model.mesh)]
    _require(
        2 * len(lying) <= len(models),
        f"{len(lying)} of {len(models)} meshes seem to lie on their side, {lying[:1]} for one; "
        "name the axis that points up, for example --up z --front -y.",
    )
    return models, skipped


def _checked(search: RefineConfig) -> RefineConfig:
    """The options of a search, once each is in its range."""
    inf = math.inf
    for name, is_fine, wanted in (
        ("iterations", search.iterations >= 1, "1 or more"),
        ("population", search.population >= 3, "3 or more"),
        ("sigma0", 0 < search.sigma0 < inf, "a number above 0"),
        ("step_size", search.step_size is None or 0 < search.step_size < inf, "a number above 0"),
        ("bound", search.bound is None or 0 < search.bound < inf, "a number above 0"),
        ("prior_weight", 0 <= search.prior_weight < inf, "0 or more"),
        ("tolerance", 0 <= search.tolerance < inf, "0 or more"),
        ("target", search.target is None or not math.isnan(search.target), "a number"),
    ):
        option, given = name.replace("_", "-"), getattr(search, name)
        _require(is_fine, f"--{option} is {given}; give {wanted}.")
    return search


def _report_skipped(skipped) -> None:
    for one in skipped:
        console.print(f"[yellow]skipped[/] {escape(one.name)}: {one.reason}. {escape(one.detail)}")


def _numbers(text: str, option: str) -> tuple[int, ...]:
    try:
        numbers = tuple(int(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    _require(
        bool(numbers) and min(numbers, default=0) >= 1 and len(set(numbers)) == len(numbers),
        f"{option} is {text!r}; give different whole numbers from 1 up, with commas, as in 1,4,8.",
    )
    return numbers


def _table(means: dict, count: int) -> Table:
    table = Table(title=f"means over {count} meshes", title_justify="left")
    for column in ("frames", "method", "IoU", "IoU composed", "Chamfer-L1", "F-score", "objective"):
        table.add_column(column, justify="left" if column == "method" else "right")
    for k, methods in means.items():
        for method, scores in methods.items():
            if method == "bounds":
                for name, value in scores.items():
                    table.add_row(k, name, f"{value:.3f}")
            else:
                table.add_row(k, method, *[f"{value:.3f}" for value in scores.values()])
    return table


def progress_bar(unit: str) -> Progress:
    """A bar with counts, the time left, and a free text."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn(unit),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
        console=console,
    )


class BadInput(ValueError):
    """An option cannot be used."""


def _require(condition: bool, sentence: str) -> None:
    if not condition:
        raise BadInput(sentence)


_Command = (
    Annotated[
        Demo,
        subcommand(
            "demo",
            description="Rebuild a procedural chair nobody trained on from a noisy orbit of depth "
            "frames, and compare with the truth.\n\nExample: jaxshape demo --seed 3",
        ),
    ]
    | Annotated[
        Dataset,
        subcommand(
            "dataset",
            description="Build training pairs: single views and complete surfaces, 4 KiB a grid."
            "\n\nExamples: jaxshape dataset --output data/chairs\n\n"
            "jaxshape dataset --output data/mugs --meshes mugs/ --up z --front -y",
        ),
    ]
    | Annotated[
        Train,
        subcommand(
            "train",
            description="Train the auto-encoder on a dataset; the same command resumes.\n\n"
            "Example: jaxshape train --dataset data/chairs --output out/train",
        ),
    ]
    | Annotated[
        Reconstruct,
        subcommand(
            "reconstruct",
            description="Rebuild an object from depth frames with known poses.\n\n"
            "Example: jaxshape reconstruct scan/ --box scan/box.json --every 5",
        ),
    ]
    | Annotated[
        Evaluate,
        subcommand(
            "evaluate",
            description="Score methods on meshes seen along an orbit at 30 degrees elevation."
            "\n\nExample: jaxshape evaluate --meshes chairs/ --frames 1,4,8,18 "
            "--methods encoder,gradient,cma --output scores.json",
        ),
    ]
    | Annotated[
        Plot,
        subcommand(
            "plot",
            description="Plot the search behind a result, or compare several.\n\n"
            "Examples: jaxshape plot out/demo\n\n"
            "jaxshape plot out/cma out/hybrid --output compare.svg",
        ),
    ]
)


def main() -> None:
    """Run the command line; the entry point of the console script."""
    warnings.showwarning = lambda message, *_, **__: console.print(f"[yellow]warning[/] {message}")
    command = tyro.cli(_Command, prog="jaxshape")  # pyright: ignore[reportArgumentType]
    prepare_process()
    try:
        command.run()
    except (ValueError, OSError) as problem:
        # Sentences for the user, by the convention of the package; anything else is a bug.
        console.print(f"[red]jaxshape:[/] {escape(str(problem))}", soft_wrap=True)
        sys.exit(2)
    except KeyboardInterrupt:
        console.print("stopped")
        sys.exit(130)


if __name__ == "__main__":
    main()
