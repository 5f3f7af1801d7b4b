"""Seats and backs in one surface: bent shells, tubs, and the long beds of lounge chairs."""

from typing import NamedTuple

import numpy as np

from jaxshape.data.procedural.boards import Board
from jaxshape.data.procedural.draw import Draw, Number, Range
from jaxshape.data.procedural.primitives import (
    Part,
    bars,
    bend,
    both_sides,
    loft,
    slab,
    superellipse,
    tubes,
    unit,
)

# Denser at both ends, where the outline has its corners.
_STATIONS = 0.5 * np.linspace(0, 1, 20) + 0.25 * (1 - np.cos(np.pi * np.linspace(0, 1, 20)))


class Profile(NamedTuple):
    """A side view of a shell, from the front edge to the top of the back.

    Attributes:
        points: Points `[points 2]` as (z, y), in metres.
        normals: Unit normals towards the sitter `[points 2]`.
        share: Share of the arc length `[points]`, from 0 at the front edge to 1 at the top.
    """

    points: np.ndarray
    normals: np.ndarray
    share: np.ndarray


def bent_profile(corners: list[Range], radius: Number) -> Profile:
    """Round the corners of a side view given as (z, y)."""
    path = bend([(0.0, y, z) for z, y in corners], radius, steps=6)[:, :0:-1]
    length = np.r_[0, np.cumsum(np.sqrt((np.diff(path, axis=0) ** 2).sum(1)))]
    share = _STATIONS
    points = np.stack([np.interp(share, length / length[-1], c) for c in path.T], 1)
    ends = points[[0, *range(len(points)), -1]]
    tangent = unit(ends[2:] - ends[:-2])
    return Profile(points, np.stack([tangent[:, 1], -tangent[:, 0]], 1), share)


def swept(
    profile: Profile,
    half_width: np.ndarray,
    curl: np.ndarray,
    thickness: Number | np.ndarray,
    power: Number = 2.0,
    columns: int = 9,
) -> Part:
    """A profile swept from left to right; `curl` lifts the sides toward the sitter."""
    u = np.linspace(-1, 1, columns)
    lift = curl[:, None] * np.abs(u) ** power
    z = profile.points[:, :1] + profile.normals[:, :1] * lift
    y = profile.points[:, 1:] + profile.normals[:, 1:] * lift
    return slab(np.stack([half_width[:, None] * u, y, z], 2), thickness)


def shell_parts(draw: Draw, seat: Board, height: Range = (0.3, 0.5)) -> list[Part]:
    """A shell chair's surface: seat and back bent from one sheet, flat, dished or armed."""
    depth, tall = seat.depth, draw.between(*height)
    lean = tall * draw.between(0.05, 0.35)
    lip, rear = draw.between(-0.03, 0.03), draw.between(-0.02, 0.03)
    kind = draw.named("shell", {"flat": 0.35, "dished": 0.35, "bucket": 0.3})
    corners = [(depth / 2, seat.height - lip), (depth * 0.3, seat.height),
               (-depth / 2 + 0.04, seat.height - rear), (-depth / 2 - lean * 0.5,
               seat.height + tall * 0.5), (-depth / 2 - lean, seat.height + tall)]  # fmt: skip
    # A side that rises by more than the radius of the bend would intersect itself.
    radius = draw.between(0.12, 0.22) if kind == "bucket" else draw.between(0.05, 0.16)
    profile = bent_profile(corners, radius)
    share = profile.share
    waist = draw.between(0.0, 0.35) if draw.chance(0.4) else draw.between(-0.05, 0.05)
    top = draw.between(0.7, 1.05)
    width = np.interp(share, [0, 0.35, 0.55, 0.75, 1], [1, 1, 1 - waist, 0.5 + top / 2, top])
    width = width * _corner(draw, share) * _corner(draw, 1 - share)
    curl = {"flat": draw.between(-0.01, 0.02), "dished": draw.between(0.02, 0.07),
            "bucket": radius * draw.between(0.5, 0.95)}[kind]  # fmt: skip
    if kind == "bucket":
        rise = np.interp(share, [0, 0.25, 0.5, 0.75, 1], [0.15, 0.8, 1, 0.7, 0.25])
        width = width * draw.between(1.0, 1.3)
    else:
        rise = np.interp(share, [0, 0.4, 0.6, 1], [0.3, 0.8, 1, draw.between(0.3, 1)])
    thickness = draw.between(0.008, 0.025) if draw.chance(0.7) else draw.between(0.025, 0.06)
    power = draw.between(1.8, 3.5)
    shell = swept(profile, seat.width / 2 * width, curl * rise, thickness, power)
    parts = [shell]
    if draw.chance(0.2):
        parts.append(_lining(draw, profile, seat, width, curl * rise, power))
    return parts


def _corner(draw: Draw, share: np.ndarray) -> np.ndarray:
    """The factor on the width that rounds the far end of a profile."""
    length, tip = draw.between(0.04, 0.3), draw.between(0.3, 0.97)
    into = np.clip((share - 1 + length) / length, 0, 1)
    return np.sqrt(1 - (1 - tip * tip) * into ** draw.between(1.5, 4))


def _lining(
    draw: Draw, profile: Profile, seat: Board, width: np.ndarray, curl: np.ndarray, power: Number
) -> Part:
    """A pad that lines the shell, all of it or only the seat."""
    end = draw.between(0.4, 1.0)
    rows = np.flatnonzero((profile.share > 0.05) & (profile.share < end))
    thick = draw.between(0.025, 0.06)
    inner = Profile(profile.points[rows] + profile.normals[rows] * thick / 2, profile.normals[rows],
                    profile.share[rows])  # fmt: skip
    return swept(inner, seat.width * 0.44 * width[rows], curl[rows] * 0.8, thick, power)


def padded_parts(draw: Draw, seat: Board) -> list[Part]:
    """A thick reclined shell, with stuffed arms and a head-rest now and then."""
    tall, depth = draw.between(0.42, 0.75), seat.depth
    lean = tall * draw.between(0.12, 0.6)
    rise = draw.between(0.0, 0.08)
    corners = [(depth / 2, seat.height), (-depth / 2 + 0.06, seat.height - rise),
               (-depth / 2 - lean * 0.6, seat.height + tall * 0.6),
               (-depth / 2 - lean * draw.between(0.75, 1.0), seat.height + tall)]  # fmt: skip
    radius = draw.between(0.08, 0.2)
    profile = bent_profile(corners, radius)
    share = profile.share
    thick = draw.between(0.06, 0.2) * np.interp(
        share, [0, 0.05, 0.3, 0.55, 0.95, 1], [0.5, 1, 1.1, draw.between(0.5, 1), 0.7, 0.35]
    )
    top = draw.between(0.6, 1.05)
    width = np.interp(share, [0, 0.5, 1], [draw.between(0.85, 1), 1, top]) * _corner(draw, share)
    curl = radius * (draw.between(0.0, 0.3) if draw.chance(0.6) else draw.between(0.3, 0.8))
    wrap = curl * np.interp(share, [0, 0.25, 0.55, 1], [0.3, 1, 1, 0.2])
    parts = [swept(profile, seat.width / 2 * width, wrap, thick[:, None], 3.0)]
    if draw.chance(0.4):
        parts.append(_stuffed_side(draw, seat, lean))
    if draw.chance(0.35):
        head = profile.points[-1] + profile.normals[-1] * draw.between(0.0, 0.06)
        end = np.array([seat.width * draw.between(0.25, 0.42), head[1], head[0]])
        parts.append(bars(end * (-1, 1, 1), end, draw.between(0.08, 0.15), draw.between(0.1, 0.2),
                          sides=10))  # fmt: skip
    return parts


def _stuffed_side(draw: Draw, seat: Board, lean: float) -> Part:
    """Both arms as thick panels that rise to the back."""
    thick, low = draw.between(0.05, 0.14), seat.height - draw.between(0.05, 0.25)
    z = np.linspace(-seat.depth / 2 - lean * 0.3, seat.depth / 2 - draw.between(-0.03, 0.1), 6)
    slope = draw.between(-0.05, 0.15)
    top = seat.height + draw.between(0.12, 0.24) + slope * np.linspace(1, -0.5, 6)
    v = np.linspace(0, 1, 4)[:, None]
    flare = draw.between(-0.03, 0.06) * v
    surface = np.stack(np.broadcast_arrays(seat.width / 2 + flare, low + (top - low) * v, z), -1)
    return both_sides(slab(surface, thick * (0.6 + 0.4 * v)))


def tub(
    draw: Draw,
    width: Number,
    depth: Number,
    low: Number,
    seat_height: Number,
    *,
    tall: Range = (0.2, 0.45),
    thickness: Range = (0.02, 0.06),
    bottom: Range = (0.5, 1.0),
) -> Part:
    """A seat in a wall that wraps round it and falls to the front: one surface, nothing inside.

    `bottom` is the ratio of the sizes of the underside, at height `low`, and the seat.
    """
    outline = superellipse(draw.between(2.0, 6.0), 32)
    if draw.chance(0.3):  # round behind, square in front
        outline = np.where(outline[:, 1:] > 0, superellipse(draw.between(5.0, 14.0), 32), outline)
    around = np.arctan2(outline[:, 0], -outline[:, 1])  # 0 at the back, pi at the front
    back, level = draw.between(*tall), draw.between(0.3, 1.0)
    opening = np.radians(draw.between(85, 150))
    fall = np.clip(np.abs(around) / opening, 0, 1) ** draw.between(1, 4)
    wall = back * (level + (1 - level) * np.cos(np.pi / 2 * fall))
    wall = wall * np.clip((opening + 0.25 - np.abs(around)) / 0.25, 0, 1)
    thick, crown = draw.between(*thickness), draw.between(-0.02, 0.04)
    inner, flare = 1 - 2 * thick / min(width, depth), draw.between(-0.05, 0.2)
    foot, round_off = draw.between(*bottom), draw.between(0.0, 0.6)
    rise = wall / back
    lip = thick * draw.between(0.0, 0.5) * rise
    sizes = [0.05, 0.7 * inner, inner, inner + flare * rise, (1 + inner) / 2 + flare * rise,
             1 + flare * rise, 1.0, foot + (1 - foot) * round_off, foot, 0.05]  # fmt: skip
    middle = low + (seat_height - low) * draw.between(0.1, 0.5)
    heights = [
        seat_height + crown,
        seat_height + crown,
        seat_height,
        seat_height + wall - lip,
        seat_height + wall,
        seat_height + wall - lip,
        seat_height - 0.02,
        middle,
        low,
        low,
    ]
    rings = np.empty((len(sizes), len(outline), 3))
    for ring, size, height in zip(rings, sizes, heights, strict=True):
        ring[:, 0::2] = outline * np.reshape(size, (-1, 1)) * (width / 2, depth / 2)
        ring[:, 1] = height
    lean = draw.between(0.0, 0.3) * np.clip(rings[:, :, 1] - seat_height, 0, None)
    rings[:, :, 2] -= lean * np.cos(around / 2) ** 2
    return loft(rings)


def lounge_parts(draw: Draw) -> list[Part]:
    """A recliner, deck chair, sun lounger or chaise: a long bent bed on a low frame."""
    kind = draw.named("lounge", {"recliner": 0.35, "deck": 0.25, "lounger": 0.25, "chaise": 0.15})
    width = draw.between(0.5, 0.75)
    thick = draw.between(0.006, 0.03) if draw.chance(0.5) else draw.between(0.05, 0.14)
    if kind == "deck":
        return _deck_chair(draw, width)
    if kind == "lounger":
        high, bed, rest = draw.between(0.22, 0.42), draw.between(0.9, 1.4), draw.between(0.5, 1.05)
        angle = np.radians(draw.between(15, 70) if draw.chance(0.85) else 0)
        corners = [(bed, high), (0.0, high), (-rest * np.cos(angle), high + rest * np.sin(angle))]
    elif kind == "chaise":
        high, knee = draw.between(0.22, 0.32), draw.between(0.4, 0.55)
        corners = [(1.2, knee - draw.between(0.05, 0.2)), (0.65, knee), (0.1, high),
                   (-0.45, draw.between(0.55, 0.75)), (-0.62, draw.between(0.75, 0.9))]  # fmt: skip
    else:
        high, tall = draw.between(0.32, 0.44), draw.between(0.45, 0.75)
        angle = np.radians(draw.between(15, 50))
        corners = [(0.55, high), (0.0, high - draw.between(0.02, 0.1)),
                   (-tall * np.sin(angle), high + tall * np.cos(angle))]  # fmt: skip
        if draw.chance(0.35):
            corners.insert(0, (0.95, high * draw.between(0.3, 1.0)))
    profile = bent_profile(corners, draw.between(0.04, 0.2))
    if draw.chance(0.35):
        parts = _bed_slats(draw, profile, width)
    else:
        half = np.full(len(profile.share), width / 2)
        parts = [swept(profile, half, half * draw.between(0, 0.06), thick, columns=5)]
    if draw.chance(0.25):
        head = unit(profile.points[-1] - profile.points[-2])
        center = profile.points[-1] - head * 0.1 + profile.normals[-1] * (thick / 2 + 0.03)
        end = np.array([width * 0.4, center[1], center[0]])
        parts.append(bars(end * (-1, 1, 1), end, draw.between(0.08, 0.14), sides=10))
    return parts + _lounge_frame(draw, profile, width, thick)


def _bed_slats(draw: Draw, profile: Profile, width: Number) -> list[Part]:
    """Cross boards along a profile, on two side rails."""
    count = draw.count(9, 22)
    share = (np.arange(count) + 0.5) / count
    z = np.interp(share, profile.share, profile.points[:, 0])
    y = np.interp(share, profile.share, profile.points[:, 1])
    end = np.stack([0 * z + width / 2, y, z], 1)
    rail = np.stack([0 * profile.share + width / 2 - 0.02, profile.points[:, 1] - 0.02,
                     profile.points[:, 0]], 1)  # fmt: skip
    return [bars(end * (-1, 1, 1), end, draw.between(0.025, 0.06), 0.015),
            both_sides(tubes(rail, draw.between(0.015, 0.03), across=0.012, sides=4))]  # fmt: skip


def _lounge_frame(draw: Draw, profile: Profile, width: Number, thick: float) -> list[Part]:
    """Legs, sled runners or wheels under a bed, with arms now and then."""
    z, y = profile.points.T
    front, back = z.max() * draw.between(0.6, 0.95), z.min() * draw.between(0.2, 0.8)
    under = [np.interp(p, z[::-1], y[::-1]) - thick / 2 for p in (front, back)]
    x, radius = width / 2 - draw.between(-0.02, 0.06), draw.between(0.01, 0.025)
    kind = draw.named("frame", {"legs": 0.45, "sled": 0.35, "arched": 0.2})
    low = max(min(under), 0.1)
    if kind == "legs":
        feet = np.array([[x, 0, front], [x, 0, back]])
        tops = feet + np.array([[0, under[0], 0], [0, low, 0]])
        parts = [
            both_sides(bars(feet, tops, 2 * radius)),
            both_sides(bars((x, low - 0.03, front), (x, low - 0.03, back), 0.02, 0.04)),
        ]
        if draw.chance(0.25):
            hub = np.array([x + 0.03, 0.1, back])
            parts.append(both_sides(bars(hub, hub + np.array([0.03, 0, 0]), 0.2, sides=12)))
    else:
        bow = draw.between(0.05, 0.25) if kind == "arched" else 0.0
        corners = [(x, under[0], front), (x, radius, front - bow), (x, radius, back + bow),
                   (x, under[1], back)]  # fmt: skip
        flat = draw.chance(0.5)
        parts = [both_sides(tubes(bend(corners, 0.1), radius, across=0.03 if flat else None,
                                  sides=4 if flat else 8))]  # fmt: skip
    if draw.chance(0.4):
        arm = low + draw.between(0.18, 0.28)
        start, end = (x + 0.02, arm, draw.between(0.15, 0.35)), (x + 0.02, arm, min(back, -0.2))
        foot = (x + 0.02, 0.02, start[2])
        parts += [both_sides(bars(start, end, draw.between(0.03, 0.08), 0.025)),
                  both_sides(bars(start, foot, 0.03))]  # fmt: skip
    ties = np.array([[x, under[0] - 0.02, front], [x, low - 0.02, back]])
    return [*parts, bars(ties, ties * (-1, 1, 1), 0.025, sides=6)]


def _deck_chair(draw: Draw, width: Number) -> list[Part]:
    """A cloth slung between two crossing frames."""
    tall, long = draw.between(0.75, 1.0), draw.between(0.9, 1.2)
    foot, head = long * 0.3, -long * 0.5
    seat = (long * 0.45, draw.between(0.28, 0.4))
    x = width / 2
    legs = np.array([[x, 0, foot], [x - 0.04, 0, head * draw.between(0.8, 1.1)]])
    tops = np.array([[x, tall, head], [x - 0.04, seat[1], seat[0]]])
    thick, depth = draw.between(0.018, 0.03), draw.between(0.025, 0.06)
    ties = np.concatenate([legs + 0.12 * (tops - legs), tops])
    sag = (draw.between(-0.1, 0.1), draw.between(0.15, 0.28))
    profile = bent_profile([seat, sag, (head, tall)], draw.between(0.15, 0.4))
    half = np.full(len(profile.share), x - draw.between(0.03, 0.07))
    return [both_sides(bars(legs, tops, thick, depth)), bars(ties, ties * (-1, 1, 1), 0.025),
            swept(profile, half, 0 * half, 0.01, columns=5)]  # fmt: skip
