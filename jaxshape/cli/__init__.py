"""The `jaxshape` command. [host]

Each subcommand is a frozen dataclass: its fields are its options, its docstring is its help, and
its `run` does the work. Bad input ends with one sentence on standard error and exit status 2, and
leaves earlier output as it was. JAX, and all that needs it, is imported inside `run`, so that
`--help` answers at once.

    rebuild    demo
    recording  reconstruct
    completing complete
    inspecting inspect
    learning   dataset, train
    scoring    evaluate, plot
    benchmarking  bench
    viewing    view
"""

import sys
import warnings
from collections.abc import Sequence
from typing import Annotated, Any

import tyro
from rich.markup import escape
from tyro.conf import subcommand

from jaxshape.cli.benchmarking import Bench
from jaxshape.cli.common import console
from jaxshape.cli.completing import Complete
from jaxshape.cli.inspecting import Inspect
from jaxshape.cli.learning import BuildDataset, Train, preset_in
from jaxshape.cli.options import RefusedSetting, refusing, reworded
from jaxshape.cli.rebuild import Demo
from jaxshape.cli.recording import Reconstruct
from jaxshape.cli.scoring import Evaluate, Plot
from jaxshape.cli.viewing import ViewResult
from jaxshape.data.config import DATASETS
from jaxshape.model.config import PRESETS
from jaxshape.process import prepare_process


def commands(arguments: Sequence[str]) -> Any:
    """The table of commands; --preset decides the defaults of `dataset` and `train`."""
    preset = preset_in(arguments)
    dataset = BuildDataset(config=DATASETS.get(preset, DATASETS["default"]))
    train = Train(config=PRESETS[preset])
    return (
        Annotated[Demo, subcommand("demo")]
        | Annotated[BuildDataset, subcommand("dataset", default=dataset)]
        | Annotated[Train, subcommand("train", default=train)]
        | Annotated[Reconstruct, subcommand("reconstruct")]
        | Annotated[Complete, subcommand("complete")]
        | Annotated[Inspect, subcommand("inspect")]
        | Annotated[Evaluate, subcommand("evaluate")]
        | Annotated[Plot, subcommand("plot")]
        | Annotated[Bench, subcommand("bench")]
        | Annotated[ViewResult, subcommand("view")]
    )


def main() -> None:
    """Run the command line; the entry point of the console script."""
    sys.path.append("")  # the current folder may hold a search of the user's own
    warnings.showwarning = lambda message, *_, **__: console.print(f"[yellow]warning[/] {message}")
    table = commands(sys.argv[1:])
    try:
        command = tyro.cli(table, prog="jaxshape", registry=refusing())
        prepare_process()
        command.run()
    except (RefusedSetting, ValueError, OSError) as problem:
        # Sentences for the user, by the convention of the package; anything else is a bug.
        said = reworded(problem) if isinstance(problem, ValueError) else str(problem)
        console.print(f"[red]jaxshape:[/] {escape(said)}", soft_wrap=True)
        sys.exit(2)
    except KeyboardInterrupt:
        console.print("stopped")
        sys.exit(130)
