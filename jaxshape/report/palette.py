"""The colours of all figures and their meanings.

They are the palette of Okabe and Ito, which the common kinds of colour blindness keep apart.
"""

from typing import NamedTuple

BLUE, ORANGE, GREEN, PINK = "#0072B2", "#E69F00", "#009E73", "#CC79A7"
SKY, RED, GREY = "#56B4E9", "#D55E00", "#8C949B"
INK, FAINT = "#2B2F33", "#E3E6E8"
FOG, PALE = "#B4BBC2", "#F1F3F4"
CYCLE = (BLUE, ORANGE, GREEN, PINK, SKY, RED)

COLORS = {"measured": BLUE, "predicted": ORANGE, "truth": GREEN, "occluded": FOG}
"""Colours of voxels and meshes."""

STATUS_COLORS = {
    "keyframe": BLUE,
    "tracked": SKY,
    "lost": RED,
    "unreadable": PINK,
}
"""Colours of the frames of a recording, by status."""


class Layer(NamedTuple):
    """Name and look of one part of a scene in 3D.

    Attributes:
        label: Text that names the layer.
        color: Colour as `#rrggbb`.
        shown: Whether it is shown at first.
    """

    label: str
    color: str
    shown: bool


LAYERS = {
    "mesh": Layer("mesh", COLORS["predicted"], True),
    "occupied": Layer("measured (F)", COLORS["measured"], False),
    "occluded": Layer("occluded (M)", COLORS["occluded"], False),
    "encoder": Layer("prior (encoder)", PINK, False),
    "refined": Layer("refined", RED, False),
    "composed": Layer("composed", SKY, False),
    "truth": Layer("truth", COLORS["truth"], False),
    "cameras": Layer("keyframes", INK, True),
    "trajectory": Layer("trajectory", COLORS["measured"], True),
    "objects": Layer("objects", GREEN, True),
}
"""Everything of a result that can be shown in 3D."""
