"""What all figures share: size, palette, lines for searches, means with intervals, formats. [host]

Colours are the palette of Okabe and Ito, which the common kinds of colour blindness keep apart;
lines differ in their dashes as well.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Num

from jaxshape.files import atomic_path

COLUMN, PAGE = 3.5, 7.0
"""Widths in inches: of a column of a paper, and of a page."""

BLUE, ORANGE, GREEN, PINK = "#0072B2", "#E69F00", "#009E73", "#CC79A7"
SKY, RED, GREY = "#56B4E9", "#D55E00", "#8C949B"
INK, FAINT = "#2B2F33", "#E3E6E8"
CYCLE = (BLUE, ORANGE, GREEN, PINK, SKY, RED)

LINES: dict[str, dict[str, Any]] = {
    "encoder": {"color": INK, "dashes": (1, 1.2)},
    "CMA-ES": {"color": BLUE, "dashes": ()},
    "gradient descent": {"color": ORANGE, "dashes": (4, 1.5)},
    "Adam": {"color": GREEN, "dashes": (6, 1.5, 1, 1.5)},
    "CMA-ES, composed": {"color": SKY, "dashes": ()},
    "F, occluded empty": {"color": GREY, "dashes": ()},
    "F, occluded full": {"color": GREY, "dashes": (2, 2)},
}
"""How the same thing is drawn in every figure."""


def interval(samples: Num[np.ndarray, "n ..."]) -> Float[np.ndarray, "2 ..."]:
    """The 95 % interval of the mean over the rows, by bootstrap over the rows.

    A single row has no spread: both ends are that row.
    """
    from scipy.stats import bootstrap

    if len(samples) == 1:
        return np.stack([samples[0], samples[0]])
    found = bootstrap(
        (samples,), np.mean, axis=0, vectorized=True, method="percentile",
        n_resamples=2000, batch=200, rng=np.random.default_rng(0),
    )  # fmt: skip
    return np.stack([found.confidence_interval.low, found.confidence_interval.high])


def draw_mean(
    axes: Any, x: Any, samples: Float[np.ndarray, "n k"], *, label: str = "", **line: Any
) -> None:
    """Draw the mean over the rows as a line, with its 95 % interval as a band."""
    low, high = interval(samples)
    axes.fill_between(x, low, high, color=line["color"], alpha=0.18, linewidth=0)
    axes.plot(x, samples.mean(axis=0), label=label, **line)


def tidy(axes: Any) -> None:
    """A faint grid, no frame, and numbers on logarithmic axes that span less than two decades."""
    from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, NullLocator

    axes.grid(color=FAINT, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.margins(x=0.02)
    if axes.get_yscale() == "log":
        low, high = axes.get_ylim()
        axes.yaxis.set_minor_formatter(NullFormatter())
        if high < 100 * low:  # too few powers of ten to tell where one is
            narrow, wide = MaxNLocator(5, steps=[1, 2, 5, 10]), LogLocator(subs=(1, 2, 5))
            axes.yaxis.set_major_locator(narrow if high < 10 * low else wide)
            axes.yaxis.set_major_formatter("{x:g}")
            axes.yaxis.set_minor_locator(NullLocator())


def save_figure(
    path: str | Path, size: tuple[float, float], draw: Callable[[Any], None], *, font: float = 10.0
) -> None:
    """Write a figure of a size in inches, in the format that the suffix names.

    The same drawing gives the same file.
    """
    # Slow to import, and only pictures need it.
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    style: dict[Any, Any] = {
        "font.size": font,
        "axes.titlesize": font,
        "legend.fontsize": 0.9 * font,
        "text.color": INK,
        "axes.edgecolor": INK,
        "svg.hashsalt": "jaxshape",
    }
    undated = {"Date": None} if Path(path).suffix == ".svg" else {}
    with rc_context(style), atomic_path(path) as temporary:
        figure = Figure(figsize=size, dpi=200, layout="constrained")
        draw(figure)
        figure.savefig(temporary, metadata=undated)


def save_column(
    stem: Path, draw: Callable[[Any], None], *, height: float, width: float = COLUMN
) -> None:
    """Write a figure for a column of a paper (or a page), as `stem`.png and `stem`.svg."""
    for suffix in (".png", ".svg"):
        save_figure(stem.with_suffix(suffix), (width, height), draw, font=8.0)
