"""`jaxshape bench`: compare searches on a frozen set of problems, and draw their board."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from jaxshape.bench.config import FRAMES, KINDS, BenchConfig, KindName
from jaxshape.claim import Output
from jaxshape.cli.common import console, progress_bar, require
from jaxshape.cli.options import checked_numbers


@dataclass(frozen=True)
class Bench:
    """Compare searches on the frozen problems of the benchmark; docs/benchmark.md has the rules.

    Examples: jaxshape bench --methods cma,gradient:adam,evosax:Sep_CMA_ES,mine:build --output board

    jaxshape bench --methods cma --part 2/4 --output board

    jaxshape bench --methods "" --output board
    """

    methods: str = "cma,gradient:adam"
    """Searches, separated by commas: the names that `jaxshape reconstruct --method` takes, pycma,
    nevergrad:NAME, or your own MODULE:FUNCTION. Empty to draw the board and run nothing."""
    output: Path = Path("board")
    """Folder for one file for each method, and for board.md, board.png and board.html. Existing
    results are kept, and not computed again."""
    objects: int | None = None
    """Number of objects, starting with the first of the set; by default all."""
    frames: str = ",".join(map(str, FRAMES))
    """Numbers of fused frames, separated by commas, among 1, 4 and 8."""
    kinds: tuple[KindName, ...] = KINDS
    """Depth without noise (clean), and with a Kinect's noise (noisy)."""
    part: str = "1/1"
    """Run only part I of N of the problems, for one of N machines; put the files of all parts into
    one folder."""
    search: tyro.conf.OmitArgPrefixes[BenchConfig] = BenchConfig()
    check: bool = False
    """Run no searches; validate the results in the folder by computing their objectives again."""

    @property
    def writes(self) -> Output | None:
        """The output folder; the parts of a board may be made at the same time."""
        if self.check:
            return None
        i, n = _part(self.part)
        part = self.output / f"part-{i}-of-{n}"
        return Output(part if n > 1 else self.output, is_file=n > 1, goes_on=True)

    def run(self) -> None:
        from jaxshape.bench.entries import read_entries
        from jaxshape.bench.problem_set import packaged_set
        from jaxshape.bench.problems import problems
        from jaxshape.bench.standings import standings

        frames, (i, n) = checked_numbers(self.frames, "--frames"), _part(self.part)
        if self.check:
            _check(self.output)
            return
        methods = [name for name in self.methods.split(",") if name]
        if methods:
            self._search(
                methods, problems(objects=self.objects, frames=frames, kinds=self.kinds)[i - 1 :: n]
            )
        entries, found = read_entries(self.output.glob("*.json")), packaged_set()
        require(bool(entries), f"There are no results in {str(self.output)!r}; name --methods.")
        _board(self.output, standings(entries, found.best), found)

    def _search(self, methods: list[str], chosen: list[Any]) -> None:
        from jaxshape.bench.run import run

        part = "" if self.part == "1/1" else self.part
        with progress_bar("problems") as bar:
            tasks: dict[str, Any] = {}
            for now in run(methods, chosen, self.search, self.output, part=part):
                if now.name not in tasks:
                    tasks[now.name] = bar.add_task(escape(now.name), total=now.total, note="")
                bar.update(tasks[now.name], completed=now.done)


def _part(text: str) -> tuple[int, int]:
    """I and N of the option I/N."""
    numbers = text.split("/")
    right = len(numbers) == 2 and all(x.isdecimal() for x in numbers)
    i, n = map(int, numbers) if right else (0, 0)
    require(1 <= i <= n, f"--part is {text!r}; give I/N, as 1/4 for the first of four.")
    return i, n


def _check(folder: Path) -> None:
    """Print the faults of the results in a folder."""
    from jaxshape.bench.entries import faults, read_entries
    from jaxshape.bench.problems import problems

    entries, every = read_entries(folder.glob("*.json")), problems()
    require(bool(entries), f"There are no results in {str(folder)!r}.")
    found = {entry.about["name"]: faults(entry, every) for entry in entries}
    for entry in entries:
        name = entry.about["name"]
        said = " ".join(found[name][:5]) or f"valid, {len(entry.rows)} of {len(every)} problems"
        Console().print(f"{escape(name)}: {escape(said)}", soft_wrap=True)
    wrong = [name for name, said in found.items() if said]
    require(not wrong, f"{len(wrong)} of {len(entries)} entries are not valid.")


def _board(folder: Path, found: Any, problem_set: Any) -> None:
    from jaxshape.bench.board import write_board
    from jaxshape.bench.standings import COLUMNS, conditions, headings, table

    write_board(folder, found, problem_set)
    shown = Table(title=f"{len(found[0].calls)} problems", box=None, padding=(0, 1, 0, 0))
    kept = [i for i, column in enumerate(COLUMNS) if column not in ("IoU targets", "stopped by")]
    for i in kept:  # these fit into 80 columns
        header = headings("\n")[i]
        shown.add_column(header, justify="right" if i else "left", no_wrap=True)
    for row in table(found):
        shown.add_row(*(escape(row[i]) for i in kept))
    Console().print(shown)
    for sentence in conditions(found):
        console.print(escape(sentence), soft_wrap=True)
    print(f"wrote board.md, board.png and board.html in {folder}")
