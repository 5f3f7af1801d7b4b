"""The styles of the family: combinations of seats, bases, backs and arms, frequencies, sizes."""

import numpy as np
import trimesh

from jaxshape.data.chairs import shells, upholstery
from jaxshape.data.chairs.arms import FRAMED_ARMS, HUNG_ARMS, arm_parts, tray
from jaxshape.data.chairs.backs import FRAMED_BACKS, back_parts, draw_rest
from jaxshape.data.chairs.bases import base_parts, foot_ring
from jaxshape.data.chairs.seats import FRAMED_SEATS, draw_seat, seat_parts
from jaxshape.data.procedural.boards import Board
from jaxshape.data.procedural.draw import Draw, Number, Range, Weights
from jaxshape.data.procedural.family import Family, Styles, make
from jaxshape.data.procedural.primitives import (
    Part,
    bars,
    both_sides,
    cushion,
    shift,
    tilt,
)

UPHOLSTERED = {"pad": 0.6, "block": 0.25, "dished": 0.15}
PADDED_BACKS = {"solid": 0.55, "pads": 0.25, "panel": 0.15, "frame": 0.05}


def _framed(
    draw: Draw,
    seat: Board,
    *,
    bases: Weights,
    seats: Weights = FRAMED_SEATS,
    backs: Weights | None = FRAMED_BACKS,
    arms: Weights | None = None,
    back_height: Range = (0.34, 0.64),
) -> list[Part]:
    """A chair of separate parts: a seat on a base, with a back and arms if any are given."""
    base = draw.pick(bases)
    aprons = base in ("four legs", "sled", "rockers", "scissors", "panels")
    parts, structural = seat_parts(draw, seat, seats, aprons=aprons)
    draw.record["seat height"] = round(seat.height, 3)
    parts += base_parts(draw, structural, {base: 1.0})
    if backs:
        rest = draw_rest(draw, seat, back_height)
        parts += back_parts(draw, rest, backs)
        if arms:
            parts += arm_parts(draw, seat, rest, arms)
    return parts


def _side_chair(draw: Draw) -> list[Part]:
    return _framed(draw, draw_seat(draw), bases={"four legs": 0.92, "hairpin": 0.03, "loops": 0.05})


def _armchair(draw: Draw) -> list[Part]:
    seat = draw_seat(draw, width=(0.45, 0.58), depth=(0.42, 0.54), height=(0.4, 0.47))
    bases = {"four legs": 0.85, "sled": 0.06, "cantilever": 0.06, "loops": 0.03}
    return _framed(draw, seat, bases=bases, arms=FRAMED_ARMS, back_height=(0.35, 0.65))


def _sled(draw: Draw) -> list[Part]:
    arms = FRAMED_ARMS if draw.chance(0.3) else None
    return _framed(draw, draw_seat(draw, round_chance=0), bases={"sled": 1.0}, arms=arms)


def _cantilever(draw: Draw) -> list[Part]:
    seat = draw_seat(draw, round_chance=0)
    backs = {"solid": 0.5, "panel": 0.25, "frame": 0.15, "slatted": 0.05, "ladder": 0.05}
    if draw.chance(0.35):
        return _framed(draw, seat, bases={"armed loop": 1.0}, backs=backs)
    arms = {"loop": 0.8, "pads": 0.2} if draw.chance(0.3) else None
    return _framed(draw, seat, bases={"cantilever": 1.0}, backs=backs, arms=arms)


def _shell(draw: Draw) -> list[Part]:
    seat = draw_seat(draw, width=(0.38, 0.5), depth=(0.38, 0.46), round_chance=0)
    base = {"four legs": 0.45, "sled": 0.18, "disc": 0.1, "star": 0.1, "hairpin": 0.05,
            "loops": 0.07, "cantilever": 0.05}  # fmt: skip
    narrow = seat._replace(width=seat.width * 0.88, depth=seat.depth * 0.92)
    return shells.shell_parts(draw, seat) + base_parts(draw, narrow, base)


def _pedestal(draw: Draw) -> list[Part]:
    seat = draw_seat(draw, width=(0.4, 0.56), round_chance=0.35)
    bases = {"disc": 0.5, "star": 0.5}
    kind = draw.pick({"framed": 0.4, "tub": 0.35, "shell": 0.25})
    if kind == "framed":
        arms = HUNG_ARMS if draw.chance(0.3) else None
        return _framed(draw, seat, bases=bases, seats=UPHOLSTERED, backs=PADDED_BACKS, arms=arms)
    if kind == "shell":
        return shells.shell_parts(draw, seat) + base_parts(draw, seat, bases)
    return _tub_on(draw, seat, bases)


def _tub_on(draw: Draw, seat: Board, bases: Weights) -> list[Part]:
    """A seat with a wrap-around wall on any base."""
    seat = seat._replace(width=seat.width * draw.between(1.05, 1.35), exponent=2.2, taper=0.0)
    deep = draw.between(0.02, 0.16)
    wall = shells.tub(draw, seat.width, seat.depth * 1.15, seat.height - deep, seat.height)
    draw.record["back"] = "tub"
    return [wall, *base_parts(draw, seat._replace(thickness=deep), bases)]


def _tub(draw: Draw) -> list[Part]:
    bases = {"four legs": 0.7, "hairpin": 0.1, "loops": 0.1, "sled": 0.1}
    return _tub_on(draw, draw_seat(draw), bases)


def _office(draw: Draw) -> list[Part]:
    seat = draw_seat(draw, width=(0.44, 0.54), depth=(0.42, 0.52), height=(0.42, 0.56))
    if draw.chance(0.25):
        return shells.shell_parts(draw, seat) + base_parts(draw, seat, {"castors": 1.0})
    arms = {"pads": 0.5, "loop": 0.5} if draw.chance(0.65) else None
    parts = _framed(draw, seat, bases={"castors": 0.85, "star": 0.15}, seats=UPHOLSTERED,
                    backs=PADDED_BACKS, arms=arms, back_height=(0.35, 0.72))  # fmt: skip
    if draw.chance(0.2):
        top = max(part.vertices[..., 1].max() for part in parts)
        back = min(part.vertices[..., 2].min() for part in parts[-3:])
        parts.append(_head_rest(draw, top, back))
    return parts


def _head_rest(draw: Draw, y: Number, z: float) -> Part:
    flat = cushion((0, 0, 0), (draw.between(0.2, 0.34), 0.07, draw.between(0.1, 0.18)), edge=0.4)
    return shift(tilt(flat, np.pi / 2, (0, 0, 0)), (0, y + 0.06, z + 0.05))


def _stool(draw: Draw) -> list[Part]:
    seat = draw_seat(draw, width=(0.28, 0.5), depth=(0.26, 0.42), height=(0.4, 0.5),
                     round_chance=0.5)  # fmt: skip
    bases = {"four legs": 0.45, "ringed legs": 0.2, "disc": 0.08, "star": 0.04, "castors": 0.04,
             "crossed": 0.07, "panels": 0.07, "block": 0.05}  # fmt: skip
    seats = {"board": 0.45, "pad": 0.25, "block": 0.2, "dished": 0.05, "slats": 0.05}
    return _framed(draw, seat, bases=bases, seats=seats, backs=None)


def _bar_stool(draw: Draw) -> list[Part]:
    seat = draw_seat(draw, width=(0.28, 0.46), depth=(0.28, 0.42), height=(0.6, 0.84),
                     round_chance=0.5)  # fmt: skip
    bases = {"four legs": 0.45, "ringed legs": 0.2, "bar pedestal": 0.25, "sled": 0.06,
             "star": 0.04}  # fmt: skip
    kind = draw.pick({"bare": 0.25, "back": 0.45, "shell": 0.15, "tub": 0.15})
    if kind == "shell":
        low = seat._replace(depth=min(seat.depth, 0.4))
        return shells.shell_parts(draw, low, (0.08, 0.4)) + base_parts(draw, seat, bases)
    if kind == "tub":
        return _tub_on(draw, seat, bases)
    backs = FRAMED_BACKS if kind == "back" else None
    seats = {"board": 0.4, "pad": 0.3, "block": 0.2, "dished": 0.1}
    return _framed(draw, seat, bases=bases, seats=seats, backs=backs, back_height=(0.15, 0.42))


def _bench(draw: Draw) -> list[Part]:
    seat = draw_seat(draw, width=(0.9, 1.8), depth=(0.35, 0.55), height=(0.4, 0.47), round_chance=0)
    seat = seat._replace(taper=0.0)
    bases = {"four legs": 0.6, "panels": 0.25, "sled": 0.15}
    seats = {"slats": 0.5, "board": 0.25, "pad": 0.15, "block": 0.1}
    backs = {"slatted": 0.35, "ladder": 0.25, "solid": 0.15, "spindle": 0.1, "cross": 0.05,
             "frame": 0.1}  # fmt: skip
    with_back = draw.chance(0.65)
    arms = {"posts": 0.8, "panel": 0.2} if with_back and draw.chance(0.7) else None
    return _framed(draw, seat, bases=bases, seats=seats, backs=backs if with_back else None,
                   arms=arms)  # fmt: skip


def _rocking(draw: Draw) -> list[Part]:
    seat = draw_seat(draw, width=(0.45, 0.56), depth=(0.42, 0.52), height=(0.38, 0.45))
    arms = {"posts": 0.8, "loop": 0.1, "wrap": 0.1} if draw.chance(0.75) else None
    if draw.chance(0.15):
        return shells.shell_parts(draw, seat) + base_parts(draw, seat, {"rockers": 1.0})
    return _framed(draw, seat, bases={"rockers": 1.0}, arms=arms, back_height=(0.5, 0.75))


def _folding(draw: Draw) -> list[Part]:
    seat = draw_seat(draw, width=(0.36, 0.5), depth=(0.33, 0.44), height=(0.4, 0.47),
                     round_chance=0)  # fmt: skip
    kind = draw.pick({"scissors": 0.65, "director": 0.2, "stool": 0.15})
    seats = {"slats": 0.4, "board": 0.25, "sling": 0.15, "pad": 0.2}
    if kind == "stool":
        return _framed(draw, seat, bases={"scissors": 0.5, "crossed": 0.5},
                       seats={"sling": 0.8, "slats": 0.2}, backs=None)  # fmt: skip
    if kind == "director":
        seat = seat._replace(width=seat.width + 0.08)
        return _framed(draw, seat, bases={"crossed": 0.6, "scissors": 0.4},
                       seats={"sling": 0.8, "board": 0.2}, backs={"panel": 1.0},
                       arms={"posts": 0.8, "panel": 0.2})  # fmt: skip
    backs = {"panel": 0.35, "ladder": 0.3, "frame": 0.2, "slatted": 0.15}
    return _framed(draw, seat, bases={"scissors": 1.0}, seats=seats, backs=backs)


def _panel_chair(draw: Draw) -> list[Part]:
    seat = draw_seat(draw, round_chance=0)
    arms = {"panel": 0.4, "side": 0.45, "posts": 0.15} if draw.chance(0.5) else None
    backs = {"solid": 0.6, "panel": 0.15, "ladder": 0.15, "slatted": 0.1}
    return _framed(draw, seat._replace(taper=0.0), bases={"panels": 0.75, "block": 0.25},
                   backs=backs, arms=arms)  # fmt: skip


def _lounge(draw: Draw) -> list[Part]:
    return shells.lounge_parts(draw)


def _easy_chair(draw: Draw) -> list[Part]:
    """A low, deep, padded chair in an open frame with arms."""
    seat = draw_seat(draw, width=(0.52, 0.68), depth=(0.5, 0.64), height=(0.32, 0.42),
                     round_chance=0)  # fmt: skip
    looped = draw.chance(0.35)
    legs = {"four legs": 0.7, "sled": 0.2, "cantilever": 0.1}
    return _framed(draw, seat, bases={"armed loop": 1.0} if looped else legs,
                   seats={"pad": 0.5, "block": 0.35, "dished": 0.1, "slats": 0.05},
                   arms=None if looped else FRAMED_ARMS,
                   backs={"solid": 0.6, "pads": 0.2, "slatted": 0.1, "frame": 0.1},
                   back_height=(0.3, 0.7))  # fmt: skip


def _recliner(draw: Draw) -> list[Part]:
    """A padded, leaning lounge chair on a low base, sometimes with its foot-stool in front."""
    seat = Board(draw.between(0.48, 0.72), draw.between(0.46, 0.62), draw.between(0.34, 0.46))
    bases = {"star": 0.35, "disc": 0.2, "four legs": 0.25, "armed loop": 0.1, "sled": 0.1}
    small = seat._replace(width=seat.width * 0.85, depth=seat.depth * 0.8, thickness=0.08)
    parts = shells.padded_parts(draw, seat) + base_parts(draw, small, bases)
    if draw.chance(0.15):
        stool = seat._replace(depth=draw.between(0.36, 0.5), height=seat.height - 0.03)
        rest, under = seat_parts(draw, stool, {"pad": 0.6, "block": 0.4}, aprons=False)
        ahead = seat.depth / 2 + draw.between(0.02, 0.15) + stool.depth / 2
        rest += base_parts(draw, under, {"four legs": 0.6, "star": 0.2, "sled": 0.2})
        parts += [shift(part, (0, 0, ahead)) for part in rest]
    return parts


def _high_chair(draw: Draw) -> list[Part]:
    """A child's high chair with a tray, or a lecture chair with a tablet at one side."""
    seat = draw_seat(draw, width=(0.3, 0.42), depth=(0.28, 0.4), height=(0.5, 0.65), round_chance=0)
    parts = _framed(draw, seat, bases={"four legs": 0.7, "scissors": 0.3}, backs=PADDED_BACKS,
                    back_height=(0.3, 0.5))  # fmt: skip
    return parts + tray(draw, seat)


def _slipper(draw: Draw) -> list[Part]:
    """An upholstered seat and back without arms, on legs."""
    return upholstery.slipper_parts(draw, draw.between(0.42, 0.85))


def _club(draw: Draw) -> list[Part]:
    return upholstery.club_parts(draw, draw.between(0.56, 1.1))


def _wing(draw: Draw) -> list[Part]:
    return upholstery.club_parts(draw, draw.between(0.68, 0.9), wings=True)


def _sofa(draw: Draw) -> list[Part]:
    if draw.chance(0.12):
        seat = draw.between(0.36, 0.45)
        return upholstery.plinth_parts(draw, draw.between(0.9, 2.0), draw.between(0.7, 0.95), seat)
    return upholstery.club_parts(draw, draw.between(1.2, 2.3))


def _barrel(draw: Draw) -> list[Part]:
    return upholstery.tub_chair_parts(draw)


def _egg(draw: Draw) -> list[Part]:
    height = draw.between(0.36, 0.44)
    seat = Board(draw.between(0.5, 0.65), 0.5, height - 0.2, thickness=0.0, exponent=2.2)
    return upholstery.egg_parts(draw, height) + base_parts(
        draw, seat, {"star": 0.45, "disc": 0.3, "four legs": 0.25})  # fmt: skip


def _pouffe(draw: Draw) -> list[Part]:
    return upholstery.pouffe_parts(draw)


def _floor_chair(draw: Draw) -> list[Part]:
    """A legless chair: a shell or a pad with a back, on the floor."""
    seat = Board(draw.between(0.42, 0.58), draw.between(0.42, 0.55), draw.between(0.04, 0.12))
    if draw.chance(0.5):
        return shells.shell_parts(draw, seat)
    rest = draw_rest(draw, seat, (0.35, 0.55))
    center = (0, seat.height - 0.05, 0)
    pad = cushion(center, (seat.width, draw.between(0.05, 0.12), seat.depth), edge=0.4)
    return [pad, *back_parts(draw, rest, {"solid": 0.8, "pads": 0.1, "slatted": 0.1})]


def _wheelchair(draw: Draw) -> list[Part]:
    """A framed armchair between two large spoked wheels."""
    seat = draw_seat(draw, width=(0.4, 0.5), depth=(0.4, 0.46), height=(0.46, 0.54), round_chance=0)
    parts = _framed(draw, seat, bases={"four legs": 0.5, "sled": 0.5}, seats={"sling": 0.6,
                    "pad": 0.4}, backs={"frame": 0.5, "solid": 0.5}, arms={"posts": 0.3,
                    "floor loop": 0.4, "pads": 0.3})  # fmt: skip
    return parts + _wheels(draw, seat)


def _wheels(draw: Draw, seat: Board) -> list[Part]:
    radius, x = draw.between(0.26, 0.32), seat.width / 2 + 0.06
    center = np.array([x, radius, -seat.depth * draw.between(0.2, 0.45)])
    flat = foot_ring(0.0, radius, 0.012)
    rim = flat._replace(vertices=flat.vertices[..., [1, 2, 0]] + center)
    angle = np.pi * np.arange(4) / 4
    spoke = radius * np.stack([0 * angle, np.sin(angle), np.cos(angle)], 1)
    spokes = bars(center - spoke, center + spoke, 0.008, sides=4)
    return [both_sides(rim), both_sides(spokes)]


_STYLES: Styles = {
    "side chair": (0.24, _side_chair),
    "armchair": (0.08, _armchair),
    "shell": (0.08, _shell),
    "sled": (0.03, _sled),
    "cantilever": (0.045, _cantilever),
    "pedestal": (0.05, _pedestal),
    "tub": (0.03, _tub),
    "office": (0.06, _office),
    "stool": (0.035, _stool),
    "bar stool": (0.065, _bar_stool),
    "bench": (0.015, _bench),
    "rocking": (0.02, _rocking),
    "folding": (0.035, _folding),
    "panel": (0.02, _panel_chair),
    "high chair": (0.02, _high_chair),
    "easy chair": (0.04, _easy_chair),
    "recliner": (0.035, _recliner),
    "lounge": (0.045, _lounge),
    "floor chair": (0.01, _floor_chair),
    "wheelchair": (0.01, _wheelchair),
    "slipper": (0.075, _slipper),
    "club": (0.08, _club),
    "wing": (0.02, _wing),
    "sofa": (0.025, _sofa),
    "barrel": (0.035, _barrel),
    "egg": (0.025, _egg),
    "pouffe": (0.01, _pouffe),
}

CHAIRS = Family("chair", _STYLES)
FREQUENCIES: Weights = CHAIRS.frequencies
STYLES: tuple[str, ...] = tuple(FREQUENCIES)
VOLUMINOUS: frozenset[str] = frozenset({"club", "wing", "sofa", "barrel", "egg", "pouffe"})


def random_chair(seed: int | np.integer, *, style: str | None = None) -> trimesh.Trimesh:
    """Make the procedural chair of a seed. [host]

    Args:
        seed: Seed of the chair, 0 or more; seeds from 1,000,000 on are kept for tests.
        style: One of the styles of `jaxshape.data.chairs.STYLES`; None to draw one by its
            frequency.

    Returns:
        A mesh of closed parts that face outwards, in metres, +y up, front along +z, box centred at
        the origin. Its `metadata` holds `style`, `seed` and `drawn`, the named choices (seat, base,
        back, arms, ...).

    Raises:
        ValueError: The seed is negative, or the style is unknown.
    """
    return make(CHAIRS, seed, style)
