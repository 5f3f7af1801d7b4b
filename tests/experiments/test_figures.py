"""Figures come in both formats, the same for the same drawing, and intervals hold the mean."""

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from figures import COLUMN, draw_mean, interval, save_column
from jaxshape.report.palette import BLUE

SAMPLES = np.random.default_rng(0).normal([0.0, 5.0], [1.0, 0.1], (200, 2))


def test_the_interval_is_that_of_the_normal_distribution_for_many_rows():
    low, high = interval(SAMPLES)
    error = 1.96 * SAMPLES.std(axis=0) / np.sqrt(len(SAMPLES))
    np.testing.assert_allclose(low, SAMPLES.mean(axis=0) - error, atol=0.15 * error.max())
    np.testing.assert_allclose(high, SAMPLES.mean(axis=0) + error, atol=0.15 * error.max())
    np.testing.assert_array_equal(interval(SAMPLES), interval(SAMPLES))


def test_a_single_row_and_equal_rows_have_no_spread():
    np.testing.assert_array_equal(interval(SAMPLES[:1]), [SAMPLES[0], SAMPLES[0]])
    np.testing.assert_allclose(interval(np.ones((5, 3))), 1)


def test_a_line_of_means_lies_in_its_band():
    axes = Figure().subplots()
    draw_mean(axes, [1, 2], SAMPLES, label="x", color=BLUE)
    (line,), (band,) = axes.lines, axes.collections
    np.testing.assert_allclose(line.get_ydata(), SAMPLES.mean(axis=0))
    heights = band.get_paths()[0].vertices[:, 1]
    assert heights.min() < line.get_ydata().min() and heights.max() > line.get_ydata().max()


def test_a_column_is_as_wide_as_a_column_and_reproducible(tmp_path):
    def draw(figure):
        figure.subplots().plot([1, 2, 3])

    save_column(tmp_path / "a", draw, height=2.0)
    save_column(tmp_path / "b", draw, height=2.0)
    with Image.open(tmp_path / "a.png") as image:
        assert image.size == (round(200 * COLUMN), 400)
    for suffix in (".png", ".svg"):
        ours, again = ((tmp_path / n).with_suffix(suffix).read_bytes() for n in "ab")
        assert ours == again
    assert b"<svg" in (tmp_path / "a.svg").read_bytes()
    with pytest.raises(ValueError):
        save_column(tmp_path / "c", lambda figure: figure.subplots(-1), height=2.0)
    assert not list(tmp_path.glob("c*"))
