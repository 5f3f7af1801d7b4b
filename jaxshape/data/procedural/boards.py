"""Horizontal boards, and the rails under them."""

from typing import NamedTuple

import numpy as np

from jaxshape.data.procedural.draw import Draw, Number
from jaxshape.data.procedural.primitives import Part, bars, box, shift, superellipse


class Board(NamedTuple):
    """A horizontal board centred at x = z = 0, such as a seat or a table top, in metres.

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
        """Half the board's width at depth z."""
        return self.width / 2 * (1 - self.taper * (0.5 - z / self.depth))


def outline_of(board: Board) -> np.ndarray:
    return superellipse(board.exponent, taper=board.taper)


def apron(draw: Draw, board: Board, scale: Number = 1.0) -> list[Part]:
    """Four rails under the board, between the legs: `scale` times as high as a chair's."""
    height, thick = scale * draw.between(0.03, 0.08), draw.between(0.015, 0.03)
    front = board.depth / 2 - draw.between(0.01, 0.03)
    y = board.height - board.thickness - height / 2
    corners = np.array(
        [[s * (board.half_width(z) - 0.025), y, z] for z, s in
         ((front, -1), (front, 1), (-front, 1), (-front, -1))])  # fmt: skip
    return [bars(corners, np.roll(corners, -1, 0), thick, height)]


def slats(draw: Draw, board: Board) -> list[Part]:
    """Boards side by side, from left to right or from front to back, on two bearers."""
    count, share = draw.count(3, 9), draw.between(0.6, 0.9)
    across = draw.chance(0.7)
    length = board.depth if across else board.width
    at = (np.arange(count) + 0.5) / count * length - length / 2
    zero, width = np.zeros(count), length / count * share
    y = zero + board.height - board.thickness / 2
    dip = draw.between(0.0, 0.025)
    if across:
        y = y - dip * (1 - (2 * at / length) ** 2)
        half = np.array([board.half_width(z) for z in at])
        starts, ends = np.stack([-half, y, at], 1), np.stack([half, y, at], 1)
        side = board.half_width(-board.depth / 2) - 0.02
        bearer = box((side, board.height - 0.035, 0), (0.02, 0.03, board.depth * 0.96))
        bearers = [bearer, shift(bearer, (-2 * side, 0, 0))]
    else:
        starts = np.stack([at, y, zero - board.depth / 2], 1)
        ends = np.stack([at, y, zero + board.depth / 2], 1)
        bearers = [box((0, board.height - 0.035, s * board.depth * 0.42),
                       (board.width * 0.96, 0.03, 0.02)) for s in (-1, 1)]  # fmt: skip
    return [bars(starts, ends, width, board.thickness * 0.6), *bearers]
