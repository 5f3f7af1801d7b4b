"""Seats of framed chairs: boards, pads, slats and slings on an optional apron."""

import numpy as np

from jaxshape.data.procedural.boards import Board, apron, outline_of, slats
from jaxshape.data.procedural.draw import Draw, Number, Range, Weights
from jaxshape.data.procedural.primitives import (
    Part,
    bars,
    cushion,
    plate,
    slab,
    superellipse,
)


def draw_seat(
    draw: Draw,
    *,
    width: Range = (0.38, 0.52),
    depth: Range = (0.35, 0.49),
    height: Range = (0.42, 0.48),
    round_chance: Number = 0.12,
) -> Board:
    """Draw a seat within the given ranges, with its taper and outline."""
    seat_width, seat_depth = draw.between(*width), draw.between(*depth)
    is_round = draw.chance(round_chance)
    if is_round:
        seat_depth = seat_width * draw.between(0.92, 1.05)
        exponent = 2.0
    else:
        exponent = draw.between(3.0, 8.0) if draw.chance(0.4) else draw.between(8.0, 40.0)
    return Board(
        width=seat_width,
        depth=seat_depth,
        height=draw.between(*height),
        thickness=draw.thick(0.006, 0.022) if draw.chance(0.25) else draw.thick(0.02, 0.06),
        exponent=exponent,
        taper=0.0 if is_round or draw.chance(0.5) else draw.between(0.02, 0.22),
    )


def seat_parts(
    draw: Draw, seat: Board, options: Weights, *, aprons: bool
) -> tuple[list[Part], Board]:
    """The parts of a seat, and the board to which legs attach (without parts on the frame)."""
    kind = draw.named("seat", options)
    if kind == "block":
        seat = seat._replace(thickness=draw.between(0.06, 0.14))
    parts = _SEATS[kind](draw, seat)
    structural = seat._replace(thickness=0.02) if kind in ("pad", "sling") else seat
    if aprons and seat.exponent > 2.5 and draw.chance(0.15 if kind == "block" else 0.5):
        parts += apron(draw, seat)
    return parts, structural


def _board(draw: Draw, seat: Board) -> list[Part]:
    size = (seat.width, seat.thickness, seat.depth)
    bevel = draw.between(0.0, 0.06) if draw.chance(0.4) else 0.0
    return [plate(outline_of(seat), size, seat.height, bevel)]


def _dished(draw: Draw, seat: Board) -> list[Part]:
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


def _pad(draw: Draw, seat: Board) -> list[Part]:
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


def _block(draw: Draw, seat: Board) -> list[Part]:
    """A thick upholstered or solid block that hangs below the seat's upper face."""
    center = (0.0, seat.height - seat.thickness / 2, 0.0)
    size = (seat.width, seat.thickness, seat.depth)
    return [cushion(center, size, outline=outline_of(seat), edge=draw.between(0.03, 0.2))]


def _sling(draw: Draw, seat: Board) -> list[Part]:
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
    "slats": slats,
    "sling": _sling,
}

FRAMED_SEATS = {"board": 0.32, "dished": 0.13, "pad": 0.3, "block": 0.16, "slats": 0.08,
                "sling": 0.01}  # fmt: skip
