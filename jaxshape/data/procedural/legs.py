"""Legs that carry a board: four of many kinds, their stretchers, hairpins, crosses, bent tubes."""

from typing import NamedTuple

import numpy as np

from jaxshape.data.procedural.boards import Board
from jaxshape.data.procedural.draw import Draw, Number
from jaxshape.data.procedural.pedestals import foot_ring
from jaxshape.data.procedural.primitives import Part, bars, bend, both_sides, tubes


class Legs(NamedTuple):
    """Four legs: front left, front right, back right, back left.

    Attributes:
        tops: Upper ends `[4 3]`, in metres.
        feet: Lower ends `[4 3]`, in metres.
    """

    tops: np.ndarray
    feet: np.ndarray


def place_legs(
    draw: Draw, board: Board, splay: Number, inset: float, *, raked: Number = 0.6
) -> Legs:
    """Legs under the corners of the board, spread outward by `splay` metres at the floor.

    `raked` is the probability that the back legs lean backward.
    """
    y, front = board.height - board.thickness, board.depth / 2 - inset
    reach = 1.0 if board.exponent > 2.5 else 0.75
    tops = np.array(
        [[s * (board.half_width(z * reach) * reach - inset), y, z * reach] for z, s in
         ((front, -1), (front, 1), (-front, 1), (-front, -1))])  # fmt: skip
    feet = tops * (1, 0, 1)
    spread = np.array([draw.between(0.3, 1.0), 0, draw.between(0.3, 1.0)]) * splay
    feet = feet + np.sign(tops) * spread
    if draw.chance(raked):
        feet[2:, 2] -= draw.between(0.0, 0.14)
    return Legs(tops, feet)


def four_legs(
    draw: Draw,
    board: Board,
    *,
    scale: Number = 1.0,
    raked: Number = 0.6,
    tied: Number | None = None,
) -> list[Part]:
    """Legs of one of seven kinds, and maybe stretchers.

    `scale` multiplies the thickness of a chair's legs and their distance from the edge. `tied` is
    the probability of stretchers; None derives it from the height.
    """
    splay = draw.between(0.0, 0.02) if draw.chance(0.6) else draw.between(0.02, 0.12)
    flush = draw.chance(0.5)
    inset = draw.between(0.005, 0.025) if flush else draw.between(0.015, 0.05)
    legs = place_legs(draw, board, splay * board.height / 0.45, scale * inset, raked=raked)
    kind = draw.named("legs", {"square": 0.36, "tapered": 0.22, "round": 0.18, "turned": 0.06,
                               "conical": 0.08, "bent": 0.07, "stout": 0.06})  # fmt: skip
    thick = scale * draw.thick(0.02, 0.045)
    if kind == "square":
        parts = [bars(legs.tops, legs.feet, thick, thick * draw.between(0.7, 1.4))]
    elif kind == "tapered":
        parts = [bars(legs.tops, legs.feet, thick * 1.2, profile=(1.0, draw.between(0.4, 0.8)))]
    elif kind == "round":
        parts = [bars(legs.tops, legs.feet, scale * draw.thick(0.014, 0.032), sides=8)]
    elif kind == "conical":
        profile = (1.0, draw.between(0.4, 0.8))
        parts = [bars(legs.tops, legs.feet, thick * 1.2, sides=10, profile=profile)]
    elif kind == "turned":
        bulges = 0.5 + 0.9 * np.array([draw.between(0, 1) for _ in range(9)])
        parts = [bars(legs.tops, legs.feet, thick * 1.2, sides=8, profile=bulges)]
    elif kind == "stout":
        profile = (1.0, draw.between(0.8, 1.5))
        stout = scale * draw.between(0.05, 0.09)
        parts = [bars(legs.tops, legs.feet, stout, sides=10, profile=profile)]
    else:
        parts = [bent_legs(draw, legs, thick)]
    if tied is None:
        tied = 0.3 if board.height < 0.55 else 0.85
    return parts + (stretchers(draw, legs, thick) if draw.chance(tied) else [])


def bent_legs(draw: Draw, legs: Legs, thick: Number) -> Part:
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


def hairpin(draw: Draw, board: Board, *, raked: Number = 0.6) -> list[Part]:
    """Two thin rods per leg that meet at the floor."""
    legs = place_legs(draw, board, draw.between(0.0, 0.08), 0.03, raked=raked)
    gap = np.sign(legs.tops) * (draw.between(0.04, 0.1), 0, 0)
    deep = np.sign(legs.tops) * (0, 0, draw.between(0.04, 0.1))
    starts = np.concatenate([legs.tops - gap, legs.tops - deep])
    return [bars(starts, np.tile(legs.feet, (2, 1)), draw.between(0.01, 0.018), sides=6)]


def ringed_legs(draw: Draw, board: Board, *, scale: Number = 1.0) -> list[Part]:
    """Three or four splayed legs, tied by a ring."""
    count = draw.count(3, 4)
    angle = 2 * np.pi * (np.arange(count) + 0.5) / count + np.pi / 2
    direction = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], 1)
    top, foot = board.width * draw.between(0.15, 0.42), board.width * draw.between(0.42, 0.62)
    foot = max(foot, top)
    tops = direction * top + np.array([0, board.height - board.thickness, 0])
    sides = 8 if draw.chance(0.7) else 4
    parts = [bars(tops, direction * foot, scale * draw.between(0.015, 0.05), sides=sides,
                  profile=(1.0, draw.between(0.7, 1.3)))]  # fmt: skip
    if draw.chance(0.75):
        share = draw.between(0.2, 0.5)
        radius = foot + (top - foot) * share
        parts.append(foot_ring(board.height * share, radius, draw.between(0.007, 0.014)))
    return parts


def scissors(draw: Draw, board: Board, *, scale: Number = 1.0) -> list[Part]:
    """Folding legs that cross at each side, tied by rods."""
    x, z = board.width / 2 - draw.between(-0.01, 0.04), board.depth / 2
    y, reach = board.height - 0.01, z * draw.between(0.85, 1.15)
    sides = 8 if draw.chance(0.6) else 4
    thick, depth = scale * draw.between(0.012, 0.025), scale * draw.between(0.015, 0.04)
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


def crossed(draw: Draw, board: Board) -> list[Part]:
    """Legs that cross when seen from the front, as of a director's chair or an X stool."""
    x, z = board.width / 2 - 0.02, board.depth / 2 - draw.between(0.02, 0.06)
    y, thick = board.height - board.thickness, draw.between(0.02, 0.04)
    bowed = draw.chance(0.3)
    t = np.linspace(-1, 1, 7)
    across = np.sign(t) * (1 - (1 - np.abs(t)) ** 2) if bowed else t
    paths = np.stack([np.stack([s * x * across, y * (t + 1) / 2, 0 * t + depth], 1)
                      for s in (-1, 1) for depth in (-z, z)])  # fmt: skip
    ties = np.array([[-x, thick / 2, -z], [x, thick / 2, -z], [-x, y, -z], [x, y, -z]])
    return [tubes(paths, thick / 2, across=thick / 2, sides=4),
            bars(ties, ties * (1, 1, -1), thick * 0.8)]  # fmt: skip


def loops(draw: Draw, board: Board) -> list[Part]:
    """Each pair of legs bent from one tube: a U at the front and a U at the back, or V sides."""
    y, z = board.height - board.thickness, board.depth / 2 - 0.03
    x, radius = board.width / 2 - 0.02, draw.between(0.008, 0.014)
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
