"""Seats of framed chairs: boards, pads, slats and slings on an optional apron."""

from typing import NamedTuple

import numpy as np

from jaxshape.data.chairs.draw import Draw, Number, Range, Weights
from jaxshape.data.chairs.primitives import (
    Part,
    bars,
    box,
    cushion,
    plate,
    shift,
    slab,
    superellipse,
)


class Seat(NamedTuple):
    """The size of a seat, in metres, about x = z = 0.

    Attributes:
        width: Extent along x.
        depth: Extent along z.
        height: Height of its upper face above the floor.
        thickness: Extent along y.
        exponent: Exponent of the outline's superellipse: 2 is round, 10 square.
        taper: Share of the width by which the back edge is narrower.
    """

    width: Number
    depth: Number
    height: Number
    thickness: Number = 0.03
    exponent: Number = 8.0
    taper: Number = 0.0

    def half_width(self, z: Number) -> float:
        """Half the seat's width at depth z."""
        return self.width / 2 * (1 - self.taper * (0.5 - z / self.depth))


def draw_seat(
    draw: Draw,
    *,
    width: Range = (0.38, 0.52),
    depth: Range = (0.35, 0.49),
    height: Range = (0.42, 0.48),
    round_chance: Number = 0.12,
) -> Seat:
    """A seat within the given ranges; the taper and the outline follow."""
    seat_width, seat_depth = draw.between(*width), draw.between(*depth)
    is_round = draw.chance(round_chance)
    if is_round:
        seat_depth = seat_width * draw.between(0.92, 1.05)
        exponent = 2.0
    else:
        exponent = draw.between(3.0, 8.0) if draw.chance(0.4) else draw.between(8.0, 40.0)
    return Seat(
        width=seat_width,
        depth=seat_depth,
        height=draw.between(*height),
        thickness=draw.thick(0.006, 0.022) if draw.chance(0.25) else draw.thick(0.02, 0.06),
        exponent=exponent,
        taper=0.0 if is_round or draw.chance(0.5) else draw.between(0.02, 0.22),
    )


def seat_parts(
    draw: Draw, seat: Seat, options: Weights, *, aprons: bool
) -> tuple[list[Part], Seat]:
    """The parts of a seat, and the seat as its legs see it (without what lies on the frame)."""
    kind = draw.named("seat", options)
    if kind == "block":
        seat = seat._replace(thickness=draw.between(0.06, 0.14))
    parts = _SEATS[kind](draw, seat)
    structural = seat._replace(thickness=0.02) if kind in ("pad", "sling") else seat
    if aprons and seat.exponent > 2.5 and draw.chance(0.15 if kind == "block" else 0.5):
        parts += apron(draw, seat)
    return parts, structural


def apron(draw: Draw, seat: Seat) -> list[Part]:
    """Four rails under the seat, between the legs."""
    height, thick = draw.between(0.03, 0.08), draw.between(0.015, 0.03)
    front = seat.depth / 2 - draw.between(0.01, 0.03)
    y = seat.height - seat.thickness - height / 2
    corners = np.array(
        [[s * (seat.half_width(z) - 0.025), y, z] for z, s in
         ((front, -1), (front, 1), (-front, 1), (-front, -1))])  # fmt: skip
    return [bars(corners, np.roll(corners, -1, 0), thick, height)]


def outline_of(seat: Seat) -> np.ndarray:
    return superellipse(seat.exponent, taper=seat.taper)


def _board(draw: Draw, seat: Seat) -> list[Part]:
    size = (seat.width, seat.thickness, seat.depth)
    bevel = draw.between(0.0, 0.06) if draw.chance(0.4) else 0.0
    return [plate(outline_of(seat), size, seat.height, bevel)]


def _dished(draw: Draw, seat: Seat) -> list[Part]:
    """A bent board: a rolled front edge, a hollow, a rising back."""
    v = np.linspace(-1, 1, 7)[:, None]
    u = np.linspace(-1, 1, 7)
    roll, hollow, side = draw.between(0, 0.04), draw.between(0, 0.03), draw.between(-0.015, 0.03)
    half = seat.width / 2 * (1 - seat.taper * (1 - v) / 2)
    corner = draw.between(0.0, 0.12)
    half = half * (1 - corner * np.abs(v) ** 5)
    y = seat.height - seat.thickness / 2 - roll * np.clip(v, 0, 1) ** 3
    y = y - hollow * (1 - v * v) * (1 - u * u) + side * u * u
    surface = np.stack(np.broadcast_arrays(u * half, y, v * seat.depth / 2), -1)
    return [slab(surface, seat.thickness)]


def _pad(draw: Draw, seat: Seat) -> list[Part]:
    thick = draw.between(0.035, 0.11)
    center = (0.0, seat.height - 0.02 + thick / 2, 0.0)
    pad = cushion(
        center,
        (seat.width, thick, seat.depth),
        outline=outline_of(seat),
        edge=draw.between(0.1, 0.45),
        crown=draw.between(0.0, 0.025),
    )
    if draw.chance(0.4):
        return [pad]
    rim = superellipse(seat.exponent, taper=seat.taper)
    return [pad, plate(rim, (seat.width, 0.025, seat.depth), seat.height - 0.005)]


def _block(draw: Draw, seat: Seat) -> list[Part]:
    """A thick upholstered or solid block that hangs below the seat's upper face."""
    center = (0.0, seat.height - seat.thickness / 2, 0.0)
    size = (seat.width, seat.thickness, seat.depth)
    return [cushion(center, size, outline=outline_of(seat), edge=draw.between(0.03, 0.2))]


def _slats(draw: Draw, seat: Seat) -> list[Part]:
    """Boards side by side, from left to right or from front to back, on two bearers."""
    count, share = draw.count(3, 9), draw.between(0.6, 0.9)
    across = draw.chance(0.7)
    length = seat.depth if across else seat.width
    at = (np.arange(count) + 0.5) / count * length - length / 2
    zero, width = np.zeros(count), length / count * share
    y = zero + seat.height - seat.thickness / 2
    dip = draw.between(0.0, 0.025)
    if across:
        y = y - dip * (1 - (2 * at / length) ** 2)
        half = np.array([seat.half_width(z) for z in at])
        starts, ends = np.stack([-half, y, at], 1), np.stack([half, y, at], 1)
        side = seat.half_width(-seat.depth / 2) - 0.02
        bearer = box((side, seat.height - 0.035, 0), (0.02, 0.03, seat.depth * 0.96))
        bearers = [bearer, shift(bearer, (-2 * side, 0, 0))]
    else:
        starts = np.stack([at, y, zero - seat.depth / 2], 1)
        ends = np.stack([at, y, zero + seat.depth / 2], 1)
        bearers = [box((0, seat.height - 0.035, s * seat.depth * 0.42),
                       (seat.width * 0.96, 0.03, 0.02)) for s in (-1, 1)]  # fmt: skip
    return [bars(starts, ends, width, seat.thickness * 0.6), *bearers]


def _sling(draw: Draw, seat: Seat) -> list[Part]:
    """A sagging cloth or a woven seat."""
    v, u = np.linspace(-1, 1, 5)[:, None], np.linspace(-1, 1, 7)
    sag = draw.between(0.01, 0.06)
    half = seat.width / 2 * (1 - seat.taper * (1 - v) / 2)
    y = seat.height - sag * (1 - u * u) + 0 * v
    surface = np.stack(np.broadcast_arrays(u * half, y, v * seat.depth / 2), -1)
    rails = np.array([[half[0, 0], seat.height, -seat.depth / 2],
                      [half[-1, 0], seat.height, seat.depth / 2]])  # fmt: skip
    rail = bars(rails[:1], rails[1:], 0.02, sides=8)
    mirrored = rail._replace(vertices=rail.vertices * (-1, 1, 1))
    return [slab(surface, draw.between(0.004, 0.012)), rail, mirrored]


_SEATS = {
    "board": _board,
    "dished": _dished,
    "pad": _pad,
    "block": _block,
    "slats": _slats,
    "sling": _sling,
}

FRAMED_SEATS = {"board": 0.32, "dished": 0.13, "pad": 0.3, "block": 0.16, "slats": 0.08,
                "sling": 0.01}  # fmt: skip
