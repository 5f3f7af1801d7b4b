"""The common style of all plots, and reproducible files. [host]"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxshape.files import atomic_path
from jaxshape.report.palette import FAINT, INK


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
