"""The `jaxshape` command. [host]

Each subcommand is a frozen dataclass: its fields are its options, its docstring is its help, and
its `run` does the work. Bad input ends with one sentence on standard error and exit status 2, and
leaves earlier output as it was. JAX, and every module that needs it, is imported inside `run`, so
that `--help` starts quickly.

    rebuild    demo
    recording  reconstruct
    scene      scene
    completing complete
    inspecting inspect
    looking    next
    learning   dataset, train
    scoring    evaluate, plot
    benchmarking bench
    viewing    view
    doctor     doctor
"""

import io
import os
import sys
import warnings
from collections.abc import Sequence
from contextlib import nullcontext
from importlib.metadata import version
from typing import Annotated, Any

import tyro
from rich.markup import escape
from tyro.conf import subcommand

from jaxshape.claim import Output, claimed
from jaxshape.cli.benchmarking import Bench
from jaxshape.cli.common import console, warn
from jaxshape.cli.completing import Complete
from jaxshape.cli.doctor import Doctor
from jaxshape.cli.inspecting import Inspect
from jaxshape.cli.learning import BuildDataset, Train, preset_in
from jaxshape.cli.looking import NextView
from jaxshape.cli.options import RefusedSetting, refusing, reworded
from jaxshape.cli.rebuild import Demo
from jaxshape.cli.recording import Reconstruct
from jaxshape.cli.scene import BuildScene
from jaxshape.cli.scoring import Evaluate, Plot
from jaxshape.cli.viewing import ViewResult
from jaxshape.data.config import DATASETS
from jaxshape.files import OutputError
from jaxshape.model.config import PRESETS
from jaxshape.process import Terminated, prepare_process


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
        | Annotated[BuildScene, subcommand("scene")]
        | Annotated[Complete, subcommand("complete")]
        | Annotated[Inspect, subcommand("inspect")]
        | Annotated[NextView, subcommand("next")]
        | Annotated[Evaluate, subcommand("evaluate")]
        | Annotated[Plot, subcommand("plot")]
        | Annotated[Bench, subcommand("bench")]
        | Annotated[ViewResult, subcommand("view")]
        | Annotated[Doctor, subcommand("doctor")]
    )


def main() -> None:
    """Run the command line; the entry point of the console script."""
    sys.path.append("")  # the current folder may hold the user's own search
    warnings.showwarning = lambda message, *_, **__: warn(str(message))
    for stream in (sys.stdout, sys.stderr):  # file names may have characters outside the encoding
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    if sys.argv[1:] == ["--version"]:
        print(f"jaxshape {version('jaxshape')}")
        return
    table, output = commands(sys.argv[1:]), None
    try:
        command = tyro.cli(table, prog="jaxshape", registry=refusing())
        prepare_process()
        asked = getattr(command, "writes", None)
        with nullcontext() if asked is None else claimed(asked):
            output = asked
            command.run()
        sys.stdout.flush()
    except BrokenPipeError:  # the reader of a pipe has closed it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(141)
    except (RefusedSetting, ValueError, OSError, MemoryError) as problem:
        # By convention of the package these carry sentences for the user; other errors are bugs.
        console.print(f"[red]jaxshape:[/] {escape(_sentence(problem, output))}", soft_wrap=True)
        sys.exit(2)
    except KeyboardInterrupt as stop:
        kept = "" if output is None else f". {output.kept}"
        console.print(f"stopped{kept}", soft_wrap=True)
        sys.exit(143 if isinstance(stop, Terminated) else 130)


def _sentence(problem: Exception, output: Output | None) -> str:
    """The error as a sentence, with the files that are left."""
    if isinstance(problem, MemoryError):
        return "This machine does not have enough memory for this command."
    if isinstance(problem, OutputError):
        return str(problem) if output is None else f"{problem} {output.kept}"
    if isinstance(problem, OSError) and problem.strerror and problem.filename:
        return f"{str(problem.filename)!r} cannot be read or written: {problem.strerror.lower()}."
    return reworded(problem) if isinstance(problem, ValueError) else str(problem)
