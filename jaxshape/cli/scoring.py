"""`jaxshape evaluate` and `jaxshape plot`: the quality of results, and the course of a search."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console
from rich.table import Table
from tyro.conf import Positional

from jaxshape.claim import Output
from jaxshape.cli.collection import check_surveyed, find_meshes, turned, usable_of
from jaxshape.cli.common import progress_bar, report_skipped, require
from jaxshape.cli.options import Axes, Machines, Seen, checked_numbers
from jaxshape.data.config import FamilyName
from jaxshape.files import write_json
from jaxshape.search.config import RefineConfig

PATIENCE = 30 * 24 * 3600
"""Seconds that a finished process waits for the others, since shares of an evaluation differ."""


@dataclass(frozen=True)
class Evaluate:
    """Score methods on meshes that are viewed along an orbit at 30 degrees elevation.

    Example: jaxshape evaluate --meshes chairs/ --frames 1,4,8,18 --methods encoder,gradient,cma
    --output scores.json
    """

    output: Path
    """JSON file for config, per_mesh and means."""
    meshes: Path | None = None
    """Mesh, archive (.zip, .sh3f) or folder of meshes; none should be in the training set."""
    axes: tyro.conf.OmitArgPrefixes[Axes] = Axes()
    family: FamilyName = "chair"
    """Class of the objects. Without --weights, the network for chairs also rebuilds tables."""
    count: int = 0
    """Number of procedural test objects to use instead of --meshes."""
    frames: str = "1,4,8,18"
    """Numbers of frames to fuse, separated by commas: the first k of an orbit, 20 degrees apart."""
    methods: str = "encoder,gradient,cma"
    """Methods to score, separated by commas; the names are those of `jaxshape reconstruct
    --method`."""
    seen: tyro.conf.OmitArgPrefixes[Seen] = Seen()
    ceiling: bool = False
    """Also score the best shape that the decoder can reach: its code is fitted to the complete true
    surface."""
    weights: Path | None = None
    """Weights to use instead of those that come with the package."""
    search: tyro.conf.OmitArgPrefixes[RefineConfig] = RefineConfig()
    seed: int = 0
    """Seed of noise, surface samples and searches, 0 or more."""
    machines: tyro.conf.OmitArgPrefixes[Machines] = Machines()

    @property
    def writes(self) -> Output | None:
        """The output file; None with several processes, which share it."""
        return None if self.machines.asked else Output(self.output, is_file=True, goes_on=True)

    def run(self) -> None:
        self.machines.join(patience=PATIENCE)
        import jax

        from jaxshape.data.families import TEST_SEEDS, procedural_objects
        from jaxshape.model.weights import load_prior, packaged_for
        from jaxshape.results import evaluation
        from jaxshape.results.journal import Share

        config = evaluation.EvaluateConfig(
            frames=checked_numbers(self.frames, "--frames"),
            methods=tuple(self.methods.split(",")),
            **asdict(self.seen.config()),
            ceiling=self.ceiling,
            refine=self.search,
            seed=self.seed,
        )
        require(
            (self.meshes is None) != (self.count == 0) and 0 <= self.count <= TEST_SEEDS,
            "Give either --meshes PATH or --count NUMBER, to say what to evaluate on.",
        )
        procedural = procedural_objects(self.family, self.count, TEST_SEEDS)
        sources: Any = find_meshes(self.meshes) if self.meshes else procedural
        packaged = packaged_for(self.family)
        prior = load_prior(self.weights or packaged)
        evaluation.by_each_method(prior, config)  # refuse unknown methods before meshes are read
        share = Share(jax.process_index(), jax.process_count())
        names = [source.name for source in sources]
        mine, digests, skipped = share.of(sources), {}, []
        if self.meshes:
            mine = turned(mine, self.axes, prior)
            usable, skipped = usable_of(mine, self.axes, alone=share.count == 1)
            mine, digests = [one.source for one in usable], digests_of(usable)
            if self.family == "chair":  # refuse seats that lie on their side, and warn of others
                check_surveyed(usable, self.axes, prior=prior, refuse=self.weights is None)
        about = {
            "meshes": str(self.meshes or f"{self.count} procedural {self.family}s"),
            **asdict(self.axes),
            "weights": str(self.weights) if self.weights else f"{packaged} (packaged)",
        }
        score(self.output, prior, config, about, mine, self.axes, digests, skipped, names, share)


def digests_of(usable: Sequence[Any]) -> dict[str, str]:
    """Digest of the files of each mesh, by its name, from a survey of usable meshes."""
    return {one.source.name: one.digest for one in usable}


def score(
    output: Path,
    prior: Any,
    config: Any,
    about: dict[str, Any],
    objects: Sequence[Any],
    axes: Axes,
    digests: Mapping[str, str],
    skipped: Sequence[Any] = (),
    names: Sequence[str] | None = None,
    share: Any = None,
) -> dict[str, Any] | None:
    """Score objects, write the results file, print its table; returns the content of the file.

    `config` is an `EvaluateConfig`; `about` holds the origin of meshes and weights. A killed
    evaluation resumes when it is started again with the same weights and settings; meshes whose
    digests have changed are scored anew. Several processes each score their share of all `names`;
    the last to finish reads the rows of the others and writes the file, and the others return None.
    `share` is a `Share`; None for a single process.
    """
    start = time.perf_counter()
    from jaxshape.data.dataset import LoadedWhenNeeded
    from jaxshape.data.meshes import Skipped
    from jaxshape.model.weights import fingerprint
    from jaxshape.results import evaluation
    from jaxshape.results.journal import Share, journals_of

    resolved = {"noise": config.is_noisy, "fusion": config.fused_by}
    settings = asdict(config) | resolved | about
    stamp = settings | {"fingerprint": fingerprint(prior)}
    names = [one.name for one in (*objects, *skipped)] if names is None else names
    for earlier in journals_of(output, stamp):  # drop rows of files that have changed since
        earlier.forget({one.name: digests.get(one.name, "") for one in objects})
    journal = (share or Share()).journal(output, stamp)
    scored = {name for name, row in _rows(output, stamp).items() if "skipped" not in row}
    left = [one for one in objects if one.name not in scored]
    models = LoadedWhenNeeded(left, up=axes.up, front=axes.front, unit=axes.unit)
    unseen = []
    if skipped:
        journal.add({one.name: {"skipped": one._asdict()} for one in skipped}, 0.0)
    with progress_bar("meshes") as bar:
        completed = len(objects) - len(left)
        task = bar.add_task("evaluate", total=len(objects), completed=completed, note="")
        for scores in evaluation.evaluate(prior, models, config):
            if isinstance(scores, Skipped):
                unseen.append(scores)
                row = {scores.name: {"skipped": scores._asdict()}}
            else:
                row = {scores["name"]: scores}
            journal.add(row, time.perf_counter() - start)
            start = time.perf_counter()
            bar.update(task, advance=1)
    report_skipped(unseen)
    seconds, rows = sum(one.seconds for one in journals_of(output, stamp)), _rows(output, stamp)
    if missing := [name for name in names if name not in rows]:
        print(
            f"{len(missing)} meshes are left to the other processes; the last one writes {output}."
        )
        return None
    per_mesh = [rows[name] for name in names if "skipped" not in rows[name]]
    content = {
        "config": settings | {"seconds": round(seconds, 1)},
        "skipped": [rows[name]["skipped"] for name in names if "skipped" in rows[name]],
        "per_mesh": per_mesh,
        "means": evaluation.summarize(per_mesh, config) if per_mesh else {},
    }
    if per_mesh:
        write_json(output, content)
    for one in journals_of(output, stamp):
        one.remove()
    require(bool(per_mesh), "No mesh could be scored; see the reasons above.")
    _print_table(content["means"], len(per_mesh))
    return content


def _rows(output: Path, stamp: dict[str, Any]) -> dict[str, Any]:
    """The rows of all processes so far; a score replaces an earlier reason to skip a mesh."""
    from jaxshape.results.journal import journals_of

    found = [row for one in journals_of(output, stamp) for row in one.rows.items()]
    return dict(sorted(found, key=lambda row: "skipped" not in row[1]))


def _print_table(means: dict[str, Any], count: int) -> None:
    from jaxshape.report.card import COLUMNS, rows_of

    title, padding = f"means over {count} meshes", (0, 1, 0, 0)  # fits into 80 columns
    table = Table(title=title, title_justify="left", box=None, padding=padding, pad_edge=False)
    for column in COLUMNS:
        named = column == "method"
        header = column.replace("-L1", "-\nL1")
        table.add_column(header, justify="left" if named else "right", no_wrap=named)
    for row in rows_of(means):
        table.add_row(*row)
    Console().print(table)


@dataclass(frozen=True)
class Plot:
    """Plot the search of a result, or compare several.

    Examples: jaxshape plot out/demo

    jaxshape plot out/cma out/hybrid --output compare.svg
    """

    results: Positional[tuple[Path, ...]]
    """Folders made by `jaxshape reconstruct` or `jaxshape demo`; several are compared."""
    output: Path | None = None
    """Picture to write, .png, .svg or .pdf; trace.png in the (first) folder by default."""

    @property
    def writes(self) -> Output | None:
        """The output file; None if it goes into the folder of an existing result."""
        return None if self.output is None else Output(self.output, is_file=True)

    def run(self) -> None:
        from jaxshape.report.plots import compare_searches, plot_search
        from jaxshape.results.traces import read_search

        require(bool(self.results), "Give one result folder or more.")
        searches = [read_search(folder) for folder in self.results]
        output = self.output or self.results[0] / "trace.png"
        if len(searches) == 1:
            plot_search(output, searches[0])
        else:
            compare_searches(output, searches)
        print(f"wrote {output}")
