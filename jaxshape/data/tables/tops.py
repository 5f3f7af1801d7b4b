"""Table tops: boards of many outlines, planks, trays, glass in a frame, and rails under them."""

import numpy as np

from jaxshape.data.procedural.boards import Board, apron, outline_of, slats
from jaxshape.data.procedural.draw import Draw, Number, Range, Weights
from jaxshape.data.procedural.primitives import Part, bars, cushion, plate, polygon, tubes

ANY_OUTLINE = {"rectangle": 0.62, "square": 0.1, "round": 0.16, "oval": 0.12}
PLAIN_TOPS = {"board": 0.66, "block": 0.1, "planks": 0.06, "glazed": 0.06, "tray": 0.06,
              "wavy": 0.03, "polygon": 0.03}  # fmt: skip


def draw_top(
    draw: Draw,
    *,
    width: Range,
    depth: Range,
    height: Range,
    outlines: Weights = ANY_OUTLINE,
) -> Board:
    """A top within the given ranges; square and round ones have sides between the two."""
    outline = draw.named("outline", outlines)
    across = draw.between(*width)
    deep = min(draw.between(*depth), across)
    if outline in ("square", "round"):
        across = deep = draw.between(depth[0], min(1.3 * depth[1], width[1]))
    if outline == "round":
        exponent = 2.0
    elif outline == "oval":
        exponent, deep = draw.between(2.0, 2.5), min(deep, 0.85 * across)
    else:
        exponent = draw.between(4.0, 12.0) if draw.chance(0.3) else draw.between(12.0, 60.0)
    kind = draw.pick({"thin": 0.2, "usual": 0.6, "thick": 0.2})
    thickness = {"thin": (0.006, 0.016), "usual": (0.016, 0.045), "thick": (0.045, 0.1)}[kind]
    return Board(across, deep, draw.between(*height), draw.between(*thickness), exponent)


def is_round(top: Board) -> bool:
    """Whether the outline is an ellipse, so that nothing fits under its corners."""
    return top.exponent <= 2.5


def inside(top: Board, share: Number) -> Board:
    """A smaller board of the same outline: `share` of the top's size."""
    return top._replace(width=top.width * share, depth=top.depth * share)


def corners(top: Board) -> Board:
    """The rectangle whose corners lie under the top; smaller than a round top."""
    return inside(top, 0.8) if is_round(top) else top


def top_parts(draw: Draw, top: Board, options: Weights = PLAIN_TOPS) -> list[Part]:
    kind = draw.named("top", options)
    if is_round(top) and kind in ("planks", "glazed", "wavy"):
        kind = "board"
    if not is_round(top) and kind == "polygon":
        kind = "board"
    return _TOPS[kind](draw, top)


def rails(draw: Draw, top: Board) -> list[Part]:
    """The frame under a top."""
    if not is_round(top):
        return apron(draw, top, draw.between(1.0, 2.0))
    height, low = draw.between(0.03, 0.12), top.height - top.thickness
    under = inside(top, draw.between(0.75, 0.95))
    return [ring(under, draw.between(0.008, 0.015), height, low - height / 2)]


def ring(top: Board, thick: Number, height: Number, y: Number) -> Part:
    """An upright band along the outline of a top, centred at the height y."""
    x, z = (outline_of(top) * (top.width / 2 - thick, top.depth / 2 - thick)).T
    path = np.stack([x, 0 * x + y, z], 1)
    return tubes(path, thick, across=height / 2, sides=4, loop=True)


def _board(draw: Draw, top: Board) -> list[Part]:
    size = (top.width, top.thickness, top.depth)
    bevel = draw.between(0.0, 0.1) if draw.chance(0.35) else 0.0
    return [plate(outline_of(top), size, top.height, bevel)]


def _block(draw: Draw, top: Board) -> list[Part]:
    """A thick top with rounded edges."""
    thick = max(top.thickness, draw.between(0.03, 0.07))
    center = (0, top.height - thick / 2, 0)
    size = (top.width, thick, top.depth)
    return [cushion(center, size, outline=outline_of(top), edge=draw.between(0.05, 0.45))]


def _planks(draw: Draw, top: Board) -> list[Part]:
    return slats(draw, top._replace(thickness=max(top.thickness, 0.03)))


def _glazed(draw: Draw, top: Board) -> list[Part]:
    """A pane in a frame of four rails."""
    wide, thick = draw.between(0.03, 0.09), max(top.thickness, 0.02)
    x, z, y = top.width / 2 - wide / 2, top.depth / 2 - wide / 2, top.height - thick / 2
    corners = np.array([[-x, y, z], [x, y, z], [x, y, -z], [-x, y, -z]])
    ends = np.roll(corners, -1, 0)
    along = (ends - corners) / np.abs(ends - corners).sum(1, keepdims=True) * wide / 2
    pane = plate(outline_of(top), (2 * x, 0.008, 2 * z), y + draw.between(-0.3, 0.5) * thick)
    return [bars(corners - along, ends + along, wide, thick), pane]


def _tray(draw: Draw, top: Board) -> list[Part]:
    """A top with a raised rim."""
    rim, thick = draw.between(0.02, 0.07), draw.between(0.006, 0.012)
    size = (top.width * 0.99, top.thickness, top.depth * 0.99)
    bottom, high = top.height - top.thickness, rim + top.thickness
    return [plate(outline_of(top), size, top.height), ring(top, thick, high, bottom + high / 2)]


def _wavy(draw: Draw, top: Board) -> list[Part]:
    """A plank with the natural edge of its tree."""
    outline = outline_of(top).copy()
    x, count = outline[:, 0], np.arange(len(outline))
    bumps = [draw.between(-0.05, 0.05) * np.sin(k * x + draw.between(0, 6)) for k in (2, 4, 7)]
    outline[:, 1] *= 0.92 + np.sum(bumps, 0)[np.minimum(count, -count % len(outline))]
    size = (top.width, max(top.thickness, 0.03), top.depth)
    return [plate(outline, size, top.height)]


def _polygon(draw: Draw, top: Board) -> list[Part]:
    """A top of six or eight sides in place of a round one."""
    outline = polygon(6 if draw.chance(0.5) else 8)
    return [plate(outline, (top.width, top.thickness, top.depth), top.height)]


_TOPS = {
    "board": _board,
    "block": _block,
    "planks": _planks,
    "glazed": _glazed,
    "tray": _tray,
    "wavy": _wavy,
    "polygon": _polygon,
}
