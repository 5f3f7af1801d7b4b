"""What carries a seat: legs, sleds, cantilevers, pedestals, crosses, panels."""

from typing import NamedTuple

import numpy as np

from jaxshape.data.chairs.draw import Draw, Number, Weights
from jaxshape.data.chairs.primitives import (
    Part,
    bars,
    bend,
    both_sides,
    box,
    lathe,
    loft,
    polygon,
    tubes,
)
from jaxshape.data.chairs.seats import Seat


class Legs(NamedTuple):
    """Four legs: front left, front right, back right, back left.

    Attributes:
        tops: Upper ends `[4 3]`, in metres.
        feet: Lower ends `[4 3]`, in metres.
    """

    tops: np.ndarray
    feet: np.ndarray


def base_parts(draw: Draw, seat: Seat, options: Weights) -> list[Part]:
    return _BASES[draw.named("base", options)](draw, seat)


def place_legs(draw: Draw, seat: Seat, splay: Number, inset: float) -> Legs:
    """Legs under the corners of the seat, spread outward by `splay` metres at the floor."""
    y, front = seat.height - seat.thickness, seat.depth / 2 - inset
    reach = 1.0 if seat.exponent > 2.5 else 0.75
    tops = np.array(
        [[s * (seat.half_width(z * reach) * reach - inset), y, z * reach] for z, s in
         ((front, -1), (front, 1), (-front, 1), (-front, -1))])  # fmt: skip
    feet = tops * (1, 0, 1)
    spread = np.array([draw.between(0.3, 1.0), 0, draw.between(0.3, 1.0)]) * splay
    feet = feet + np.sign(tops) * spread
    if draw.chance(0.6):
        feet[2:, 2] -= draw.between(0.0, 0.14)  # back legs raked backward
    return Legs(tops, feet)


def _four_legs(draw: Draw, seat: Seat) -> list[Part]:
    splay = draw.between(0.0, 0.02) if draw.chance(0.6) else draw.between(0.02, 0.12)
    flush = draw.chance(0.5)
    inset = draw.between(0.005, 0.025) if flush else draw.between(0.015, 0.05)
    legs = place_legs(draw, seat, splay * seat.height / 0.45, inset)
    kind = draw.named("legs", {"square": 0.36, "tapered": 0.22, "round": 0.18, "turned": 0.06,
                               "conical": 0.08, "bent": 0.07, "stout": 0.06})  # fmt: skip
    thick = draw.thick(0.02, 0.045)
    if kind == "square":
        parts = [bars(legs.tops, legs.feet, thick, thick * draw.between(0.7, 1.4))]
    elif kind == "tapered":
        parts = [bars(legs.tops, legs.feet, thick * 1.2, profile=(1.0, draw.between(0.4, 0.8)))]
    elif kind == "round":
        parts = [bars(legs.tops, legs.feet, draw.thick(0.014, 0.032), sides=8)]
    elif kind == "conical":
        profile = (1.0, draw.between(0.4, 0.8))
        parts = [bars(legs.tops, legs.feet, thick * 1.2, sides=10, profile=profile)]
    elif kind == "turned":
        bulges = 0.5 + 0.9 * np.array([draw.between(0, 1) for _ in range(9)])
        parts = [bars(legs.tops, legs.feet, thick * 1.2, sides=8, profile=bulges)]
    elif kind == "stout":
        profile = (1.0, draw.between(0.8, 1.5))
        parts = [bars(legs.tops, legs.feet, draw.between(0.05, 0.09), sides=10, profile=profile)]
    else:
        parts = [_bent_legs(draw, legs, thick)]
    likely = 0.3 if seat.height < 0.55 else 0.85
    return parts + (stretchers(draw, legs, thick) if draw.chance(likely) else [])


def _bent_legs(draw: Draw, legs: Legs, thick: Number) -> Part:
    """Cabriole legs: out at the knee, in at the ankle; or sabre legs, one sweep."""
    t = np.linspace(0, 1, 8)[:, None]
    straight = legs.tops[:, None] * (1 - t) + legs.feet[:, None] * t
    outward = np.sign(legs.tops[:, None]) * (1, 0, 1)
    double = draw.chance(0.5)
    sway = np.sin(2 * np.pi * t) * 0.6 if double else -np.sin(np.pi * t)
    paths = straight + outward * sway * draw.between(0.015, 0.05)
    return tubes(paths, thick / 2 * np.linspace(1.2, draw.between(0.5, 0.9), 8), sides=6)


def stretchers(draw: Draw, legs: Legs, thick: Number) -> list[Part]:
    """Rails between the legs: all round, H, at the sides, crossed, or in two tiers."""
    kind = draw.named("stretchers", {"box": 0.35, "H": 0.25, "sides": 0.2, "tiers": 0.12,
                                     "cross": 0.08})  # fmt: skip
    sides = 8 if draw.chance(0.4) else 4
    width, depth = thick * draw.between(0.4, 0.8), thick * draw.between(0.4, 1.1)
    low, high = draw.between(0.15, 0.45), draw.between(0.2, 0.6)

    def at(share: Number) -> np.ndarray:
        return legs.feet + share * (legs.tops - legs.feet)

    def run(share: Number, pairs: list[tuple[int, int]]) -> Part:
        i, j = np.array(pairs).T
        return bars(at(share)[i], at(share)[j], width, depth, sides=sides)

    side_pairs, cross_pairs = [(1, 2), (0, 3)], [(0, 1), (2, 3)]
    if kind == "cross":
        return [run(low, [(0, 2), (1, 3)])]
    if kind == "H":
        middle = (at(low)[[0, 1]] + at(low)[[3, 2]]) / 2
        return [run(low, side_pairs), bars(middle[0], middle[1], width, depth, sides=sides)]
    parts = [run(low, side_pairs)]
    if kind in ("box", "tiers"):
        parts.append(run(high, cross_pairs))
    if kind == "tiers":
        parts += [run(low + 0.3, side_pairs), run(min(high + 0.3, 0.9), cross_pairs)]
    return parts


def _hairpin(draw: Draw, seat: Seat) -> list[Part]:
    """Two thin rods per leg that meet at the floor."""
    legs = place_legs(draw, seat, draw.between(0.0, 0.08), 0.03)
    gap = np.sign(legs.tops) * (draw.between(0.04, 0.1), 0, 0)
    deep = np.sign(legs.tops) * (0, 0, draw.between(0.04, 0.1))
    starts = np.concatenate([legs.tops - gap, legs.tops - deep])
    return [bars(starts, np.tile(legs.feet, (2, 1)), draw.between(0.01, 0.018), sides=6)]


def _bent_sides(draw: Draw, corners: list[tuple[float, float, float]]) -> list[Part]:
    """The same bent tube on both sides, round or of flat section."""
    flat = draw.chance(0.3)
    radius = draw.between(0.007, 0.016)
    across = draw.between(0.01, 0.03) if flat else None
    path = bend(corners, draw.between(0.02, 0.1))
    return [both_sides(tubes(path, radius, across=across, sides=4 if flat else 8))]


def _sled(draw: Draw, seat: Seat) -> list[Part]:
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


def _cantilever(draw: Draw, seat: Seat) -> list[Part]:
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


def _armed_loop(draw: Draw, seat: Seat) -> list[Part]:
    """One bent tube at each side is arm, front leg, runner and maybe back leg."""
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


def column(draw: Draw, foot: Number, top: float) -> list[Part]:
    """The upright of a pedestal: straight, telescopic or waisted."""
    radius = draw.between(0.015, 0.045)
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


def _disc(draw: Draw, seat: Seat) -> list[Part]:
    """A column on a round foot: flat, domed or a trumpet that grows out of it."""
    radius, thick = seat.width * draw.between(0.36, 0.58), draw.between(0.012, 0.04)
    top, rise = seat.height - seat.thickness, draw.between(0.0, 0.08)
    neck = draw.between(0.02, 0.05)
    share = np.linspace(1, 0, 6)
    profile = [(radius, 0.0)] + [(neck + (radius - neck) * s, thick + rise * (1 - s) ** 2)
                                 for s in share]  # fmt: skip
    if draw.chance(0.1):
        foot = box((0, thick / 2, 0), (2 * radius, thick, 2 * radius))
        return [foot, *column(draw, thick, top)]
    return [lathe(profile, sides=20), *column(draw, thick, top)]


def _star(draw: Draw, seat: Seat, castors: bool | None = None) -> list[Part]:
    """Three to five arms about a column, on castors or glides."""
    castors = draw.chance(0.3) if castors is None else castors
    count = 5 if castors else draw.count(3, 5)
    radius = max(seat.width, 0.42) * draw.between(0.5, 0.72)
    wheel = draw.between(0.02, 0.032) if castors else 0.0
    tip, hub = 2 * wheel + draw.between(0.01, 0.03), draw.between(0.05, 0.13)
    start_angle = np.pi / 2 if draw.chance(0.5) else np.pi / 2 + np.pi / count
    angle = start_angle + 2 * np.pi * np.arange(count) / count
    direction = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], 1)
    start = direction * 0.02 + np.array([0, 2 * wheel + hub, 0])
    end = direction * radius + np.array([0, tip, 0])
    thick = draw.between(0.02, 0.04)
    profile = (1.0, draw.between(0.4, 1.0))
    parts = [bars(start, end, draw.between(0.025, 0.06), thick, profile=profile)]
    parts += column(draw, min(2 * wheel + hub - 0.02, 0.1), seat.height - seat.thickness)
    if castors:
        side = np.cross(direction, (0, 1, 0)) * draw.between(0.01, 0.022)
        center = direction * radius + np.array([0, wheel, 0])
        parts.append(bars(center - side, center + side, 2 * wheel, sides=10))
    elif draw.chance(0.5):
        parts.append(bars(end, end * (1, 0, 1), 0.025, sides=6))
    return parts


def _castor_star(draw: Draw, seat: Seat) -> list[Part]:
    return _star(draw, seat, castors=True)


def _bar_pedestal(draw: Draw, seat: Seat) -> list[Part]:
    """A disc pedestal with a foot-rest: a hoop in front, or a ring all round."""
    parts = _disc(draw, seat)
    if draw.chance(0.7):
        y, radius = seat.height * draw.between(0.3, 0.5), seat.width * draw.between(0.3, 0.45)
        if draw.chance(0.5):
            corners = [(0, y, 0), (radius, y, 0), (radius, y, radius), (-radius, y, radius),
                       (-radius, y, 0), (0, y, 0)]  # fmt: skip
            parts.append(tubes(bend(corners, 0.06), 0.01, sides=6))
        else:
            parts += [foot_ring(y, radius), bars((-radius, y, 0), (radius, y, 0), 0.015, sides=6)]
    return parts


def foot_ring(y: Number, radius: float, thick: float = 0.01) -> Part:
    angle = 2 * np.pi * np.arange(24) / 24
    path = np.stack([radius * np.cos(angle), 0 * angle + y, radius * np.sin(angle)], 1)
    return tubes(path, thick, sides=6, loop=True)


def _ringed_legs(draw: Draw, seat: Seat) -> list[Part]:
    """Three or four splayed legs of a bar stool, tied by a ring."""
    count = draw.count(3, 4)
    angle = 2 * np.pi * (np.arange(count) + 0.5) / count + np.pi / 2
    direction = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], 1)
    top, foot = seat.width * draw.between(0.15, 0.42), seat.width * draw.between(0.42, 0.62)
    foot = max(foot, top)
    tops = direction * top + np.array([0, seat.height - seat.thickness, 0])
    sides = 8 if draw.chance(0.7) else 4
    parts = [bars(tops, direction * foot, draw.between(0.015, 0.05), sides=sides,
                  profile=(1.0, draw.between(0.7, 1.3)))]  # fmt: skip
    if draw.chance(0.75):
        share = draw.between(0.2, 0.5)
        radius = foot + (top - foot) * share
        parts.append(foot_ring(seat.height * share, radius, draw.between(0.007, 0.014)))
    return parts


def _scissors(draw: Draw, seat: Seat) -> list[Part]:
    """Folding legs that cross at each side, tied by rods."""
    x, z = seat.width / 2 - draw.between(-0.01, 0.04), seat.depth / 2
    y, reach = seat.height - 0.01, z * draw.between(0.85, 1.15)
    sides = 8 if draw.chance(0.6) else 4
    thick, depth = draw.between(0.012, 0.025), draw.between(0.015, 0.04)
    inner = x - thick * 1.2
    starts = np.array([[x, y, z * 0.9], [inner, y, -z * 0.9]])
    ends = np.array([[x, 0, -reach], [inner, 0, reach]])
    legs = both_sides(bars(starts, ends, thick, thick if sides == 8 else depth, sides=sides))
    ties = [starts[0], starts[1]]
    for leg in range(2):
        if draw.chance(0.7):
            ties.append(ends[leg] + draw.between(0.05, 0.35) * (starts[leg] - ends[leg]))
    ties = np.array(ties)
    return [legs, bars(ties, ties * (-1, 1, 1), thick, sides=8)]


def _crossed(draw: Draw, seat: Seat) -> list[Part]:
    """Legs that cross when seen from the front, as of a director's chair or an X stool."""
    x, z = seat.width / 2 - 0.02, seat.depth / 2 - draw.between(0.02, 0.06)
    y, thick = seat.height - seat.thickness, draw.between(0.02, 0.04)
    bowed = draw.chance(0.3)
    t = np.linspace(-1, 1, 7)
    across = np.sign(t) * (1 - (1 - np.abs(t)) ** 2) if bowed else t
    paths = np.stack([np.stack([s * x * across, y * (t + 1) / 2, 0 * t + depth], 1)
                      for s in (-1, 1) for depth in (-z, z)])  # fmt: skip
    ties = np.array([[-x, thick / 2, -z], [x, thick / 2, -z], [-x, y, -z], [x, y, -z]])
    return [tubes(paths, thick / 2, across=thick / 2, sides=4),
            bars(ties, ties * (1, 1, -1), thick * 0.8)]  # fmt: skip


def _panels(draw: Draw, seat: Seat) -> list[Part]:
    """Solid boards for legs: at the sides, or front and back, maybe with a shelf."""
    thick = draw.between(0.015, 0.06)
    y = seat.height - seat.thickness
    if draw.chance(0.8):
        x, depth = seat.width / 2 - thick / 2, seat.depth * draw.between(0.7, 1.0)
        parts = [both_sides(box((x, y / 2, 0), (thick, y, depth)))]
        tie = box((0, y * draw.between(0.2, 0.7), 0), (seat.width, draw.between(0.02, 0.1), 0.02))
    else:
        z, width = seat.depth / 2 - thick / 2, seat.width * draw.between(0.7, 1.0)
        parts = [box((0, y / 2, s * z), (width, y, thick)) for s in (-1, 1)]
        tie = box((0, y * draw.between(0.2, 0.7), 0), (0.02, draw.between(0.02, 0.1), seat.depth))
    return parts + ([tie] if draw.chance(0.5) else [])


def _block(draw: Draw, seat: Seat) -> list[Part]:
    """One solid body from floor to seat."""
    y, waist = seat.height - seat.thickness, draw.between(0.75, 1.0)
    if seat.exponent < 2.5:
        radius = seat.width / 2
        return [lathe([(radius, 0), (radius * waist, y / 2), (radius, y)])]
    section = polygon(4) * (seat.width / 2, seat.depth / 2)
    foot = np.stack([section[:, 0] * waist, np.zeros(4), section[:, 1] * waist], 1)
    return [loft(np.stack([foot, foot / (waist, 1, waist) + np.array([0, y, 0])]))]


def _loops(draw: Draw, seat: Seat) -> list[Part]:
    """Each pair of legs bent from one tube: a U at the front and a U at the back, or V sides."""
    y, z = seat.height - seat.thickness, seat.depth / 2 - 0.03
    x, radius = seat.width / 2 - 0.02, draw.between(0.008, 0.014)
    foot = x * draw.between(0.75, 1.1)
    if draw.chance(0.5):
        corners = [(x, y, z), (foot, radius, z + 0.04), (foot, radius, z - draw.between(0.08, 0.2)),
                   (x, y, 0.0)]  # fmt: skip
        front = tubes(bend(corners, 0.05), radius, sides=8)
        back = front._replace(vertices=front.vertices * (1, 1, -1))
        return [both_sides(front), both_sides(back)]
    corners = [(x, y, z), (foot, radius, z + 0.02), (-foot, radius, z + 0.02), (-x, y, z)]
    front = tubes(bend(corners, 0.06), radius, sides=8)
    return [front, front._replace(vertices=front.vertices * (1, 1, -1))]


def rockers(draw: Draw, seat: Seat) -> list[Part]:
    """Four legs on two curved runners."""
    legs = place_legs(draw, seat, draw.between(0.0, 0.06), 0.03)
    thick, reach = draw.between(0.02, 0.04), seat.depth / 2 + draw.between(0.12, 0.3)
    rise = draw.between(0.06, 0.14)
    z = np.linspace(-reach, reach * draw.between(0.7, 1.0), 9)
    x = abs(legs.feet[0, 0])
    runner = np.stack([0 * z + x, rise * (z / reach) ** 2 + thick / 2, z], 1)
    feet = legs.feet * (1, 0, 1)
    feet[:, 0] = np.sign(feet[:, 0]) * x
    feet[:, 1] = rise * (feet[:, 2] / reach) ** 2 + thick / 2
    sides = 8 if draw.chance(0.4) else 4
    legs = Legs(legs.tops, feet)
    parts = [bars(legs.tops, feet, thick, sides=sides),
             both_sides(tubes(runner, thick / 2, sides=4))]  # fmt: skip
    return parts + (stretchers(draw, legs, thick) if draw.chance(0.6) else [])


_BASES = {
    "four legs": _four_legs,
    "hairpin": _hairpin,
    "sled": _sled,
    "cantilever": _cantilever,
    "armed loop": _armed_loop,
    "disc": _disc,
    "star": _star,
    "castors": _castor_star,
    "bar pedestal": _bar_pedestal,
    "ringed legs": _ringed_legs,
    "scissors": _scissors,
    "crossed": _crossed,
    "panels": _panels,
    "block": _block,
    "loops": _loops,
    "rockers": rockers,
}
