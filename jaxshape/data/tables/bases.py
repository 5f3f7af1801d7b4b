"""Bases of table tops: end frames and trestles, pedestals, panels, and the legs of chairs."""

from collections.abc import Sequence

import numpy as np

from jaxshape.data.procedural import legs, pedestals
from jaxshape.data.procedural.boards import Board
from jaxshape.data.procedural.draw import Draw, Number, Weights
from jaxshape.data.procedural.primitives import (
    Part,
    bars,
    both_sides,
    box,
    lathe,
    plate,
    shift,
    superellipse,
    tubes,
    turn,
)
from jaxshape.data.tables.tops import corners, inside, rails

FRAMES = {"loop": 0.3, "arch": 0.15, "X": 0.15, "A": 0.12, "T": 0.18, "columns": 0.1}
TRESTLES = {"A": 0.3, "X": 0.25, "T": 0.3, "columns": 0.15}


def base_parts(draw: Draw, top: Board, options: Weights) -> list[Part]:
    return _BASES[draw.named("base", options)](draw, top)


def _legs(draw: Draw, top: Board) -> list[Part]:
    """Four legs, with rails under the top or without."""
    scale = draw.between(0.9, 2.2) * min(1.0, 0.5 + top.width / 2)
    parts = legs.four_legs(draw, corners(top), scale=scale, raked=0.0, tied=0.2)
    return parts + (rails(draw, top) if draw.chance(0.55) else [])


def _hairpin(draw: Draw, top: Board) -> list[Part]:
    return legs.hairpin(draw, corners(top), raked=0.0)


def _tripod(draw: Draw, top: Board) -> list[Part]:
    """Three or four splayed legs."""
    return legs.ringed_legs(draw, top, scale=draw.between(0.8, 1.3))


def _scissors(draw: Draw, top: Board) -> list[Part]:
    return legs.scissors(draw, corners(top), scale=draw.between(1.0, 2.2))


def _crossed(draw: Draw, top: Board) -> list[Part]:
    return legs.crossed(draw, corners(top))


def _bows(draw: Draw, top: Board) -> list[Part]:
    return legs.loops(draw, corners(top))


def _end_frames(draw: Draw, top: Board) -> list[Part]:
    parts = frames(draw, top, FRAMES)
    return parts + (rails(draw, top) if draw.chance(0.15) else [])


def _trestle(draw: Draw, top: Board) -> list[Part]:
    return frames(draw, top, TRESTLES, beam=0.9)


def frames(draw: Draw, top: Board, kinds: Weights, *, beam: Number = 0.3) -> list[Part]:
    """The same flat frame at both ends; a beam connects them with probability `beam`."""
    kind = draw.named("frame", kinds)
    under = corners(top)
    thick, wide = draw.thick(0.025, 0.06), draw.between(0.02, 0.11)
    x = under.width / 2 * draw.between(0.6, 1.0) - wide / 2
    y, half = under.height - under.thickness, under.depth / 2 * draw.between(0.7, 1.0) - thick / 2
    lines, level = _LINES[kind](draw, half, y, thick)
    ends = np.array([[(x, *start), (x, *end)] for start, end in lines])
    lean = draw.between(-0.15, 0.2) * y if draw.chance(0.15) else 0.0
    ends[..., 0] += lean * (0.5 - ends[..., 1] / y)
    parts = [both_sides(bars(ends[:, 0], ends[:, 1], wide, thick))]
    if draw.chance(beam):
        at = np.array([x + lean * (0.5 - level / y), level, 0.0])
        parts.append(bars(at * (-1, 1, 1), at, draw.between(0.03, 0.14), draw.between(0.02, 0.06)))
    return parts


Line = tuple[tuple[Number, Number], tuple[Number, Number]]
"""A bar of an end frame from one (y, z) to another."""

Frame = tuple[Sequence[Line], Number]
"""The bars of an end frame, and the height at which a beam meets a bar at z = 0."""


def _loop(draw: Draw, half: Number, y: Number, thick: Number) -> Frame:
    """A closed rectangle or trapeze."""
    foot = half * (1.0 if draw.chance(0.6) else draw.between(0.7, 1.15))
    low, top = thick / 2, y - thick / 2
    out, end = foot + low, half + low
    lines = [((y, -half), (low, -foot)), ((y, half), (low, foot)),
             ((low, -out), (low, out)), ((top, -end), (top, end))]  # fmt: skip
    return lines, low if draw.chance(0.5) else top


def _arch(draw: Draw, half: Number, y: Number, thick: Number) -> Frame:
    """Two legs and the bar on top of them."""
    foot = half * (1.0 if draw.chance(0.5) else draw.between(0.8, 1.2))
    top, end = y - thick / 2, half + thick / 2
    return [((y, -half), (0, -foot)), ((y, half), (0, foot)), ((top, -end), (top, end))], top


def _cross(draw: Draw, half: Number, y: Number, thick: Number) -> Frame:
    """Two crossing legs, maybe with a bar above and one below."""
    foot = half * draw.between(0.8, 1.1)
    lines: list[Line] = [((y, -half), (0, foot)), ((y, half), (0, -foot))]
    if draw.chance(0.5):
        lines.append(((y - thick / 2, -half), (y - thick / 2, half)))
    if draw.chance(0.25):
        lines.append(((thick / 2, -foot), (thick / 2, foot)))
    return lines, y * foot / (half + foot)


def _trestle_legs(draw: Draw, half: Number, y: Number, thick: Number) -> Frame:
    """Two legs that lean together, the bar on top of them and their crossbar."""
    head, share, top = half * draw.between(0.1, 0.7), draw.between(0.2, 0.6), y - thick / 2
    bar = half + (head - half) * share
    lines = [((y, -head), (0, -half)), ((y, head), (0, half)), ((top, -head), (top, head)),
             ((y * share, -bar), (y * share, bar))]  # fmt: skip
    return lines, y * share


def _tee(draw: Draw, half: Number, y: Number, thick: Number) -> Frame:
    """A column between a foot and a bearer."""
    bearer, low, top = half * draw.between(0.5, 1.0), thick / 2, y - thick / 2
    lines = [((y, 0), (low, 0)), ((low, -half), (low, half)), ((top, -bearer), (top, bearer))]
    return lines, y * draw.between(0.15, 0.95)


def _columns(draw: Draw, half: Number, y: Number, thick: Number) -> Frame:
    """Two columns on one foot."""
    z, low, top = half * draw.between(0.25, 0.6), thick / 2, y - thick / 2
    lines = [((y, -z), (low, -z)), ((y, z), (low, z)),
             ((low, -half), (low, half)), ((top, -half), (top, half))]  # fmt: skip
    return lines, top if draw.chance(0.6) else low


_LINES = {"loop": _loop, "arch": _arch, "X": _cross, "A": _trestle_legs, "T": _tee,
          "columns": _columns}  # fmt: skip


def pedestal(draw: Draw, top: Board) -> list[Part]:
    """A single central foot: an inn table's, a tulip, a turned column, a drum, crossing boards."""
    kind = draw.named("pedestal", {"disc": 0.22, "star": 0.18, "claw": 0.2, "tulip": 0.12,
                                   "cone": 0.12, "boards": 0.08, "post": 0.08})  # fmt: skip
    size = min(top.width, top.depth)
    under = top._replace(width=size, depth=size)
    scale = draw.between(1.2, 2.8) * min(1.3, 0.5 + size / 2)
    if kind == "disc":
        return pedestals.disc(draw, under._replace(width=size * 0.8), scale=scale)
    if kind == "star":
        return pedestals.star(draw, under, castors=False, reach=(0.32, 0.5), scale=scale)
    return _PEDESTALS[kind](draw, size, top.height - top.thickness)


def _claw(draw: Draw, size: Number, y: Number) -> list[Part]:
    """A turned column on three or four curved feet."""
    radius, low = draw.between(0.04, 0.1) * (0.6 + size / 2), y * draw.between(0.12, 0.35)
    bulges = radius * np.array([1.2, *(draw.between(0.5, 1.4) for _ in range(7)), 1.5])
    shaft = lathe(np.stack([bulges, np.linspace(low - 0.02, y, 9)], 1), sides=12)
    count, reach, thick = (
        draw.count(3, 4),
        size * draw.between(0.32, 0.5),
        radius * draw.between(0.5, 0.8),
    )
    angle = 2 * np.pi * (np.arange(count) + 0.5) / count + np.pi / 2
    t = np.linspace(0, 1, 7)
    fall = (1 - t) ** draw.between(1.0, 2.2) + draw.between(0.0, 0.15) * np.sin(np.pi * t)
    out, up = radius * 0.5 + (reach - radius * 0.5) * t, thick / 2 + low * fall
    x, z = np.cos(angle)[:, None] * out, np.sin(angle)[:, None] * out
    paths = np.stack([x, np.broadcast_to(up, x.shape), z], -1)
    return [shaft, tubes(paths, thick / 2 * np.linspace(1.4, 1, 7), sides=6)]


def _tulip(draw: Draw, size: Number, y: Number) -> list[Part]:
    """A stem that widens to its foot and to the top in one sweep."""
    foot, head, neck = size * draw.between(0.25, 0.4), size * draw.between(0.08, 0.3), draw.between(
        0.025, 0.06)  # fmt: skip
    t = np.linspace(0, 1, 12)
    power = draw.between(2.0, 5.0)
    radius = neck + (foot - neck) * (1 - t) ** power + (max(head, neck) - neck) * t**power
    return [lathe([(foot, 0.0), *zip(radius, 0.012 + (y - 0.012) * t, strict=True)], sides=20)]


def _cone(draw: Draw, size: Number, y: Number) -> list[Part]:
    """A drum, a cone upright or upside down, an hourglass."""
    foot, head = size * draw.between(0.2, 0.42), size * draw.between(0.12, 0.42)
    waist = (foot + head) / 2 * draw.between(0.6, 1.05)
    return [lathe([(foot, 0.0), (waist, y / 2), (head, y)], sides=8 if draw.chance(0.2) else 20)]


def _boards(draw: Draw, size: Number, y: Number) -> list[Part]:
    """Two boards that cross."""
    wide, thick = size * draw.between(0.5, 0.85), draw.between(0.02, 0.06)
    boards = [box((0, y / 2, 0), (wide, y, thick)), box((0, y / 2, 0), (thick, y, wide))]
    turned = np.pi / 4 if draw.chance(0.4) else 0.0
    return [turn(part, turned) for part in boards]


def _post(draw: Draw, size: Number, y: Number) -> list[Part]:
    """A square post, or a bundle of four, on a square plate."""
    foot, thick = size * draw.between(0.4, 0.7), draw.between(0.02, 0.06)
    plinth = plate(superellipse(draw.between(8, 40)), (foot, thick, foot), thick)
    if draw.chance(0.5):
        wide = draw.between(0.07, 0.3) * size
        return [plinth, box((0, y / 2, 0), (wide, y - thick, wide))]
    at, wide = draw.between(0.04, 0.12), draw.between(0.02, 0.05)
    posts = np.array([[s * at, thick / 2, c * at] for s in (-1, 1) for c in (-1, 1)])
    return [plinth, bars(posts, posts * (1, 0, 1) + np.array([0, y, 0]), wide)]


_PEDESTALS = {"claw": _claw, "tulip": _tulip, "cone": _cone, "boards": _boards, "post": _post}


def _two_pedestals(draw: Draw, top: Board) -> list[Part]:
    """The same pedestal under each half of a long top, sometimes joined by a beam."""
    x = top.width * draw.between(0.22, 0.32)
    one = pedestal(draw, top._replace(width=min(top.depth * 1.1, top.width * 0.5)))
    parts = [shift(part, (s * x, 0, 0)) for part in one for s in (-1, 1)]
    if draw.chance(0.4):
        y = top.height * draw.between(0.1, 0.5)
        parts.append(bars((-x, y, 0), (x, y, 0), draw.between(0.03, 0.1), 0.03))
    return parts


def sides(draw: Draw, top: Board) -> list[Part]:
    """Boards from the floor to the top at both ends, often with a back or a beam between them."""
    thick = draw.between(0.016, 0.08)
    under = corners(top)
    x, y = under.width / 2 - thick / 2, top.height - top.thickness
    depth = under.depth * (1.0 if draw.chance(0.5) else draw.between(0.7, 1.0))
    parts = [both_sides(box((x, y / 2, 0), (thick, y, depth)))]
    tie = draw.pick({"none": 0.45, "back": 0.25, "beam": 0.3})
    if tie == "back":
        parts.append(modesty_panel(draw, 2 * x, y, -depth / 2))
    elif tie == "beam":
        high, level = draw.between(0.04, 0.12), y * draw.between(0.15, 0.9)
        parts.append(bars((-x, level, 0), (x, level, 0), high, draw.between(0.02, 0.05)))
    return parts


def modesty_panel(draw: Draw, width: Number, y: Number, z: Number) -> Part:
    """The board at the back of a desk, down to the floor or not."""
    thick, inset = draw.between(0.012, 0.025), draw.between(0.0, 0.12)
    low = y * (draw.between(0.0, 0.1) if draw.chance(0.4) else draw.between(0.3, 0.75))
    return box((0, (low + y) / 2, z + thick / 2 + inset), (width, y - low, thick))


def _block(draw: Draw, top: Board) -> list[Part]:
    return pedestals.block(draw, top if draw.chance(0.5) else inside(top, draw.between(0.5, 0.95)))


_BASES = {
    "legs": _legs,
    "hairpin": _hairpin,
    "tripod": _tripod,
    "scissors": _scissors,
    "crossed": _crossed,
    "bows": _bows,
    "frames": _end_frames,
    "trestle": _trestle,
    "pedestal": pedestal,
    "two pedestals": _two_pedestals,
    "sides": sides,
    "block": _block,
}
