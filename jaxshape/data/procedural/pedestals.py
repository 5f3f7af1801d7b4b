"""Bases of a board other than legs: columns, stars, discs, panels, blocks."""

import numpy as np

from jaxshape.data.procedural.boards import Board
from jaxshape.data.procedural.draw import Draw, Number, Range
from jaxshape.data.procedural.primitives import (
    Part,
    bars,
    both_sides,
    box,
    lathe,
    loft,
    polygon,
    tubes,
)


def column(draw: Draw, foot: Number, top: float, scale: Number = 1.0) -> list[Part]:
    """A pedestal's upright, straight, telescopic or waisted: `scale` times a chair's thickness."""
    radius = scale * draw.between(0.015, 0.045)
    kind = draw.pick({"straight": 0.4, "telescopic": 0.4, "trumpet": 0.2})
    middle = foot + (top - foot) * draw.between(0.35, 0.65)
    if kind == "telescopic":
        step = 0.6 * radius
        profile = [(radius, foot), (radius, middle), (step, middle + 0.005), (step, top)]
    elif kind == "trumpet":
        profile = [(radius * 1.6, foot), (radius * 0.8, middle), (radius, top - 0.03),
                   (radius * draw.between(1, 3), top)]  # fmt: skip
    else:
        profile = [(radius, foot), (radius, top - 0.02), (radius * 1.8, top - 0.015),
                   (radius * 1.8, top)]  # fmt: skip
    return [lathe(profile, sides=10)]


def disc(draw: Draw, board: Board, *, scale: Number = 1.0) -> list[Part]:
    """A column on a round foot: flat, domed or a trumpet that grows out of it."""
    radius, thick = board.width * draw.between(0.36, 0.58), draw.between(0.012, 0.04)
    top, rise = board.height - board.thickness, draw.between(0.0, 0.08)
    neck = scale * draw.between(0.02, 0.05)
    share = np.linspace(1, 0, 6)
    profile = [(radius, 0.0)] + [(neck + (radius - neck) * s, thick + rise * (1 - s) ** 2)
                                 for s in share]  # fmt: skip
    if draw.chance(0.1):
        foot = box((0, thick / 2, 0), (2 * radius, thick, 2 * radius))
        return [foot, *column(draw, thick, top, scale)]
    return [lathe(profile, sides=20), *column(draw, thick, top, scale)]


def star(
    draw: Draw,
    board: Board,
    *,
    castors: bool | None = None,
    reach: Range = (0.5, 0.72),
    scale: Number = 1.0,
) -> list[Part]:
    """Three to five arms around a column, on castors or glides.

    `reach` is the length of the arms over the board's width; they are `scale` times as thick as a
    chair's.
    """
    castors = draw.chance(0.3) if castors is None else castors
    count = 5 if castors else draw.count(3, 5)
    radius = max(board.width, 0.42) * draw.between(*reach)
    wheel = draw.between(0.02, 0.032) if castors else 0.0
    tip, hub = 2 * wheel + draw.between(0.01, 0.03), draw.between(0.05, 0.13)
    start_angle = np.pi / 2 if draw.chance(0.5) else np.pi / 2 + np.pi / count
    angle = start_angle + 2 * np.pi * np.arange(count) / count
    direction = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], 1)
    start = direction * 0.02 + np.array([0, 2 * wheel + hub, 0])
    end = direction * radius + np.array([0, tip, 0])
    thick = scale * draw.between(0.02, 0.04)
    profile = (1.0, draw.between(0.4, 1.0))
    parts = [bars(start, end, scale * draw.between(0.025, 0.06), thick, profile=profile)]
    parts += column(draw, min(2 * wheel + hub - 0.02, 0.1), board.height - board.thickness, scale)
    if castors:
        side = np.cross(direction, (0, 1, 0)) * draw.between(0.01, 0.022)
        center = direction * radius + np.array([0, wheel, 0])
        parts.append(bars(center - side, center + side, 2 * wheel, sides=10))
    elif draw.chance(0.5):
        parts.append(bars(end, end * (1, 0, 1), 0.025, sides=6))
    return parts


def foot_ring(y: Number, radius: float, thick: float = 0.01) -> Part:
    angle = 2 * np.pi * np.arange(24) / 24
    path = np.stack([radius * np.cos(angle), 0 * angle + y, radius * np.sin(angle)], 1)
    return tubes(path, thick, sides=6, loop=True)


def panels(draw: Draw, board: Board) -> list[Part]:
    """Solid boards for legs: at the sides, or front and back, maybe with a shelf."""
    thick = draw.between(0.015, 0.06)
    y = board.height - board.thickness
    if draw.chance(0.8):
        x, depth = board.width / 2 - thick / 2, board.depth * draw.between(0.7, 1.0)
        parts = [both_sides(box((x, y / 2, 0), (thick, y, depth)))]
        tie = box((0, y * draw.between(0.2, 0.7), 0), (board.width, draw.between(0.02, 0.1), 0.02))
    else:
        z, width = board.depth / 2 - thick / 2, board.width * draw.between(0.7, 1.0)
        parts = [box((0, y / 2, s * z), (width, y, thick)) for s in (-1, 1)]
        tie = box((0, y * draw.between(0.2, 0.7), 0), (0.02, draw.between(0.02, 0.1), board.depth))
    return parts + ([tie] if draw.chance(0.5) else [])


def block(draw: Draw, board: Board) -> list[Part]:
    """A solid body from floor to board."""
    y, waist = board.height - board.thickness, draw.between(0.75, 1.0)
    if board.exponent < 2.5:
        radius = board.width / 2
        return [lathe([(radius, 0), (radius * waist, y / 2), (radius, y)])]
    section = polygon(4) * (board.width / 2, board.depth / 2)
    foot = np.stack([section[:, 0] * waist, np.zeros(4), section[:, 1] * waist], 1)
    return [loft(np.stack([foot, foot / (waist, 1, waist) + np.array([0, y, 0])]))]
