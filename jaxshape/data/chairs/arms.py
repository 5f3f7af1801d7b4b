"""Arms of framed chairs."""

import numpy as np

from jaxshape.data.chairs.backs import Rest
from jaxshape.data.procedural.boards import Board
from jaxshape.data.procedural.draw import Draw, Number, Weights
from jaxshape.data.procedural.primitives import (
    Part,
    bars,
    bend,
    both_sides,
    box,
    cushion,
    slab,
    tubes,
)

HUNG_ARMS = {"loop": 0.45, "pads": 0.3, "panel": 0.15, "wrap": 0.1}  # none reaches the floor
FRAMED_ARMS = {"posts": 0.35, "loop": 0.2, "panel": 0.16, "wrap": 0.14, "pads": 0.08,
               "floor loop": 0.05, "side": 0.05}  # fmt: skip


def arm_parts(draw: Draw, seat: Board, rest: Rest, options: Weights) -> list[Part]:
    height = seat.height + draw.between(0.16, 0.28)
    return _ARMS[draw.named("arms", options)](draw, seat, rest, height)


def _posts(draw: Draw, seat: Board, rest: Rest, y: Number) -> list[Part]:
    """A rest on a front post, running back to the back's upright."""
    x, front = seat.width / 2 + draw.between(-0.02, 0.03), seat.depth / 2 - draw.between(0, 0.18)
    share = min((y - rest.y) / rest.height, 1.0)
    back = rest.at(1.0, share)
    width, thick = draw.between(0.02, 0.09), draw.between(0.015, 0.04)
    sweep = draw.between(-0.03, 0.05)
    t = np.linspace(0, 1, 5)[:, None]
    tip = np.array([x + sweep, y, front + draw.between(0.0, 0.06)])
    path = tip * (1 - t) + back * t + np.array([0.03, -0.015, 0]) * np.sin(np.pi * t)
    foot = 0.0 if draw.chance(0.3) else seat.height - 0.03
    sides = 8 if draw.chance(0.35) else 4
    post = bars((x, y, front), (x, foot, front - (draw.between(0, 0.06) if foot else 0)),
                draw.between(0.018, 0.045), sides=sides)  # fmt: skip
    rail = tubes(path, thick / 2, across=width / 2, sides=4)
    parts = [both_sides(rail), both_sides(post)]
    if draw.chance(0.2):
        count = draw.count(1, 4)
        at = path[1] + (path[-2] - path[1]) * np.linspace(0, 1, count)[:, None]
        lower = at * (1, 0, 1) + np.array([0, seat.height - 0.02, 0])
        parts.append(both_sides(bars(at, lower, draw.between(0.01, 0.025))))
    return parts


def _loop(draw: Draw, seat: Board, rest: Rest, y: Number) -> list[Part]:
    """A bent tube or band: up from the seat, back along the arm, to the back or down again."""
    x = seat.width / 2 + draw.between(0.0, 0.04)
    front, low = seat.depth / 2 - draw.between(0.02, 0.15), seat.height - 0.03
    radius = draw.between(0.008, 0.02)
    across = draw.between(0.012, 0.03) if draw.chance(0.4) else None
    if draw.chance(0.55):
        share = min((y - rest.y) / rest.height, 0.95)
        corners = [(x, low, front - 0.04), (x + 0.01, y, front), tuple(rest.at(1.0, share))]
    else:
        corners = [(x, low, front - 0.05), (x, y, front), (x, y - 0.02, -seat.depth * 0.3),
                   (x, low, -seat.depth * 0.25)]  # fmt: skip
    path = bend(corners, draw.between(0.04, 0.14))
    sides = 8 if across is None else 4
    return [both_sides(tubes(path, radius, across=across, sides=sides))]


def _floor_loop(draw: Draw, seat: Board, rest: Rest, y: Number) -> list[Part]:
    """Front leg, arm and back leg bent from one tube or flat bar."""
    x, z = seat.width / 2 + draw.between(0.01, 0.04), seat.depth / 2
    radius, across = draw.between(0.008, 0.015), draw.between(0.01, 0.03)
    corners = [
        (x, 0, z + draw.between(-0.06, 0.04)),
        (x, y, z - draw.between(0.0, 0.06)),
        (x, y - draw.between(0, 0.04), -z),
        (x, 0, -z - draw.between(0.0, 0.06)),
    ]
    return [both_sides(tubes(bend(corners, 0.07), radius, across=across, sides=8))]


def _panel(draw: Draw, seat: Board, rest: Rest, y: Number, low: Number | None = None) -> list[Part]:
    """A solid side, from just under the seat or from the height `low`."""
    thick = draw.between(0.02, 0.12)
    x, length = seat.width / 2 + thick / 2 - 0.01, seat.depth * draw.between(0.75, 1.0)
    low = seat.height - draw.between(0.02, 0.12) if low is None else low
    drop = draw.between(0, 0.12) if draw.chance(0.5) else 0.0
    z = np.linspace(-seat.depth / 2, length - seat.depth / 2, 5)
    top = y + drop / 2 - drop * np.linspace(0, 1, 5) ** 2
    height = np.linspace(0, 1, 3)[:, None]
    surface = np.stack(np.broadcast_arrays(x, low + (top - low) * height, z), -1)
    return [both_sides(slab(surface, thick))]


def _side(draw: Draw, seat: Board, rest: Rest, y: Number) -> list[Part]:
    """A solid side from the floor."""
    return _panel(draw, seat, rest, y, low=0.0)


def _wrap(draw: Draw, seat: Board, rest: Rest, y: Number) -> list[Part]:
    """One bow that is both arms and the lower back, on posts or spindles."""
    reach, depth = seat.width / 2 + draw.between(0.0, 0.05), seat.depth * draw.between(0.85, 1.0)
    angle = np.linspace(-np.pi / 2, np.pi / 2, 11)
    center = rest.z + min(reach, depth * 0.6)
    radius = center - rest.at(0.0, 0.3)[2] + 0.015
    x, z = reach * np.sin(angle), center - radius * np.cos(angle)
    tip = np.array([reach * draw.between(0.95, 1.05), seat.depth * draw.between(0.1, 0.5)])
    x, z = np.r_[-tip[0], x, tip[0]], np.r_[max(tip[1], center + 0.03), z,
                                            max(tip[1], center + 0.03)]  # fmt: skip
    lift = draw.between(0.0, 0.12) if draw.chance(0.4) else 0.0
    bow = np.stack([x, y + lift * np.clip(1 - (z - z.min()) / 0.25, 0, 1), z], 1)
    flat = draw.between(0.012, 0.03)
    parts = [tubes(bow, flat, across=draw.between(0.01, 0.02), sides=6)]
    count = draw.count(0, 9)
    where = np.unique(np.r_[0, 12, np.round(np.linspace(0, 12, count + 2)).astype(int)])
    foot = bow[where] * (0.85, 0, 0.85) + np.array([0, seat.height - 0.02, 0])
    return [*parts, bars(bow[where], foot, draw.between(0.01, 0.022), sides=6)]


def _pads(draw: Draw, seat: Board, rest: Rest, y: Number) -> list[Part]:
    """Office arms: a pad on one upright or on a bracket."""
    x, z = seat.width / 2 + draw.between(0.01, 0.05), draw.between(-0.08, 0.06)
    pad = cushion((x, y, z + 0.03), (draw.between(0.04, 0.08), draw.between(0.025, 0.04),
                                     draw.between(0.2, 0.3)))  # fmt: skip
    low = seat.height - draw.between(0.02, 0.06)
    upright = bend([(x * 0.6, low, z), (x, low, z), (x, y, z)], 0.04)
    wide = draw.between(0.01, 0.035)
    return [both_sides(pad), both_sides(tubes(upright, draw.between(0.008, 0.02), across=wide,
                                              sides=4))]  # fmt: skip


def tray(draw: Draw, seat: Board) -> list[Part]:
    """The tray of a high chair or the tablet of a lecture chair, on its brackets."""
    y = seat.height + draw.between(0.17, 0.25)
    z, x = seat.depth / 2 + draw.between(-0.05, 0.08), seat.width / 2 + 0.02
    bracket = bars((x, y, z), (x, seat.height - 0.02, -0.05), 0.02)
    thick, deep = draw.between(0.015, 0.03), draw.between(0.2, 0.3)
    if draw.chance(0.35):
        side = 1 if draw.chance(0.6) else -1
        wide = seat.width * draw.between(0.55, 0.9)
        inward = draw.between(0.1, 0.4) * wide
        board = box((x - inward, y, z), (wide, thick, deep * draw.between(1.0, 1.5)))
        return [part._replace(vertices=part.vertices * (side, 1, 1)) for part in (board, bracket)]
    board = box((0, y, z), (seat.width * draw.between(0.95, 1.3), thick, deep))
    return [board, both_sides(bracket)]


_ARMS = {
    "posts": _posts,
    "loop": _loop,
    "floor loop": _floor_loop,
    "panel": _panel,
    "side": _side,
    "wrap": _wrap,
    "pads": _pads,
}
