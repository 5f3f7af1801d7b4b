"""Common parts of the figures of the experiments: size, lines for searches, means with intervals.

Lines differ in their dashes as well as in their colours.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Num

from jaxshape.files import atomic_path
from jaxshape.report.figures import save_figure, tidy
from jaxshape.report.palette import BLUE, GREEN, GREY, INK, ORANGE, SKY

COLUMN, PAGE = 3.5, 7.0
"""Width of a column of a paper, and of a page, in inches."""

LINES: dict[str, dict[str, Any]] = {
    "encoder": {"color": INK, "dashes": (1, 1.2)},
    "CMA-ES": {"color": BLUE, "dashes": ()},
    "gradient descent": {"color": ORANGE, "dashes": (4, 1.5)},
    "Adam": {"color": GREEN, "dashes": (6, 1.5, 1, 1.5)},
    "CMA-ES, composed": {"color": SKY, "dashes": ()},
    "F, occluded empty": {"color": GREY, "dashes": ()},
    "F, occluded full": {"color": GREY, "dashes": (2, 2)},
}
"""Line style of each search or bound, the same in every figure."""


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


def number_axis(axes: Any, numbers: Sequence[int], **labels: Any) -> None:
    """A logarithmic horizontal axis with these numbers alone, such as numbers of frames."""
    axes.set(xscale="log", **labels)
    axes.set_xticks(numbers, [str(k) for k in numbers])
    axes.minorticks_off()
    tidy(axes)


class Sheet:
    """A figure that is laid out by hand: lengths are in inches from its upper left corner."""

    def __init__(self, figure: Any):
        figure.set_layout_engine("none")
        self.figure = figure
        self.width, self.height = figure.get_size_inches()

    def text(self, x: float, y: float, content: Any, **style: Any) -> None:
        """A text whose middle lies at a place."""
        style = {"ha": "center", "va": "center"} | style
        self.figure.text(x / self.width, 1 - y / self.height, str(content), **style)

    def axes(self, left: float, top: float, width: float, height: float) -> Any:
        """Bare axes at a place."""
        w, h = self.width, self.height
        axes = self.figure.add_axes((left / w, 1 - (top + height) / h, width / w, height / h))
        axes.axis("off")
        return axes

    def show(self, left: float, top: float, width: float, height: float, image: Any) -> None:
        """A picture at a place."""
        self.axes(left, top, width, height).imshow(image, interpolation="antialiased")


def save_column(
    stem: Path, draw: Callable[[Any], None], *, height: float, width: float = COLUMN
) -> None:
    """Write a figure for a column of a paper (or a page), as `stem`.png and `stem`.svg."""
    for suffix in (".png", ".svg"):
        save_figure(stem.with_suffix(suffix), (width, height), draw, font=8.0)


@contextmanager
def drawn(path: Path, width: float, height: float, dpi: int = 150) -> Iterator[Any]:
    """A figure in inches with the usual fonts, written as a PNG when it is complete."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    yield figure
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=dpi, format="png")
