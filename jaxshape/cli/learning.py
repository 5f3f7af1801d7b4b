"""`jaxshape dataset` and `jaxshape train`: from objects to a shape prior."""

import os
import re
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import tyro

from jaxshape import checks, limits
from jaxshape.claim import Output
from jaxshape.cli.collection import (
    SAMPLE,
    check_surveyed,
    find_meshes,
    look_at,
    turned,
)
from jaxshape.cli.common import console, progress_bar, report_notes, report_skipped, require
from jaxshape.cli.options import Axes, AxesName, Machines
from jaxshape.cli.scoring import digests_of, score
from jaxshape.data.config import DatasetConfig, FamilyName
from jaxshape.files import write_json, write_text
from jaxshape.model.config import TrainConfig
from jaxshape.process import spread_over_cores
from jaxshape.reading import read_json_object
from jaxshape.search.config import RefineConfig

OWN_MESHES = DatasetConfig(paths=4)
"""Settings of the dataset of a folder of meshes: there are few meshes, so each gets more paths."""

PROCESSORS = os.cpu_count() or 1

Preset = Literal["default", "paper"]
TrainingPreset = Literal["default", "autoencoder", "paper"]


@dataclass(frozen=True)
class BuildDataset:
    """Build training pairs: measurements along camera paths around objects, and complete surfaces.

    Examples: jaxshape dataset --output data/chairs

    jaxshape dataset --family table --count 2000

    jaxshape dataset --output data/mugs --meshes mugs/ --up z --front -y

    jaxshape dataset --output data/paper --preset paper
    """

    output: Path | None = None
    """Folder of the dataset; by default data/chairs or data/tables, or data/NAME for --meshes NAME.
    The same command resumes a build that was killed."""
    family: FamilyName = "chair"
    """Procedural objects to make, unless --meshes is given."""
    count: int = 8000
    """Number of objects."""
    meshes: Path | None = None
    """Mesh, archive or folder (ShapeNet, ModelNet, ...) to use instead of procedural objects."""
    preset: Preset = "default"
    """Defaults of the options below: the best that we found, or the paper's 18 clean single views;
    `jaxshape dataset --preset paper --help` shows the latter."""
    axes: AxesName = "given"
    """`given` uses --up and --front for all meshes, and warns if they seem wrong; `auto` turns each
    seat upright and to the front."""
    config: tyro.conf.OmitArgPrefixes[DatasetConfig] = DatasetConfig()
    workers: int = PROCESSORS
    """Processes that work at the same time, 1 to 256."""

    def __post_init__(self) -> None:
        checks.whole("workers", self.workers, 1, limits.WORKERS, "each takes 0.3 GB")

    @property
    def folder(self) -> Path:
        """Folder of the dataset."""
        name = self.meshes.stem if self.meshes else f"{self.family}s"
        return self.output or Path("data") / name

    @property
    def writes(self) -> Output:
        """The output folder."""
        return Output(self.folder, goes_on=True, needs=max(limits.FREE_BYTES, self._missing()))

    def _missing(self) -> int:
        """Bytes of the procedural objects that are still missing; meshes are counted later."""
        if self.meshes is not None:
            return 0
        voxels, paths = self.config.resolution**3, self.config.paths
        whole = self.count * paths * (voxels // 8 + len(self.config.frames) * voxels)
        return whole - sum(path.stat().st_size for path in self.folder.glob("shard-*.npy"))

    def run(self) -> None:
        from jaxshape.data.families import TEST_SEEDS, procedural_objects

        require(1 <= self.count <= TEST_SEEDS, f"--count is {self.count}; give 1 to 1000000.")
        objects: Sequence[Any] = (
            self.find(self.meshes) if self.meshes else procedural_objects(self.family, self.count)
        )
        build(self.folder, objects, self.config, self.workers)

    def find(self, meshes: Path) -> Sequence[Any]:
        """The meshes; a sample of them is checked for unit and axes."""
        from jaxshape.data.survey import evenly

        config = self.config
        axes = Axes(up=config.up, front=config.front, axes=self.axes, unit=config.unit)
        sources = find_meshes(meshes)
        usable = [one for one in look_at(evenly(sources, SAMPLE), axes) if one.skipped is None]
        check_surveyed(usable, axes)
        return turned(sources, axes)


def build(folder: Path, objects: Sequence[Any], config: DatasetConfig, workers: int) -> None:
    """Build a dataset, or only its missing shards, with a progress bar."""
    from jaxshape.data import building

    skipped, notes = [], []
    with progress_bar("objects") as bar:
        task = bar.add_task("dataset", total=len(objects), note="")
        for done in building.build_dataset(folder, objects, config, workers=workers):
            skipped, notes = done.skipped, done.notes
            note = f"{len(skipped)} skipped" if skipped else ""
            bar.update(task, completed=done.objects, note=note)
    report_skipped(skipped)
    report_notes(notes)
    require(
        len(skipped) < len(objects),
        f"None of the {len(objects)} meshes could be used; see the reasons above.",
    )


def preset_in(arguments: Sequence[str]) -> TrainingPreset:
    """The value of --preset, which selects defaults of other options of `dataset` and `train`."""

    @dataclass(frozen=True)
    class Asked:
        preset: TrainingPreset = "default"

    asked, _ = tyro.cli(
        Asked, prog="jaxshape", args=arguments, return_unknown_args=True, add_help=False
    )
    return asked.preset


@dataclass(frozen=True)
class Train:
    """Train a shape prior on a dataset, or on a folder of meshes; the same command resumes.

    Examples: jaxshape train --dataset data/chairs --output out/train

    jaxshape train --meshes mugs/ --name mug --up z --front -y

    jaxshape train --dataset data/chairs --model pca

    With --meshes, about every tenth mesh is kept out of training and scored afterwards.
    """

    dataset: Path | None = None
    """Folder made by `jaxshape dataset`."""
    meshes: Path | None = None
    """Mesh archive or folder (ShapeNet, ModelNet, ...) to train on instead of --dataset."""
    axes: tyro.conf.OmitArgPrefixes[Axes] = Axes()
    name: str = "weights"
    """Name of the weights file and of its card; with --meshes, the kind of object."""
    output: Path | None = None
    """Folder for NAME.safetensors, NAME.md, card.json, metrics.jsonl and the checkpoint, and with
    --meshes also for the dataset and evaluation.json; out/NAME by default."""
    start: Path | None = None
    """Initial weights, of a network of the same sizes: a file, or `chair` for those of the package;
    random by default."""
    licence: str = "not stated"
    """Licence of the weights, for their card; the licence of the meshes may restrict it."""
    model: Literal["network", "pca"] = "network"
    """A network, or principal components of the complete surfaces: an inexpensive baseline, made in
    seconds, whose only settings are the size of --code and --seed."""
    preset: TrainingPreset = "default"
    """Network, and defaults of the options below: the network conditioned on the measurement, the
    paper's auto-encoder with our best settings, or the paper's own training;
    `jaxshape train --preset paper --help` shows the latter."""
    config: tyro.conf.OmitArgPrefixes[tyro.conf.AvoidSubcommands[TrainConfig]] = TrainConfig()
    machines: tyro.conf.OmitArgPrefixes[Machines] = Machines()

    @property
    def folder(self) -> Path:
        """Folder of the run."""
        return self.output or Path("out") / self.name

    @property
    def writes(self) -> Output | None:
        """The output folder; None with several processes, of which only the first writes."""
        return None if self.machines.asked else Output(self.folder, goes_on=True)

    def run(self) -> None:
        if not self.machines.asked:
            spread_over_cores(self.config.batch)
        from jaxshape.data.dataset import open_dataset
        from jaxshape.model.weights import load_prior

        require(
            (self.dataset is None) != (self.meshes is None),
            "Give either --dataset FOLDER or --meshes FOLDER, to say what to train on.",
        )
        require(
            re.fullmatch(r"\w[\w.-]*", self.name) is not None,
            f"--name is {self.name!r}; give a plain name, such as mug.",
        )
        self.machines.join()
        output = self.folder
        start = load_prior(self.start) if self.start else None
        folder, held_out = self.dataset, None
        if folder is None:
            folder, held_out = self.build(output)
        data = open_dataset(folder)
        prior = self.fit(output, data, start)
        if prior is not None:
            about = read_json_object(folder / "dataset.json")
            about |= {"source": str(self.meshes or self.dataset), "used": len(data.names)}
            self.write(output, prior, about, held_out)

    def fit(self, output: Path, data: Any, start: Any) -> Any:
        """The trained prior; None in all processes except the one that writes it."""
        if self.model == "pca":
            from jaxshape.data.dataset import surfaces
            from jaxshape.model.pca import fit

            return fit(surfaces(data), self.config.architecture.code, self.config.seed)
        from jaxshape.model.training import finished_prior, validation_batch
        from jaxshape.search.calibrating import fit_calibration

        if not _fit(output, data, self.config, start):
            return None
        prior, kept = finished_prior(output, data, self.config), validation_batch(data, self.config)
        if kept is None:
            return prior
        with console.status("calibrating probabilities"):
            return prior._replace(calibration=fit_calibration(prior, kept.grids, kept.surface))

    def build(self, output: Path) -> tuple[Path, list[Any]]:
        """Build a dataset of --meshes; returns its folder, and the held-out meshes (`Surveyed`)."""
        import jax

        from jaxshape.data.split import hold_out

        assert self.meshes is not None
        require(
            jax.process_count() == 1,
            "Several processes cannot build one dataset; make it first with jaxshape dataset "
            "--meshes, and give its folder as --dataset.",
        )
        sources = turned(find_meshes(self.meshes), self.axes)
        found = look_at(sources, self.axes)
        training, held_out = hold_out(found)
        check_surveyed([one for one in found if one.skipped is None], self.axes)
        config = replace(
            OWN_MESHES,
            up=self.axes.up,
            front=self.axes.front,
            unit=self.axes.unit,
            resolution=self.config.architecture.resolution,
            seed=self.config.seed,
        )
        build(output / "dataset", training, config, PROCESSORS)
        return output / "dataset", held_out

    def write(self, output: Path, prior: Any, about: dict[str, Any], held_out: Any) -> None:
        """Write the weights and cards of a finished run, and score it on the held-out meshes."""
        from jaxshape.model.weights import load_prior, save_prior
        from jaxshape.report.card import describe
        from jaxshape.results.evaluation import EvaluateConfig
        from jaxshape.search.reconstruction import usual_method

        card = self.card(output, about)
        weights = output / f"{self.name}.safetensors"
        save_prior(weights, prior, card)
        write_json(output / "card.json", card)
        scores = None
        if held_out:
            config = EvaluateConfig(
                methods=tuple(dict.fromkeys(("encoder", usual_method(prior)))),
                refine=RefineConfig(iterations=50),
                seed=self.config.seed,
            )
            settings = {"meshes": f"held out of {self.meshes}", "weights": str(weights)}
            prior = load_prior(weights)  # as users load it: in half precision
            objects, digests = [one.source for one in held_out], digests_of(held_out)
            where = output / "evaluation.json"
            scores = score(where, prior, config, settings, objects, self.axes, digests)
        write_text(output / f"{self.name}.md", describe(self.name, card, scores))
        print(f"wrote {weights} and its card, {self.name}.md")

    def card(self, output: Path, about: dict[str, Any]) -> dict[str, Any]:
        """The model card."""
        from jaxshape.model.training import read_metrics
        from jaxshape.report.card import basis_card, training_card

        given = {
            "command": shlex.join(["jaxshape", *sys.argv[1:]]),
            "licence": self.licence,
        }
        if self.model == "pca":
            return basis_card(self.config, about, **given)
        return training_card(self.config, read_metrics(output), about, start=self.start, **given)


def _fit(output: Path, data: Any, config: TrainConfig, start: Any) -> bool:
    """Train with a progress bar; returns whether this process is the one that writes."""
    import jax

    from jaxshape.model.training import read_metrics, train

    console.quiet = jax.process_index() > 0
    done = max((report.step for report in read_metrics(output)), default=0)
    note = "compiling" if done < config.steps else ""
    with progress_bar("steps") as bar:
        task = bar.add_task("train", total=config.steps, completed=done, note=note)
        for report in train(output, data, config, start):
            note = (
                f"loss {report.loss:.4f}  IoU {report.iou:.3f}  "
                f"{report.samples_per_second:.0f} samples/s"
            )
            bar.update(task, completed=report.step, note=note)
    return jax.process_index() == 0
