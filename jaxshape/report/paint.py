"""The colours of a mesh: from the frames, or by measured and predicted parts."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, UInt8

from jaxshape.report.palette import COLORS
from jaxshape.report.pictures import rgb
from jaxshape.results.folder import ResultFolder


class Paint(NamedTuple):
    """Colours of the vertices of a mesh.

    Attributes:
        label: Text that names the colours.
        colors: A colour for each vertex.
    """

    label: str
    colors: UInt8[np.ndarray, "n 3"]


def paints(found: ResultFolder) -> dict[str, Paint]:
    """The colours in which the mesh of a result can be shown, by name; the first is shown first.

    Args:
        found: The result. Meshes of older results, and of points, have none of these colours.

    Returns:
        "color" where frames gave the mesh colours, "source" where it is known which vertices were
        measured, and "confidence" where the confidence of the vertices is known.
    """
    from matplotlib import colormaps  # it takes long to import

    there = {}
    if found.color is not None:
        there["color"] = Paint("colours of the frames", found.color)
    if found.measured is not None:
        colors = by_source(found.measured)
        there["source"] = Paint("measured (blue), predicted (orange)", colors)
    if found.confidence is not None:
        shades = (255 * colormaps["viridis"](found.confidence)[:, :3]).astype(np.uint8)
        there["confidence"] = Paint("how sure: 0 (violet) to 1 (yellow)", shades)
    return there


def by_source(measured: Bool[np.ndarray, " n"]) -> UInt8[np.ndarray, "n 3"]:
    """The colours of vertices: one for measured surface, one for predicted surface.

    Args:
        measured: Whether each vertex lies on the measured surface `[n]`.
    """
    blue, orange = (np.uint8(255 * rgb(COLORS[name])) for name in ("measured", "predicted"))
    return np.where(measured[:, None], blue, orange)
