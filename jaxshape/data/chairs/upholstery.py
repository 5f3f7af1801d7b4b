"""Voluminous seats: club and wing chairs, sofas, tubs, pouffes."""

from collections.abc import Sequence

import numpy as np

from jaxshape.data.chairs.shells import tub
from jaxshape.data.procedural.draw import Draw, Number, Range
from jaxshape.data.procedural.primitives import (
    Part,
    bars,
    both_sides,
    box,
    cushion,
    loft,
    shift,
    slab,
    superellipse,
    tilt,
)


def feet(draw: Draw, width: Number, depth: float, height: float) -> list[Part]:
    """Four short feet, two rails or a plinth."""
    if height < 0.025:
        return []
    kind = draw.named("feet", {"legs": 0.7, "blocks": 0.15, "plinth": 0.15})
    x, z = width / 2 - draw.between(0.03, 0.1), depth / 2 - draw.between(0.03, 0.1)
    if kind == "plinth":
        return [box((0, height / 2, 0), (2 * x, height, 2 * z))]
    thick = draw.between(0.02, 0.04) if kind == "legs" else draw.between(0.05, 0.1)
    tops = np.array([[x, height + 0.02, z], [x, height + 0.02, -z]])
    splay = draw.between(0, 0.3) * height if kind == "legs" else 0.0
    ends = tops * (1, 0, 1) + np.array([[splay, 0, splay], [splay, 0, -splay]])
    sides = 8 if draw.chance(0.5) else 4
    return [both_sides(bars(tops, ends, thick, sides=sides, profile=(1, draw.between(0.5, 1))))]


def club_parts(draw: Draw, width: Number, *, wings: bool = False) -> list[Part]:
    """A stuffed body between two arms, with loose cushions; `width` makes it a chair or a sofa."""
    depth = draw.between(0.56, 0.98)
    low = draw.between(0.0, 0.3) if draw.chance(0.75) else 0.0
    seat = max(draw.between(0.36, 0.48), low + 0.12)
    tall = draw.between(0.68, 1.0) + 0.18 * wings
    arm = draw.between(0.07, 0.25) * min(width, 1.0)
    arm_top = min(seat + draw.between(0.08, 0.26), tall)
    back = draw.between(0.12, 0.27) * depth
    inner = width - 2 * arm
    pad = min(draw.between(0.08, 0.18), seat - low - 0.08) if draw.chance(0.55) else 0.0
    edge = draw.between(0.03, 0.3)
    parts = feet(draw, width, depth, low)
    body_top = seat - pad
    front = depth / 2 - draw.between(0, 0.06)
    parts += _stuffed_arms(draw, inner, arm, (low, arm_top), depth)
    lean = draw.between(0.0, 0.35)
    over = arm * draw.between(0.0, 0.5) if draw.chance(0.5) else 0.0
    parts.append(_seat_and_back(inner / 2 + over, (low, body_top, tall), (-depth / 2, back, front),
                                lean * (tall - seat), edge))  # fmt: skip
    parts += _cushions(draw, inner, (-depth / 2 + back, front + 0.02), seat, pad, tall, lean)
    if width < 1.2 and pad and draw.chance(0.08):
        parts.append(_foot_rest(draw, inner, depth / 2, (low, body_top)))
    if wings:
        parts.append(_wings(draw, inner / 2 + arm * 0.3, arm_top, tall, depth, back))
    return parts


def slipper_parts(draw: Draw, width: Number) -> list[Part]:
    """A stuffed seat and back in one, on short or long legs, with a loose seat cushion or none."""
    depth, back = draw.between(0.5, 0.85), draw.between(0.07, 0.24)
    low = draw.between(0.0, 0.36) if draw.chance(0.9) else 0.0
    seat, tall = max(draw.between(0.36, 0.48), low + 0.06), draw.between(0.68, 1.1)
    pad = min(draw.between(0.05, 0.14), seat - low - 0.04) if draw.chance(0.4) else 0.0
    lean = draw.between(0.0, 0.3) * (tall - seat) if draw.chance(0.7) else 0.0
    levels, places = (low, seat - pad, tall), (-depth / 2, back, depth / 2)
    body = _seat_and_back(width / 2, levels, places, lean, draw.between(0.03, 0.3))
    parts = [*feet(draw, width, depth, low), body]
    if pad:
        center = (0, seat - pad / 2, back / 2)
        parts.append(cushion(center, (width, pad, depth - back), edge=draw.between(0.1, 0.45)))
    return parts


def _seat_and_back(
    half: Number, levels: tuple[Number, ...], places: tuple[Number, ...], lean: Number, edge: Number
) -> Part:
    """Seat and back as one body without a seam: an L seen from the side, its edges rounded."""
    (low, seat, tall), (rear, back, front) = levels, places
    r = edge * back / 2
    upper = np.array([[front, seat - r], [front - 0.3 * r, seat - 0.3 * r], [front - r, seat],
                      [rear + back, seat], [rear + back - lean, tall - r],
                      [rear + back - lean - 0.3 * r, tall - 0.3 * r],
                      [rear + back - lean - r, tall]])  # fmt: skip
    lower = np.array([[front, low], [front - 0.3 * r, low], [front - r, low], [rear, low],
                      [rear - lean, tall - r], [rear - lean + 0.3 * r, tall - 0.3 * r],
                      [rear - lean + r, tall]])  # fmt: skip
    outline = np.concatenate([upper, lower[::-1]])
    ring = np.stack([0 * outline[:, 0], outline[:, 1], outline[:, 0]], 1)
    return loft(np.stack([ring - (half, 0, 0), ring + (half, 0, 0)]))


def _block(start: Sequence[Number], end: Sequence[Number], edge: Number) -> Part:
    low, high = np.asarray(start), np.asarray(end)
    return cushion((low + high) / 2, high - low, outline=superellipse(12, 16), edge=edge)


def _stuffed_arms(draw: Draw, inner: Number, arm: float, span: Range, depth: float) -> list[Part]:
    """Arms with a box, rounded, rolled, sloping or flared outline when seen from the front."""
    kind = draw.named("arms", {"box": 0.35, "rounded": 0.25, "rolled": 0.2, "sloped": 0.2})
    low, top = span
    x, front = inner / 2 + arm / 2, depth / 2 - draw.between(0, 0.1)
    if kind == "box":
        return [both_sides(_block((inner / 2, low, -depth / 2), (inner / 2 + arm, top, front),
                                  draw.between(0.02, 0.3)))]  # fmt: skip
    if kind == "sloped":
        z = np.linspace(-depth / 2, front, 7)
        rise = top + draw.between(0.0, 0.2) * np.linspace(1, 0, 7) ** 2 - draw.between(
            0.0, 0.15) * np.linspace(0, 1, 7) ** 2  # fmt: skip
        v = np.linspace(0, 1, 4)[:, None]
        bulge = draw.between(-0.03, 0.06) * v
        surface = np.stack(np.broadcast_arrays(x + bulge, low + (rise - low) * v, z), -1)
        return [both_sides(slab(surface, arm))]
    angle = np.linspace(0, np.pi, 9)
    radius = arm / 2 * (1.0 if kind == "rounded" else draw.between(1.05, 1.35))
    neck = arm / 2 * (1.0 if kind == "rounded" else draw.between(0.6, 0.9))
    outline = np.stack([np.r_[neck, radius * np.cos(angle), -neck],
                        np.r_[low, top - radius + radius * np.sin(angle), low]], 1)  # fmt: skip
    if len(outline) % 2:
        middle = len(outline) // 2
        outline = np.delete(outline, middle, 0)
    ring = np.stack([outline[:, 0] + x, outline[:, 1], 0 * outline[:, 0]], 1)
    ends = [ring + np.array([0, 0, z]) for z in (-depth / 2, front)]
    return [both_sides(loft(np.stack(ends)))]


def _cushions(
    draw: Draw, inner: Number, span: Range, seat: float, pad: float, tall: float,
    lean: Number,
) -> list[Part]:  # fmt: skip
    """Seat and back cushions, one per place, and maybe a loose pillow."""
    count = max(1, round(inner / draw.between(0.5, 0.8))) if inner > 0.8 else 1
    back, front = span
    parts, place = [], inner / count
    at = (np.arange(count) + 0.5) * place - inner / 2
    if pad:
        one = cushion((0, seat - pad / 2, (front + back) / 2), (place * 0.98, pad, front - back),
                      edge=draw.between(0.15, 0.45), crown=draw.between(0, 0.03))  # fmt: skip
        parts += [shift(one, (x, 0, 0)) for x in at]
    if draw.chance(0.6):
        high, thick = (tall - seat) * draw.between(0.7, 1.15), draw.between(0.08, 0.2)
        flat = cushion((0, 0, 0), (place * 0.96, thick, high), edge=draw.between(0.2, 0.48),
                       crown=draw.between(0, 0.03))  # fmt: skip
        up = tilt(flat, np.pi / 2 + lean * 0.5 + 0.1, (0, 0, 0))
        one = shift(up, (0, seat + high / 2, back + thick / 2))
        parts += [shift(one, (x, 0, 0)) for x in at]
    if draw.chance(0.12):
        size = draw.between(0.3, 0.42)
        pillow = cushion((0, 0, 0), (size, 0.12, size), edge=0.48, crown=0.03)
        up = tilt(pillow, np.pi / 2 + 0.4, (0, 0, 0))
        parts.append(shift(up, (draw.between(-0.3, 0.3) * inner, seat + size / 2, back + 0.2)))
    return parts


def _foot_rest(draw: Draw, width: Number, front: float, span: Range) -> Part:
    """The pad that a recliner has swung out in front, level or hanging."""
    long, thick = draw.between(0.25, 0.45), draw.between(0.05, 0.12)
    flat = cushion((0, 0, 0), (width, thick, long), edge=draw.between(0.1, 0.4))
    y, hang = span[0] + (span[1] - span[0]) * draw.between(0.4, 1.0), draw.between(0.0, 0.5)
    above_floor = max(y - thick / 2, thick / 2 + long * np.sin(hang))
    turned = tilt(flat, -hang, (0, 0, -long / 2))
    return shift(turned, (0, above_floor, front + long / 2 - 0.02))


def _wings(draw: Draw, x: Number, low: float, tall: float, depth: float, back: float) -> Part:
    """The side pieces of a wing chair, from the arms to the top of the back."""
    v = np.linspace(0, 1, 6)[:, None]
    u = np.linspace(0, 1, 4)
    reach = back + draw.between(0.1, 0.25) * np.sin(np.pi * (0.15 + 0.75 * v))
    z = -depth / 2 + reach * u - 0.04 * v
    y = low - 0.03 + (tall - low) * v
    out = x + draw.between(-0.02, 0.06) * u
    surface = np.stack(np.broadcast_arrays(out, y, z), -1)
    return both_sides(slab(surface, draw.between(0.04, 0.09)))


def tub_chair_parts(draw: Draw) -> list[Part]:
    """A stuffed tub on feet, with a loose seat cushion now and then."""
    width, depth = draw.between(0.65, 1.1), draw.between(0.6, 0.95)
    low = draw.between(0.03, 0.25) if draw.chance(0.7) else 0.0
    seat, pad = draw.between(0.34, 0.46), draw.between(0.06, 0.16) * draw.chance(0.5)
    thick = draw.between(0.05, 0.26)
    wall = tub(draw, width, depth, low, seat - pad, tall=(0.28, 0.55), thickness=(thick, thick),
               bottom=(0.75, 1.0))  # fmt: skip
    parts = [*feet(draw, width * 0.8, depth * 0.8, low), wall]
    if pad:
        size = (width - 2 * thick, pad, depth - thick)
        parts.append(cushion((0, seat - pad / 2, thick / 2), size, edge=0.35,
                             outline=superellipse(draw.between(2.5, 8))))  # fmt: skip
    return parts


def pouffe_parts(draw: Draw) -> list[Part]:
    """A bean bag with a hollow, a round pouffe or an ottoman."""
    kind = draw.named("pouffe", {"bag": 0.5, "drum": 0.25, "ottoman": 0.25})
    if kind == "bag":
        return [_bag(draw)]
    width, height = draw.between(0.4, 0.8), draw.between(0.35, 0.5)
    depth = width * draw.between(0.7, 1.0) if kind == "ottoman" else width
    low = draw.between(0.0, 0.15)
    outline = superellipse(8.0 if kind == "ottoman" else 2.0)
    body = cushion((0, (low + height) / 2, 0), (width, height - low, depth), outline=outline,
                   edge=draw.between(0.1, 0.4), crown=draw.between(0, 0.03))  # fmt: skip
    return [*feet(draw, width * 0.8, depth * 0.8, low), body]


def _bag(draw: Draw) -> Part:
    """A squat bag whose front half is pressed down to a seat."""
    width, height = draw.between(0.75, 1.0), draw.between(0.5, 0.85)
    belly, seat = draw.between(0.3, 0.5), draw.between(0.5, 0.8)
    angle = 2 * np.pi * np.arange(24) / 24
    polar = np.linspace(0.15, 0.98, 9) * np.pi
    radius = width / 2 * np.sin(polar) ** draw.between(0.6, 0.9)
    level = -np.cos(polar)
    rise = np.where(level < 0, belly * (1 + level), belly + (1 - belly) * level)
    ring = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], 1)
    bag = ring * radius[:, None, None]
    bag[:, :, 1] = height * rise[:, None]
    press = np.clip(bag[:, :, 2] / (width / 2) + draw.between(0.2, 0.6), 0, 1)
    bag[:, :, 1] *= 1 - (1 - seat) * np.sin(np.pi / 2 * press)
    return loft(bag)


def plinth_parts(draw: Draw, width: Number, depth: float, seat: float) -> list[Part]:
    """A daybed or a bench sofa: a mattress on a frame, with a low back and no arms."""
    pad, low = draw.between(0.1, 0.2), draw.between(0.08, 0.25)
    parts = feet(draw, width, depth, low)
    parts.append(box((0, (low + seat - pad) / 2, 0), (width, seat - pad - low, depth)))
    parts.append(cushion((0, seat - pad / 2, 0), (width, pad, depth), edge=draw.between(0.1, 0.4)))
    high, thick = draw.between(0.22, 0.45), draw.between(0.1, 0.2)
    flat = cushion((0, 0, 0), (width * draw.between(0.85, 1), thick, high), edge=0.3)
    up = tilt(flat, np.pi / 2 + draw.between(0, 0.3), (0, 0, 0))
    return [*parts, shift(up, (0, seat + high / 2, -depth / 2 + thick / 2 + 0.02))]


def egg_parts(draw: Draw, seat: Number) -> list[Part]:
    """The high-backed tub of an egg or lounge chair."""
    width, depth = draw.between(0.6, 0.9), draw.between(0.55, 0.8)
    low = seat - draw.between(0.12, 0.22)
    return [tub(draw, width, depth, low, seat, tall=(0.3, 0.75), thickness=(0.02, 0.12),
                bottom=(0.3, 0.8))]  # fmt: skip
