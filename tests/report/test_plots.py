"""Plots show what the traces hold, in a file of the format asked for."""

import subprocess
import sys

import numpy as np
import pytest
from matplotlib.figure import Figure

from jaxshape.report import plots
from jaxshape.report.plots import compare_searches, plot_search
from jaxshape.results.traces import Search
from jaxshape.search.refiner import Distribution, Trace

N, DIM = 20, 4
EVALUATIONS = 1 + 8 * np.arange(1, N + 1)
RESULT = {"method": "cma", "stop": "tolx", "objective_encoder": 1.0, "objective_refined": 0.25}


def make_search(*, drawn=True, spread=0.1):
    """Losses halve; the axes spread apart, and are equal again after half of the iterations."""
    loss = 0.25 + 0.5 ** np.arange(N)
    loss[3] = np.inf
    stretch = np.linspace(1, 3, DIM) ** (np.arange(N)[:, None] % (N // 2))
    sigma = np.full(N, 0.5)
    shape = Distribution(sigma, sigma[:, None] * stretch[:, ::-1], sigma[:, None] * stretch)
    best, spreads = np.minimum.accumulate(loss), np.full(N, spread)
    trace = Trace(best, loss, spreads, EVALUATIONS, shape if drawn else None)
    return Search("demo", trace, RESULT)


@pytest.fixture
def drawn_by(monkeypatch):
    """The figure that a plot draws, in place of the file."""

    def drawn_by(plot, *arguments):
        figure = Figure()
        monkeypatch.setattr(plots, "_save", lambda path, size, searches, draw: draw(figure))
        plot("unused.png", *arguments)
        return figure

    return drawn_by


def test_a_population_has_four_panels_over_its_evaluations(drawn_by):
    search = make_search()
    figure = drawn_by(plot_search, search)
    losses, step, deviations, lengths = figure.axes
    shape = search.trace.distribution
    assert all(axes.get_yscale() == "log" for axes in figure.axes)
    for axes in figure.axes:
        np.testing.assert_array_equal(axes.lines[0].get_xdata(), EVALUATIONS)
    sigma, ratio = (line.get_ydata() for line in step.lines[:2])
    np.testing.assert_array_equal(sigma, shape.sigma)
    np.testing.assert_allclose(ratio, shape.axis_lengths[:, -1] / shape.axis_lengths[:, 0])
    for axes, values in ((deviations, shape.standard_deviations), (lengths, shape.axis_lengths)):
        shown = np.stack([line.get_ydata() for line in axes.lines[:DIM]], axis=1)
        np.testing.assert_array_equal(shown, values)
    heading = figure.get_suptitle()
    assert "cma stopped by tolx" in heading and "1.0000 to 0.2500" in heading
    assert f"{N} iterations, {EVALUATIONS[-1]} evaluations, 1 restart" in heading


def test_losses_are_shown_above_the_lowest_where_a_logarithm_can(drawn_by):
    search = make_search()
    of_iteration, best = (
        line.get_ydata() for line in drawn_by(plot_search, search).axes[0].lines[:2]
    )
    excess = search.trace.loss - search.trace.loss.min()
    is_shown = np.isfinite(excess) & (excess > 0)
    assert not is_shown[3] and not is_shown[-1]
    np.testing.assert_array_equal(np.isfinite(of_iteration), is_shown)
    np.testing.assert_allclose(of_iteration[is_shown], excess[is_shown])
    assert np.isfinite(best[3]) and np.isnan(best[-1])


def test_restarts_are_marked_in_every_panel(drawn_by):
    for axes in drawn_by(plot_search, make_search()).axes:
        assert axes.lines[-1].get_xdata()[0] == EVALUATIONS[N // 2]


@pytest.mark.parametrize("spread, panels", [(0.1, 2), (0.0, 1)])
def test_without_a_distribution_there_are_losses_and_spread_if_any(drawn_by, spread, panels):
    search = make_search(drawn=False, spread=spread)
    first, *others = drawn_by(plot_search, search).axes
    np.testing.assert_array_equal(first.lines[0].get_xdata(), EVALUATIONS)
    assert len(others) == panels - 1
    for axes in others:
        np.testing.assert_allclose(axes.lines[0].get_ydata(), search.trace.spread)


def test_a_comparison_has_a_line_for_each_search(drawn_by):
    searches = [make_search(), make_search(drawn=False)._replace(name="other")]
    (axes,) = drawn_by(compare_searches, searches).axes
    assert [text.get_text() for text in axes.get_legend().texts] == ["demo (cma)", "other (cma)"]
    for line, search in zip(axes.lines[::2], searches, strict=True):
        np.testing.assert_array_equal(line.get_ydata(), search.trace.best_loss)


@pytest.mark.parametrize(
    "suffix, start", [(".png", b"\x89PNG"), (".svg", b"<?xml"), (".PDF", b"%P")]
)
def test_the_suffix_names_the_format(tmp_path, suffix, start):
    path = tmp_path / "new" / f"trace{suffix}"
    plot_search(path, make_search(drawn=False))
    assert path.read_bytes().startswith(start)
    assert [file.name for file in path.parent.iterdir()] == [path.name]


def test_what_cannot_be_plotted_is_refused_and_nothing_written(tmp_path):
    with pytest.raises(ValueError, match=r"\.png, \.svg, \.pdf.*\.txt"):
        plot_search(tmp_path / "trace.txt", make_search())
    search = make_search(drawn=False)
    empty = search._replace(trace=Trace(*(x[:0] for x in search.trace[:4])))
    for plot in (plot_search, lambda path, one: compare_searches(path, [search, one])):
        with pytest.raises(ValueError, match="ended before its first iteration"):
            plot(tmp_path / "trace.png", empty)
    assert not list(tmp_path.iterdir())


def test_the_same_search_gives_the_same_picture(tmp_path):
    for name in ("first.png", "second.png"):
        plot_search(tmp_path / name, make_search())
    first, second = (path.read_bytes() for path in sorted(tmp_path.iterdir()))
    assert first == second


def test_importing_the_module_leaves_matplotlib_alone():
    code = "import sys, jaxshape.report.plots; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
