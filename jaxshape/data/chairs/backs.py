"""Backs of framed chairs, all drawn on one bent surface: the rest."""

from typing import NamedTuple

import numpy as np

from jaxshape.data.procedural.boards import Board
from jaxshape.data.procedural.draw import Draw, Number, Range, Weights
from jaxshape.data.procedural.primitives import Part, slab, tubes


class Rest(NamedTuple):
    """The surface that a back lies in.

    Its coordinates are u in [-1, 1], from left to right, and v from 0 (seat) to 1 (top).

    Attributes:
        y: Height of the bottom, in metres.
        z: Place of the bottom along the depth of the chair, in metres.
        height: Height of the top above the bottom, in metres.
        half_bottom: Half the width at the bottom, in metres.
        half_top: Half the width at the top, in metres.
        lean: Distance of the top behind the bottom, in metres.
        bow: Distance of the middle height behind the chord, in metres.
        curve: Distance of the sides in front of the middle, in metres.
    """

    y: Number
    z: Number
    height: Number
    half_bottom: Number
    half_top: Number
    lean: Number
    bow: Number
    curve: Number

    def at(self, u: np.ndarray | float, v: np.ndarray | float) -> np.ndarray:
        """Points [..., 3] at (u, v), which broadcast; v may run past [0, 1]."""
        u, v = np.asarray(u, float), np.asarray(v, float)
        x = u * (self.half_bottom + (self.half_top - self.half_bottom) * v)
        y = self.y + self.height * v
        z = self.z - self.lean * v - self.bow * 4 * v * (1 - v)
        z = z + self.curve * (u * u - 1) * np.clip(v * 3, 0, 1)
        return np.stack(np.broadcast_arrays(x, y, z), -1)


def draw_rest(draw: Draw, seat: Board, height: Range = (0.34, 0.64)) -> Rest:
    """A rest that stands on the back edge of the seat."""
    z = -seat.depth / 2 + draw.between(0.0, 0.03)
    back = seat.half_width(z) * (1.0 if seat.exponent > 2.5 else 0.75)
    bottom = back * draw.between(0.82, 1.0)
    tall = draw.between(*height)
    return Rest(
        y=seat.height - 0.01,
        z=z,
        height=tall,
        half_bottom=bottom,
        half_top=bottom * (1.0 if draw.chance(0.4) else draw.between(0.8, 1.2)),
        lean=tall * (draw.between(0.0, 0.08) if draw.chance(0.5) else draw.between(0.06, 0.28)),
        bow=0.0 if draw.chance(0.6) else draw.between(-0.03, 0.03),
        curve=0.0 if draw.chance(0.4) else draw.between(0.01, 0.09),
    )


def back_parts(draw: Draw, rest: Rest, options: Weights) -> list[Part]:
    return _BACKS[draw.named("back", options)](draw, rest)


def sheet(
    rest: Rest,
    u: Range,
    v: Range,
    thickness: Number,
    *,
    top: Number = 0.0,
    bottom: Number = 0.0,
    power: Number = 2.0,
    narrow: Number = 0.0,
) -> Part:
    """A piece of the rest; `top` and `bottom` lift its edges in the middle, `narrow` its waist."""
    across = np.linspace(u[0], u[1], 9)
    down = np.linspace(0, 1, 6)[:, None]
    arch = 1 - np.abs(np.linspace(-1, 1, 9)) ** power
    low, high = v[0] + bottom * arch, v[1] - top * (1 - arch)
    waist = 1 - narrow * 4 * down * (1 - down)
    return slab(rest.at(across * waist, low + (high - low) * down), thickness)


def posts(draw: Draw, rest: Rest, *, low: Number = 0.0, high: float = 1.0) -> Part:
    """The two uprights; square or round."""
    sides = 8 if draw.chance(0.35) else 4
    thick = draw.thick(0.008, 0.022)
    v = np.linspace(low, high, 6)
    paths = np.stack([rest.at(-1.0, v), rest.at(1.0, v)])
    taper = np.linspace(1.0, draw.between(0.6, 1.0), 6)
    return tubes(paths, thick * draw.between(0.8, 1.4) * taper, across=thick, sides=sides)


def _solid(draw: Draw, rest: Rest) -> list[Part]:
    low = 0.0 if draw.chance(0.7) else draw.between(0.02, 0.15)
    arch = 0.0 if draw.chance(0.5) else draw.between(0.03, 0.35)
    board = sheet(rest, (-1, 1), (low, 1), _board_or_pad(draw), top=arch,
                  power=draw.between(2, 6),
                  narrow=draw.between(0, 0.15) if draw.chance(0.3) else 0.0)  # fmt: skip
    return [board] if low == 0.0 else [board, posts(draw, rest, high=low + 0.2)]


def _board_or_pad(draw: Draw) -> float:
    return draw.thick(0.005, 0.028) if draw.chance(0.5) else draw.between(0.03, 0.12)


def _panel(draw: Draw, rest: Rest) -> list[Part]:
    """Two posts that carry one panel well above the seat."""
    low = draw.between(0.2, 0.65)
    panel = sheet(rest, (-1, 1), (low, 1), _board_or_pad(draw), top=draw.between(0, 0.15),
                  bottom=draw.between(0, 0.05))  # fmt: skip
    center_post = draw.chance(0.15)
    if center_post:
        path = rest.at(0.0, np.linspace(-0.05, low + 0.2, 5))
        return [panel, tubes(path, 0.012, across=draw.between(0.02, 0.06), sides=4)]
    return [panel, posts(draw, rest, high=draw.between(low + 0.1, 1.0))]


def _ladder(draw: Draw, rest: Rest) -> list[Part]:
    """Horizontal slats between two posts."""
    count, thick = draw.count(2, 6), draw.thick(0.008, 0.02)
    low, share = draw.between(0.1, 0.45), draw.between(0.35, 0.85)
    pitch, wave = (1 - low) / count, draw.between(0.0, 0.12) / count
    crest = draw.between(1.0, 1.4)
    slats = [
        sheet(rest, (-1, 1), (low + pitch * i, low + pitch * (i + share * (
            crest if i == count - 1 else 1))), thick, top=-wave, bottom=wave)
        for i in range(count)
    ]  # fmt: skip
    return [posts(draw, rest, high=low + pitch * (count - 1 + share)), *slats]


def _rails(draw: Draw, rest: Rest, bottom: bool) -> tuple[list[Part], float, float]:
    """Posts, a crest rail and maybe a lower rail; with the two heights between them."""
    crest, arch = draw.between(0.07, 0.25), draw.between(-0.05, 0.12)
    thick = draw.thick(0.01, 0.026)
    frame = [posts(draw, rest, high=1 - crest * draw.between(0.05, 0.9)),
             sheet(rest, (-1.05, 1.05), (1 - crest, 1), thick, top=arch)]  # fmt: skip
    low = draw.between(0.08, 0.3) if bottom else 0.0
    if bottom:
        frame.append(sheet(rest, (-1, 1), (low - 0.06, low), thick))
    return frame, low, 1 - crest


def _slatted(draw: Draw, rest: Rest) -> list[Part]:
    """Upright slats between a crest rail and the seat or a lower rail."""
    frame, low, high = _rails(draw, rest, draw.chance(0.5))
    return frame + _uprights(draw, rest, low, high, count=draw.count(1, 9), flat=True)


def _spindle(draw: Draw, rest: Rest) -> list[Part]:
    frame, low, high = _rails(draw, rest, draw.chance(0.2))
    return frame + _uprights(draw, rest, low, high, count=draw.count(3, 9), flat=False)


def _uprights(
    draw: Draw, rest: Rest, low: Number, high: float, *, count: int, flat: bool
) -> list[Part]:
    """Slats or spindles at even places between v = low and v = high."""
    at = np.linspace(-1, 1, count + 2)[1:-1]
    share = draw.between(0.25, 0.75)
    v = np.linspace(low - 0.03, high + 0.02, 5)
    paths = rest.at(at[:, None], v)
    if flat:
        width = rest.half_bottom / (count + 1) * share
        return [tubes(paths, draw.between(0.004, 0.009), across=width, sides=4)]
    return [tubes(paths, draw.between(0.005, 0.011) * np.array([0.8, 1.2, 1.4, 1.1, 0.8]), sides=6)]


def _arch(rest: Rest, *, inner: Number = 1.0, shoulder: Number = 0.5) -> np.ndarray:
    """The path of a hoop: up one side, over the top, down the other."""
    angle = np.linspace(0, np.pi, 15)[1:-1]
    u, v = np.cos(angle), shoulder + (inner - shoulder) * np.sin(angle)
    u = np.sign(u) * np.abs(u) ** 0.8
    u, v = np.r_[1, 1, u, -1, -1], np.r_[0, shoulder / 2, v, shoulder / 2, 0]
    return rest.at(u * inner, v)


def _hoop(draw: Draw, rest: Rest) -> list[Part]:
    """A bent hoop, empty or filled by spindles, an inner hoop, a splat or a panel."""
    shoulder, thick = draw.between(0.3, 0.8), draw.thick(0.009, 0.018)
    hoop = tubes(_arch(rest, shoulder=shoulder), thick, across=thick * draw.between(0.8, 1.5))
    filling = draw.named("hoop", {"spindles": 0.4, "inner": 0.2, "panel": 0.3, "open": 0.1})
    if filling == "spindles":
        count = draw.count(3, 8)
        at = np.linspace(-1, 1, count + 2)[1:-1]
        top = shoulder + (1 - shoulder) * np.sqrt(1 - np.abs(at) ** 2.5)
        paths = rest.at(at[:, None] * 0.98, np.linspace(0, 1, 5) * top[:, None])
        return [hoop, tubes(paths, draw.between(0.005, 0.009), sides=6)]
    if filling == "inner":
        return [hoop, tubes(_arch(rest, inner=draw.between(0.55, 0.8), shoulder=shoulder * 0.7),
                            thick * 0.8)]  # fmt: skip
    if filling == "panel":
        low, pad = draw.between(0.0, 0.4), draw.between(0.01, 0.06)
        return [hoop, sheet(rest, (-0.95, 0.95), (low, 0.98), pad, top=(1 - shoulder) * 0.9,
                            power=3)]  # fmt: skip
    return [hoop]


def _ring(draw: Draw, rest: Rest) -> list[Part]:
    """An oval ring or medallion on two short posts, open, crossed or padded."""
    center, half = draw.between(0.5, 0.62), draw.between(0.36, 0.42)
    angle = 2 * np.pi * np.arange(20) / 20
    wide = draw.between(0.75, 1.0)
    path = rest.at(wide * np.cos(angle), center + half * np.sin(angle))
    thick = draw.between(0.01, 0.022)
    parts = [tubes(path, thick, loop=True)]
    gap = center - half * draw.between(0.6, 0.95)
    legs = np.stack([rest.at(s * wide * 0.6, np.linspace(-0.05, gap, 4)) for s in (-1, 1)])
    parts.append(tubes(legs, thick))
    filling = draw.named("ring", {"pad": 0.55, "open": 0.2, "slat": 0.25})
    if filling == "pad":
        radial = np.linspace(0.02, 1, 4)[:, None]
        face = rest.at(radial * wide * np.cos(angle), center + radial * half * np.sin(angle))
        face = np.concatenate([face, face[:, :1]], 1)
        parts.append(slab(face, draw.between(0.015, 0.05) * (1.2 - radial * 0.6)))
    if filling == "slat":
        parts += _uprights(draw, rest, center - half, center + half, count=draw.count(1, 3),
                           flat=True)  # fmt: skip
    return parts


def _cross(draw: Draw, rest: Rest) -> list[Part]:
    """Two crossing bars between crest rail and lower rail."""
    frame, low, high = _rails(draw, rest, draw.chance(0.6))
    t = np.linspace(0, 1, 5)
    paths = np.stack([rest.at(s * (1 - 2 * t), low + (high - low) * t) for s in (-1, 1)])
    return [*frame, tubes(paths, draw.between(0.006, 0.011), across=draw.between(0.008, 0.022),
                          sides=4)]  # fmt: skip


def _splat(draw: Draw, rest: Rest) -> list[Part]:
    """A broad, waisted splat in the middle."""
    frame, low, high = _rails(draw, rest, draw.chance(0.3))
    half = draw.between(0.15, 0.45)
    return [*frame, sheet(rest, (-half, half), (low - 0.02, high + 0.02), draw.between(0.008, 0.02),
                          narrow=draw.between(-0.3, 0.6))]  # fmt: skip


def _frame(draw: Draw, rest: Rest) -> list[Part]:
    """A closed frame with a cloth, a lattice or nothing inside."""
    crest = draw.between(0.05, 0.12)
    parts = [posts(draw, rest), sheet(rest, (-1, 1), (1 - crest, 1), draw.between(0.015, 0.03))]
    filling = draw.named("frame", {"cloth": 0.5, "lattice": 0.25, "open": 0.1, "low rail": 0.15})
    low = draw.between(0.0, 0.3)
    if filling != "open":
        parts.append(sheet(rest, (-1, 1), (low, low + 0.08), draw.between(0.012, 0.025)))
    if filling == "cloth":
        parts.append(sheet(rest, (-1, 1), (low, 1), draw.between(0.005, 0.03)))
    if filling == "lattice":
        count = draw.count(2, 4)
        v = np.linspace(low, 1, count + 2)[1:-1]
        cross = rest.at(np.linspace(-1, 1, 7), v[:, None])
        parts.append(tubes(cross, 0.008, sides=4))
        parts += _uprights(draw, rest, low, 1 - crest, count=draw.count(2, 5), flat=True)
    return parts


def _pads(draw: Draw, rest: Rest) -> list[Part]:
    """Two or three pads one above the other, on a spine."""
    count, gap = draw.count(1, 3), draw.between(0.02, 0.12)
    low = draw.between(0.05, 0.4)
    pitch, thick = (1 - low) / count, draw.between(0.03, 0.1)
    parts = [
        sheet(rest, (-1, 1), (low + pitch * i, low + pitch * (i + 1) - gap * pitch), thick,
              top=draw.between(0, 0.3) * pitch, bottom=draw.between(0, 0.2) * pitch, power=3)
        for i in range(count)
    ]  # fmt: skip
    spine = rest.at(0.0, np.linspace(-0.15, 0.7, 5)) - np.array([0, 0, thick / 2])
    if draw.chance(0.6):
        return [*parts, tubes(spine, 0.012, across=draw.between(0.015, 0.05), sides=4)]
    return [*parts, posts(draw, rest, low=-0.05, high=0.8)]


_BACKS = {
    "solid": _solid,
    "panel": _panel,
    "ladder": _ladder,
    "slatted": _slatted,
    "spindle": _spindle,
    "hoop": _hoop,
    "ring": _ring,
    "cross": _cross,
    "splat": _splat,
    "frame": _frame,
    "pads": _pads,
}

FRAMED_BACKS = {"solid": 0.26, "panel": 0.15, "ladder": 0.14, "slatted": 0.12, "spindle": 0.07,
                "hoop": 0.08, "ring": 0.05, "cross": 0.04, "splat": 0.05, "frame": 0.08,
                "pads": 0.03}  # fmt: skip
