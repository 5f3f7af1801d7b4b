"""Bases of seats: sleds, cantilevers and rockers, and the bases of any board."""

import numpy as np

from jaxshape.data.procedural import legs, pedestals
from jaxshape.data.procedural.boards import Board
from jaxshape.data.procedural.draw import Draw, Weights
from jaxshape.data.procedural.legs import Legs, place_legs, stretchers
from jaxshape.data.procedural.pedestals import foot_ring
from jaxshape.data.procedural.primitives import Part, bars, bend, both_sides, box, tubes


def base_parts(draw: Draw, seat: Board, options: Weights) -> list[Part]:
    return _BASES[draw.named("base", options)](draw, seat)


def _bent_sides(draw: Draw, corners: list[tuple[float, float, float]]) -> list[Part]:
    """The same bent tube on both sides, round or of flat section."""
    flat = draw.chance(0.3)
    radius = draw.between(0.007, 0.016)
    across = draw.between(0.01, 0.03) if flat else None
    path = bend(corners, draw.between(0.02, 0.1))
    return [both_sides(tubes(path, radius, across=across, sides=4 if flat else 8))]


def _sled(draw: Draw, seat: Board) -> list[Part]:
    """Runners on the floor: a closed loop at each side."""
    x = seat.width / 2 - draw.between(-0.02, 0.05)
    foot = x + draw.between(-0.01, 0.06)
    y, z = seat.height - seat.thickness, seat.depth / 2 - draw.between(0.0, 0.1)
    front, back = z + draw.between(-0.05, 0.06), z + draw.between(-0.06, 0.12)
    corners = [(x, y, 0.2 * z), (x, y, z), (foot, 0.012, front), (foot, 0.012, -back), (x, y, -z),
               (x, y, -0.2 * z)]  # fmt: skip
    crossbars = np.array([[x, y - 0.01, s * z * 0.8] for s in (-1, 1)])
    if draw.chance(0.3):
        crossbars[1] = (foot, 0.012, -back * 0.9)
    return [*_bent_sides(draw, corners),
            bars(crossbars, crossbars * (-1, 1, 1), 0.02, sides=8)]  # fmt: skip


def _cantilever(draw: Draw, seat: Board) -> list[Part]:
    """Front legs that run back along the floor; nothing carries the back."""
    x, z = seat.width / 2 - draw.between(-0.015, 0.02), seat.depth / 2
    y, behind = seat.height - seat.thickness, draw.between(-0.1, 0.08)
    lean = draw.between(-0.02, 0.05)
    flat = draw.chance(0.3)
    radius = draw.between(0.009, 0.018)
    corners = [(x, y, -z), (x, y, z), (x, radius, z + lean), (x, radius, -z - behind),
               (0, radius, -z - behind)]  # fmt: skip
    sides, across = (4, draw.between(0.012, 0.025)) if flat else (8, None)
    path = bend(corners, draw.between(0.03, 0.12))
    return [both_sides(tubes(path, radius, across=across, sides=sides))]


def _armed_loop(draw: Draw, seat: Board) -> list[Part]:
    """A single bent tube at each side forms arm, front leg, runner and sometimes back leg."""
    x, z = seat.width / 2 + draw.between(0.0, 0.03), seat.depth / 2 + draw.between(-0.02, 0.06)
    arm, radius = seat.height + draw.between(0.15, 0.28), draw.thick(0.008, 0.018)
    back, behind = -seat.depth / 2 + draw.between(-0.03, 0.04), draw.between(-0.08, 0.1)
    front, drop = z + draw.between(-0.06, 0.06), draw.between(0.0, 0.06)
    corners = [(x, arm - drop, back), (x, arm, front), (x, radius, z), (x, radius, back - behind)]
    closed = draw.chance(0.45)
    corners.append((x, arm - drop, back) if closed else (0.0, radius, back - behind))
    across = draw.between(0.012, 0.035) if draw.chance(0.4) else None
    sides = 8 if across is None else 4
    path = bend(corners, draw.between(0.05, 0.15))
    y = seat.height - seat.thickness
    level = np.array([[x, y, back], [x, y, front]])
    parts = [both_sides(tubes(path, radius, across=across, sides=sides)),
             both_sides(bars(level[:1], level[1:], 0.02, sides=8))]  # fmt: skip
    if draw.chance(0.4):
        pad = box((x, arm + 0.012, (back + front) / 2), (0.05, 0.025, 0.8 * (front - back)))
        parts.append(both_sides(pad))
    return parts


def _castor_star(draw: Draw, seat: Board) -> list[Part]:
    return pedestals.star(draw, seat, castors=True)


def _bar_pedestal(draw: Draw, seat: Board) -> list[Part]:
    """A disc pedestal with a foot-rest: a hoop in front, or a ring all round."""
    parts = pedestals.disc(draw, seat)
    if draw.chance(0.7):
        y, radius = seat.height * draw.between(0.3, 0.5), seat.width * draw.between(0.3, 0.45)
        if draw.chance(0.5):
            corners = [(0, y, 0), (radius, y, 0), (radius, y, radius), (-radius, y, radius),
                       (-radius, y, 0), (0, y, 0)]  # fmt: skip
            parts.append(tubes(bend(corners, 0.06), 0.01, sides=6))
        else:
            parts += [foot_ring(y, radius), bars((-radius, y, 0), (radius, y, 0), 0.015, sides=6)]
    return parts


def rockers(draw: Draw, seat: Board) -> list[Part]:
    """Four legs on two curved runners."""
    placed = place_legs(draw, seat, draw.between(0.0, 0.06), 0.03)
    thick, reach = draw.between(0.02, 0.04), seat.depth / 2 + draw.between(0.12, 0.3)
    rise = draw.between(0.06, 0.14)
    z = np.linspace(-reach, reach * draw.between(0.7, 1.0), 9)
    x = abs(placed.feet[0, 0])
    runner = np.stack([0 * z + x, rise * (z / reach) ** 2 + thick / 2, z], 1)
    feet = placed.feet * (1, 0, 1)
    feet[:, 0] = np.sign(feet[:, 0]) * x
    feet[:, 1] = rise * (feet[:, 2] / reach) ** 2 + thick / 2
    sides = 8 if draw.chance(0.4) else 4
    parts = [bars(placed.tops, feet, thick, sides=sides),
             both_sides(tubes(runner, thick / 2, sides=4))]  # fmt: skip
    return parts + (stretchers(draw, Legs(placed.tops, feet), thick) if draw.chance(0.6) else [])


_BASES = {
    "four legs": legs.four_legs,
    "hairpin": legs.hairpin,
    "sled": _sled,
    "cantilever": _cantilever,
    "armed loop": _armed_loop,
    "disc": pedestals.disc,
    "star": pedestals.star,
    "castors": _castor_star,
    "bar pedestal": _bar_pedestal,
    "ringed legs": legs.ringed_legs,
    "scissors": legs.scissors,
    "crossed": legs.crossed,
    "panels": pedestals.panels,
    "block": pedestals.block,
    "loops": legs.loops,
    "rockers": rockers,
}
