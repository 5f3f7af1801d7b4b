"""Our CMA-ES on COCO's 24 noiseless functions, against pycma with the same budget.

    python -m benchmarks.coco --quick
    python -m benchmarks.coco --budget 2000 --dimensions 2,3,5,10
    python -m benchmarks.coco --budget 1000 --dimensions 20,40

The last two found what is stored, in about an hour of one core. Set OPENBLAS_NUM_THREADS=1: threads
slow down pycma's matrices, which are small.

Both search from the same points with the same step size and restart with doubled populations from
fresh points (Hansen et al., "COCO: a platform for comparing continuous optimizers in a black-box
setting", 2021). Ours is the shipped refiner, the 15 instances of a function as one batch, restarts
inside the compiled loop. What counts are evaluations, not time.

Needs `pip install "jaxshape[bench]"`. A run that was stopped goes on where it was.
"""

import contextlib
import itertools
import json
import re
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cma
import cocoex
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import tyro
from jaxtyping import Float
from matplotlib.figure import Figure
from scipy.stats import fisher_exact

from jaxshape.files import write_json, write_text
from jaxshape.report.palette import BLUE, ORANGE
from jaxshape.search.refiner import StopReason, advance
from jaxshape.search.restarts import with_restarts

TARGETS = np.logspace(2, -8, 51)
"""Distances to the lowest value; the last one counts as solved."""
INSTANCES = 15
SIGMA0, RADIUS = 2.0, 4.0
"""Step size of every run, and half the side of the cube its start is drawn from."""
STEPS = 100
"""Iterations in one call of the compiled loop."""
GROUPS = {
    "separable": range(1, 6),
    "moderate": range(6, 10),
    "ill-conditioned": range(10, 15),
    "multi-modal": range(15, 20),
    "weak structure": range(20, 25),
}
RESULTS = Path(__file__).parent / "results"

ALGORITHMS = ("ours", "pycma")
FUNCTIONS = range(1, 25)
STYLES = {
    "pycma": {"color": ORANGE, "linewidth": 3},
    "ours": {"color": BLUE, "linewidth": 1.2},
}

Restarts = Literal["ipop", "bipop"]

Results = dict[str, dict[str, Any]]
"""Of a dimension: `budget`, and by algorithm and function the evaluations at which each target was
reached, a list for each instance."""


@dataclass(frozen=True)
class Options:
    """Compare our CMA-ES with pycma on COCO's bbob suite."""

    dimensions: str = "2,3,5,10,20,40"
    functions: str = "1-24"
    budget: int = 1000
    """Evaluations per instance, in multiples of the dimension."""
    restarts: Restarts = "ipop"
    quick: bool = False
    """A budget of 300, and results in the work folder only."""
    work: Path = Path("out/coco")
    """Where finished functions are kept, one file each."""


# ------------------------------------------------------------------ one problem


class Finished(Exception):
    """The problem is solved, or the budget spent."""


class Recorder:
    """A problem that counts its evaluations and notes when each target was first reached."""

    def __init__(self, problem: cocoex.Problem, budget: int):
        self.problem, self.budget = problem, budget
        self.lowest, self.evaluations = _lowest(problem), 0
        self.runtimes: list[int] = []

    def __call__(self, point: Float[np.ndarray, " d"]) -> float:
        if self.finished:
            raise Finished
        value = self.problem(point)
        self.evaluations += 1
        while not self.solved and value - self.lowest <= TARGETS[len(self.runtimes)]:
            self.runtimes.append(self.evaluations)
        return value

    @property
    def solved(self) -> bool:
        return len(self.runtimes) == len(TARGETS)

    @property
    def finished(self) -> bool:
        return self.solved or self.evaluations >= self.budget


def _lowest(problem: cocoex.Problem) -> float:
    """The lowest value of a problem, which the package tells by way of a file only."""
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        problem._best_parameter("print")
        value = problem(np.loadtxt("._bbob_problem_best_parameter.txt"))
    return round(value, 2)  # it is a whole number of hundredths by construction


def instances(function: int, dimension: int, budget: int) -> list[Recorder]:
    """The instances of a function, each with `budget` evaluations per dimension."""
    chosen = f"dimensions: {dimension} function_indices: {function}"
    suite = cocoex.Suite("bbob", f"instances: 1-{INSTANCES}", chosen)
    return [Recorder(suite.get_problem(i), budget * dimension) for i in range(len(suite))]


# ------------------------------------------------------------------ two algorithms

Search = Callable[[list[Recorder]], None]
"""Minimises the instances of one function."""


def pycma(restarts: Restarts) -> Search:
    """pycma, on one instance after the other."""

    def search(recorders):
        for recorder in recorders:
            points = _starts(recorder.problem)
            options = {"seed": _seed(recorder.problem), "verbose": -9, "verb_log": 0}
            with contextlib.suppress(Finished):
                bipop = restarts == "bipop"
                cma.fmin2(recorder, points.__next__, SIGMA0, options, restarts=9, bipop=bipop)

    return search


def ours(dimension: int, restarts: Restarts) -> Search:
    """Our CMA-ES, with the instances as one batch; compiled at its first call."""

    def restart_point(key, first):
        return jax.random.uniform(key, first.shape, first.dtype, -RADIUS, RADIUS)

    refiner = with_restarts(restarts, dim=dimension, sigma0=SIGMA0, restart_point=restart_point)
    problems: list[Recorder] = []  # those that the compiled loop evaluates

    def losses(points):
        return np.array(
            [_evaluate(*pair) for pair in zip(problems, np.asarray(points), strict=True)]
        )

    def objective(point):
        shape = jax.ShapeDtypeStruct((), point.dtype)
        return jax.pure_callback(losses, shape, point, vmap_method="broadcast_all")

    def move(key, state, trace, number):
        """One iteration of one instance."""
        return advance(refiner, jax.random.fold_in(key, number), state, trace, objective)

    @jax.jit
    def iterate(keys, now, numbers):
        def move_all(now, number):
            return jax.vmap(move, (0, 0, 0, None))(keys, *now, number), None

        return jax.lax.scan(move_all, now, numbers)[0]

    def search(recorders):
        problems[:] = recorders
        keys = jax.vmap(jax.random.key)(jnp.array([_seed(r.problem) for r in recorders]))
        points = jnp.array([next(_starts(r.problem)) for r in recorders])
        unknown = jnp.full_like(points[:, 0], jnp.inf)
        now = jax.jit(jax.vmap(refiner.init))(keys, points, unknown)
        for step in itertools.count(0, STEPS):
            now = iterate(keys, now, jnp.arange(step, step + STEPS))
            stopped = np.asarray(now[0].stop) != StopReason.RUNNING
            if all(r.finished or s for r, s in zip(recorders, stopped, strict=True)):
                break

    return search


def _seed(problem: cocoex.Problem) -> int:
    """One for each problem, a hundred apart since pycma adds 1 at a restart."""
    return 100 * (100 * (100 * problem.id_function + problem.id_instance) + problem.dimension)


def _starts(problem: cocoex.Problem) -> Iterator[Float[np.ndarray, " d"]]:
    """The points that runs begin at; both algorithms share the first."""
    rng = np.random.default_rng(_seed(problem))
    while True:
        yield rng.uniform(-RADIUS, RADIUS, problem.dimension)


def _evaluate(recorder: Recorder, points: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
    """Values of some candidates; NaN for those not to be evaluated, or no longer."""
    values = np.full(len(points), np.nan)
    if np.isfinite(points).all():
        with contextlib.suppress(Finished):
            for i, point in enumerate(points):
                values[i] = recorder(point)
    return values


# ------------------------------------------------------------------ the run


def run(options: Options) -> Results:
    """Measure both algorithms; what is in the work folder is not measured again."""
    kind, budget = options.restarts, 300 if options.quick else options.budget
    found: Results = {}
    for dimension in numbers(options.dimensions):
        searches = {"ours": ours(dimension, kind), "pycma": pycma(kind)}
        found[str(dimension)] = cells = {"budget": budget, **{name: {} for name in searches}}
        for function, name in itertools.product(numbers(options.functions), searches):
            file = options.work / f"{name}_{kind}_{budget}_d{dimension:02}_f{function:02}.json"
            if not file.exists():
                print(f"{name:5}  d {dimension:2}  f {function:2}: ", end="", flush=True)
                reached = _measure(searches[name], instances(function, dimension, budget))
                write_json(file, reached)
            cells[name][str(function)] = json.loads(file.read_text())
    return found


def _measure(search: Search, recorders: list[Recorder]) -> list[list[int]]:
    """Runtimes of the instances of one function, with a line that tells of them."""
    start = time.perf_counter()
    search(recorders)
    solved, early = sum(r.solved for r in recorders), sum(not r.finished for r in recorders)
    note = f", {early} gave up before the budget was spent" if early else ""
    print(f"{solved:2} solved, {time.perf_counter() - start:6.1f} s{note}", flush=True)
    return [r.runtimes for r in recorders]


def numbers(text: str) -> list[int]:
    """The numbers of a list such as 1-5,8."""
    ranges = [[int(end) for end in part.split("-")] for part in text.split(",")]
    return [n for ends in ranges for n in range(ends[0], ends[-1] + 1)]


# ------------------------------------------------------------------ what it shows


def store(found: Results, folder: Path, name: str) -> Results:
    """Write runtimes, figure and table, together with the dimensions that were stored before."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f"{name}.json"
    earlier = json.loads(file.read_text()) if file.exists() else {}
    results = dict(sorted((earlier | found).items(), key=lambda item: int(item[0])))
    write_text(file, _compact(results))
    write_text(folder / f"{name}.md", report(results))
    figure = draw(results)
    for suffix in ("png", "svg"):
        figure.savefig(folder / f"{name}.{suffix}", dpi=200)
    plt.close(figure)
    return results


def _compact(results: Results) -> str:
    """JSON with a line for each function."""
    text = json.dumps(results, separators=(",", ":"))
    return re.sub(r'("\d+":\[\[)', r"\n\1", text) + "\n"


def runtimes(
    results: Results, algorithm: str, dimensions: Iterable[str], functions: Iterable[int]
) -> Float[np.ndarray, "instance target"]:
    """Evaluations per dimension until each target was reached; +inf where it was not."""
    rows = [
        np.pad(np.array(reached) / int(d), (0, len(TARGETS) - len(reached)), constant_values=np.inf)
        for d in dimensions
        for f in functions
        for reached in results[d][algorithm].get(str(f), [])
    ]
    return np.array(rows).reshape(-1, len(TARGETS))


def solved(results: Results, algorithm: str, dimensions: Iterable[str], function: int) -> int:
    """Instances of a function of which the last target was reached."""
    return int(np.isfinite(runtimes(results, algorithm, dimensions, [function])[:, -1]).sum())


def ecdf_area(times: Float[np.ndarray, "instance target"], budget: float) -> float:
    """Mean height of the ECDF between 1 and `budget` evaluations per dimension, log scale."""
    left = 1 - np.log10(np.clip(times, 1, budget)) / np.log10(budget)
    return float(left.mean())


def expected_evaluations(
    times: Float[np.ndarray, "instance target"], budget: float
) -> Float[np.ndarray, " target"]:
    """All evaluations spent on a target over the times it was reached: COCO's average runtime."""
    reached = np.isfinite(times).sum(axis=0)
    return np.where(reached, np.minimum(times, budget).sum(axis=0) / np.maximum(reached, 1), np.inf)


def effort(results: Results, dimension: str) -> float:
    """Our evaluations over pycma's: the geometric mean over targets that both reached."""
    budget, logs = results[dimension]["budget"], []
    for function in FUNCTIONS:
        both = [runtimes(results, a, [dimension], [function]) for a in ALGORITHMS]
        mine, theirs = (expected_evaluations(times, budget)[::5] for times in both)
        shared = np.isfinite(mine) & np.isfinite(theirs)
        logs += list(np.log(mine[shared] / theirs[shared]))
    return float(np.exp(np.mean(logs)))


def violations(results: Results) -> list[str]:
    """Functions of which we solve a third fewer instances than pycma, and how likely by chance."""
    found = []
    for function in FUNCTIONS:
        mine, theirs = (solved(results, a, results, function) for a in ALGORITHMS)
        if mine < theirs and mine <= 2 / 3 * theirs:
            chance = _chance(mine, theirs, INSTANCES * len(results))
            found.append(f"f{function} ({mine} : {theirs}, p = {chance:.2f})")
    return found


def _chance(mine: int, theirs: int, instances: int) -> float:
    """How likely two equal algorithms differ as much as that: Fisher's exact test."""
    test: Any = fisher_exact([[n, instances - n] for n in (mine, theirs)])
    return float(test.pvalue)


def report(results: Results) -> str:
    """What was found, as Markdown."""
    head = ["function", *(f"d = {d}" for d in results)]
    rows = []
    for group, functions in GROUPS.items():
        rows.append([f"*{group}*"] + [""] * len(results))
        rows += [[f"f{f}", *(_cell(results, d, f) for d in results)] for f in functions]
    sums = {
        d: [sum(solved(results, a, [d], f) for f in FUNCTIONS) for a in ALGORITHMS] for d in results
    }
    areas = {
        a: [ecdf_area(runtimes(results, a, [d], FUNCTIONS), results[d]["budget"]) for d in results]
        for a in ALGORITHMS
    }
    rows += [
        ["**solved**", *("{} : {}".format(*sums[d]) for d in results)],
        *([f"ECDF area, {a}", *(f"{x:.3f}" for x in areas[a])] for a in ALGORITHMS),
        ["evaluations, ours / pycma", *(f"{effort(results, d):.2f}" for d in results)],
        ["budget / d", *(str(results[d]["budget"]) for d in results)],
    ]
    table = [head, ["---"] * len(head), *rows]
    worse = violations(results)
    return _INTRODUCTION.format(
        instances=INSTANCES,
        precision=TARGETS[-1],
        pycma=cma.__version__,
        coco=cocoex.__version__,
        table="\n".join("| " + " | ".join(row) + " |" for row in table),
        verdict="none" if not worse else ", ".join(worse),
    )


_INTRODUCTION = """# CMA-ES on COCO's bbob suite

Instances solved of {instances} (precision {precision:g}), ours : pycma. Bold where the two differ
by more than chance would explain (Fisher's exact test, p < 0.01). Made by `benchmarks/coco.py` with
pycma {pycma} and coco-experiment {coco}.

At a restart pycma doubles 4 + 3 ln d before rounding (8, 17, 35 for d = 5), ours after (8, 16, 32).

{table}

*ECDF area*: mean height of the curves in the figure, 1 if all targets were reached at once.
*Evaluations*: average runtime of ours over that of pycma, geometric mean over the targets that both
reached.

Functions of which ours solves a third fewer instances than pycma: {verdict}.
"""


def _cell(results: Results, dimension: str, function: int) -> str:
    """Instances solved by both, bold where they differ by more than chance."""
    if str(function) not in results[dimension]["ours"]:
        return ""
    mine, theirs = (solved(results, a, [dimension], function) for a in ALGORITHMS)
    differ = _chance(mine, theirs, INSTANCES) < 0.01
    return f"**{mine} : {theirs}**" if differ else f"{mine} : {theirs}"


def draw(results: Results) -> Figure:
    """ECDFs of runtimes over all targets, for each dimension and for each group of functions."""
    smallest = min(r["budget"] for r in results.values())
    panels = [(f"d = {d}", [d], FUNCTIONS, r["budget"]) for d, r in results.items()]
    measured = set().union(*(map(int, r["ours"]) for r in results.values()))
    panels += [(g, list(results), fs, smallest) for g, fs in GROUPS.items() if measured & set(fs)]
    figure, axes = plt.subplots(
        3, 4, figsize=(7.2, 5.2), sharex=True, sharey=True, layout="constrained"
    )
    for axis, (title, dimensions, functions, budget) in zip(axes.flat, panels, strict=False):
        x = np.geomspace(1, budget, 200)
        for algorithm, style in STYLES.items():
            times = runtimes(results, algorithm, dimensions, functions)
            axis.plot(x, [(times <= limit).mean() for limit in x], label=algorithm, **style)
        axis.set_title(title, fontsize=9)
        axis.set(xscale="log", xlim=(1, None), ylim=(0, 1))
        axis.set_xticks([1, 10, 100, 1000])
        axis.tick_params(labelsize=8, labelbottom=True)
        axis.grid(alpha=0.3)
    for axis in axes.flat[len(panels) :]:
        axis.axis("off")
    axes.flat[-1].legend(*axes.flat[0].get_legend_handles_labels(), loc="center", frameon=False)
    figure.supxlabel("evaluations / dimension", fontsize=9)
    figure.supylabel("fraction of targets reached", fontsize=9)
    return figure


def main(options: Options) -> None:
    """Run, store and say what was found; only a run of all functions replaces the stored one."""
    found = run(options)
    whole = not options.quick and numbers(options.functions) == list(FUNCTIONS)
    name = "coco" if options.restarts == "ipop" else f"coco_{options.restarts}"
    folder = RESULTS if whole else options.work
    print(report(store(found, folder, name)))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main(tyro.cli(Options, prog="python -m benchmarks.coco"))
