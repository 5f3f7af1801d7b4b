"""Plots of searches: losses and the distribution over iterations, as pycma draws them."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from jaxshape.report.figures import save_figure, tidy
from jaxshape.report.palette import BLUE, CYCLE, GREEN, INK, ORANGE
from jaxshape.results.traces import Search, restarts
from jaxshape.search.refiner import Distribution, Trace

SUFFIXES = (".png", ".svg", ".pdf")


def plot_search(path: str | Path, search: Search) -> None:
    """Plot one search over the objectives it evaluated: a panel for each part of its trace.

    The panels are: the distance of the losses to the lowest of all (gaps are the lowest itself);
    step size and ratio of the axes; the standard deviation of every coordinate; the lengths of the
    principal axes. Without a distribution, the spread of the candidates takes the place of the last
    three. Dashed lines are restarts.

    Args:
        path: The picture to write, `.png`, `.svg` or `.pdf`.
        search: The search.

    Raises:
        ValueError: The suffix is another one, or the search ended before its first iteration.
    """
    trace = search.trace
    evaluations, normal = trace.evaluations, trace.distribution
    panels: list[Callable[[Any], None]] = [lambda axes: _losses(axes, trace)]
    if normal is not None:
        deviations, lengths = normal.standard_deviations, normal.axis_lengths
        panels += [
            lambda axes: _step_size(axes, evaluations, normal),
            lambda axes: _bundle(axes, "standard deviations", evaluations, deviations),
            lambda axes: _bundle(axes, "lengths of the principal axes", evaluations, lengths),
        ]
    elif np.any(trace.spread > 0):
        panels.append(lambda axes: _spread(axes, trace))
    again = restarts(trace)

    def draw(figure: Any) -> None:
        rows, columns = -(-len(panels) // 2), min(2, len(panels))
        grid = figure.subplots(rows, columns, sharex=True, squeeze=False)
        for axes, panel in zip(grid.flat, panels, strict=True):
            panel(axes)
            axes.set_yscale("log")
            tidy(axes)
            for iteration in again:
                axes.axvline(evaluations[iteration], color=INK, linewidth=0.8, dashes=(4, 3))
        for axes in grid[-1]:
            axes.set_xlabel("evaluations")
        figure.suptitle(_heading(search, len(again)), fontsize=10, color=INK)

    size = {1: (4.4, 3.4), 2: (5.8, 3.0), 4: (5.8, 5.0)}[len(panels)]
    _save(path, size, [search], draw)


def compare_searches(path: str | Path, searches: Sequence[Search]) -> None:
    """Plot the lowest loss so far of several searches over the objectives they evaluated.

    Args:
        path: The picture to write, `.png`, `.svg` or `.pdf`.
        searches: The searches, one or more.

    Raises:
        ValueError: The suffix is another one, or a search ended before its first iteration.
    """

    def draw(figure: Any) -> None:
        axes = figure.subplots()
        for search, color in zip(searches, _cycle(searches), strict=True):
            label = f"{search.name} ({search.result.get('method', '?')})"
            trace = search.trace
            axes.step(
                trace.evaluations, trace.best_loss, where="post", color=color, label=label, lw=1.8
            )
            axes.plot(trace.evaluations[-1], trace.best_loss[-1], "o", color=color, markersize=5)
        axes.set_yscale("log")
        axes.set_xlabel("evaluations")
        axes.set_title("lowest objective so far")
        tidy(axes)
        axes.legend(frameon=False)

    _save(path, (5.6, 4.0), searches, draw)


# ------------------------------------------------------------------ the panels of one search


def _losses(axes: Any, trace: Trace) -> None:
    lowest = float(min(trace.loss.min(), trace.best_loss.min()))
    of_iteration = _above(trace.loss, lowest)
    axes.plot(trace.evaluations, of_iteration, color=ORANGE, lw=0.9, label="of the iteration")
    axes.plot(trace.evaluations, _above(trace.best_loss, lowest), color=BLUE, lw=1.8, label="best")
    axes.set_title(f"objective above the lowest, {lowest:.4f}")
    axes.legend(frameon=False)


def _above(losses: Float[Array | np.ndarray, " n"], lowest: float) -> Float[np.ndarray, " n"]:
    """The excess over the lowest loss; NaN where a logarithmic axis cannot show it."""
    excess = np.asarray(losses, np.float64) - lowest
    return np.where((excess > 0) & np.isfinite(excess), excess, np.nan)


def _step_size(axes: Any, evaluations: Any, normal: Distribution) -> None:
    ratio = normal.axis_lengths[:, -1] / normal.axis_lengths[:, 0]
    axes.plot(evaluations, normal.sigma, color=GREEN, lw=1.8, label="sigma")
    axes.plot(evaluations, ratio, color=ORANGE, lw=1.8, label="axis ratio")
    axes.set_title("step size and axis ratio")
    axes.legend(frameon=False)


def _bundle(axes: Any, title: str, evaluations: Any, values: Any) -> None:
    """A line for each column, from dark to light in the order of the last values."""
    from matplotlib import colormaps

    order = np.argsort(np.argsort(values[-1]))
    for column, place in zip(values.T, order, strict=True):
        color = colormaps["viridis"](0.9 * place / max(1, len(order) - 1))
        axes.plot(evaluations, column, color=color, linewidth=0.7)
    axes.set_title(title)


def _spread(axes: Any, trace: Trace) -> None:
    axes.plot(trace.evaluations, trace.spread, color=GREEN, lw=1.8)
    axes.set_title("spread of the candidates")


def _heading(search: Search, restarts: int) -> str:
    result, trace = search.result, search.trace
    again = f", {restarts} restart{'s' * (restarts > 1)}" if restarts else ""
    return (
        f"{result.get('method', '?')} stopped by {result.get('stop', '?')}\n"
        f"objective {result['objective_encoder']:.4f} to {result['objective_refined']:.4f}\n"
        f"{len(trace.loss)} iterations, {trace.evaluations[-1]} evaluations{again}"
    )


# ------------------------------------------------------------------ shared by the plots


def _cycle(lines: Any) -> list[str]:
    return [CYCLE[i % len(CYCLE)] for i in range(len(lines))]


def _save(
    path: str | Path,
    size: tuple[float, float],
    searches: Sequence[Search],
    draw: Callable[[Any], None],
) -> None:
    """Write a figure of a size in inches, in the format that the suffix names."""
    if Path(path).suffix.lower() not in SUFFIXES:
        raise ValueError(
            f"A plot is written as one of {', '.join(SUFFIXES)}, but {str(path)!r} ends in "
            f"{Path(path).suffix or 'no suffix'!r}."
        )
    for search in searches:
        if len(search.trace.loss) == 0:
            raise ValueError(f"The search of {search.name!r} ended before its first iteration.")
    save_figure(path, size, draw)
