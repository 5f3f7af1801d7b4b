"""The styles of the family: combinations of tops, bases and storage, frequencies, sizes."""

import numpy as np
import trimesh

from jaxshape.data.procedural import legs
from jaxshape.data.procedural.boards import Board, slats
from jaxshape.data.procedural.draw import Draw, Weights
from jaxshape.data.procedural.family import Family, Styles, make
from jaxshape.data.procedural.primitives import Part, bars, both_sides, box, shift, tilt
from jaxshape.data.tables import storage
from jaxshape.data.tables.bases import TRESTLES, base_parts, frames, modesty_panel
from jaxshape.data.tables.tops import PLAIN_TOPS, draw_top, inside, is_round, ring, top_parts

STRAIGHT = {"rectangle": 0.85, "square": 0.15}
ROUNDISH = {"round": 0.6, "square": 0.2, "oval": 0.2}
SMOOTH_TOPS = {"board": 0.8, "block": 0.15, "glazed": 0.05}


def _plain(
    draw: Draw,
    top: Board,
    bases: Weights,
    *,
    tops: Weights = PLAIN_TOPS,
    shelf: float = 0.0,
    drawers: float = 0.0,
) -> list[Part]:
    """A top on a base, sometimes with a shelf or with drawers in front."""
    under = inside(top, draw.between(0.8, 1.0) if draw.chance(0.35) else draw.between(0.95, 1.0))
    parts = top_parts(draw, top, tops) + base_parts(draw, under, bases)
    if draw.chance(shelf):
        parts += storage.shelf(draw, under)
    if not is_round(top) and draw.chance(drawers):
        parts += storage.drawers_under(draw, under)
    return parts


def _dining(draw: Draw) -> list[Part]:
    top = draw_top(draw, width=(1.1, 2.4), depth=(0.7, 1.1), height=(0.7, 0.78))
    bases = {"legs": 0.75, "frames": 0.15, "bows": 0.04, "sides": 0.06}
    return _plain(draw, top, bases, drawers=0.05)


def _small(draw: Draw) -> list[Part]:
    """A table for two or four: kitchen, bistro, garden."""
    top = draw_top(draw, width=(0.65, 1.2), depth=(0.55, 0.8), height=(0.68, 0.78),
                   outlines={"rectangle": 0.4, "square": 0.3, "round": 0.3})  # fmt: skip
    bases = {"legs": 0.7, "frames": 0.12, "tripod": 0.06, "crossed": 0.06, "hairpin": 0.06}
    return _plain(draw, top, bases, shelf=0.06, drawers=0.1)


def _trestle(draw: Draw) -> list[Part]:
    top = draw_top(draw, width=(1.3, 2.6), depth=(0.7, 1.05), height=(0.7, 0.78),
                   outlines={"rectangle": 0.9, "oval": 0.1})  # fmt: skip
    return _plain(draw, top, {"trestle": 1.0})


def _pedestal(draw: Draw) -> list[Part]:
    top = draw_top(draw, width=(0.7, 1.6), depth=(0.6, 1.2), height=(0.66, 0.78), outlines=ROUNDISH)
    top = top._replace(width=min(top.width, 1.6 * top.depth))
    return _plain(draw, top, {"pedestal": 1.0})


def _conference(draw: Draw) -> list[Part]:
    top = draw_top(draw, width=(1.7, 3.2), depth=(0.85, 1.3), height=(0.7, 0.77),
                   outlines={"rectangle": 0.65, "oval": 0.35})  # fmt: skip
    return _plain(draw, top, {"two pedestals": 0.7, "frames": 0.2, "sides": 0.1})


def _sides(draw: Draw) -> list[Part]:
    top = draw_top(draw, width=(0.9, 2.0), depth=(0.5, 1.0), height=(0.68, 0.78),
                   outlines={"rectangle": 1.0})  # fmt: skip
    return _plain(draw, top, {"sides": 1.0}, shelf=0.15, drawers=0.1)


def _plain_desk(draw: Draw) -> list[Part]:
    """A writing desk: legs or frames, flat drawers, maybe a board at the back or on top."""
    top = draw_top(draw, width=(0.9, 1.7), depth=(0.45, 0.8), height=(0.7, 0.78),
                   outlines={"rectangle": 1.0})  # fmt: skip
    bases = {"legs": 0.45, "frames": 0.35, "sides": 0.12, "hairpin": 0.08}
    parts = _plain(draw, top, bases, tops=SMOOTH_TOPS, drawers=0.5)
    under = top.height - top.thickness
    if draw.chance(0.35):
        back = -top.depth / 2 + 0.02
        parts.append(modesty_panel(draw, top.width * 0.9, under, back))
    return parts + (storage.riser(draw, top) if draw.chance(0.25) else [])


def _desk(draw: Draw) -> list[Part]:
    """A desk on a cabinet at one end or both; the place to sit is in front."""
    top = draw_top(draw, width=(1.0, 2.0), depth=(0.5, 0.9), height=(0.7, 0.78),
                   outlines={"rectangle": 1.0})  # fmt: skip
    top = top._replace(thickness=max(top.thickness, 0.014))
    parts = top_parts(draw, top, {"board": 0.85, "block": 0.15})
    x, wide = top.width / 2 - draw.between(0.0, 0.05), top.width * draw.between(0.2, 0.34)
    side = 1 if draw.chance(0.5) else -1
    ends = {-side: draw.pick({"cabinet": 0.4, "panel": 0.3, "legs": 0.3}), side: "cabinet"}
    draw.record["base"] = f"cabinet and {ends[-side]}"
    for end, kind in ends.items():
        parts += _end_of_desk(draw, top, end, kind, x, wide)
    if draw.chance(0.6):
        y = top.height - top.thickness
        parts.append(modesty_panel(draw, 2 * x - 0.02, y, -top.depth / 2))
    if draw.chance(0.25):
        between = top._replace(width=2 * (x - wide))
        parts += storage.drawers_under(draw, between)
    return parts + (storage.riser(draw, top) if draw.chance(0.3) else [])


def _end_of_desk(draw: Draw, top: Board, end: int, kind: str, x: float, wide: float) -> list[Part]:
    """The support of one end of a desk: end 1 is at +x, end -1 at -x."""
    y, z = top.height - top.thickness, top.depth / 2
    if kind == "cabinet":
        low, high = sorted((end * x, end * (x - wide)))
        parts = storage.cabinet(draw, (low, high), top)
        carried = min(part.vertices[..., 1].min() for part in parts) < 0.01
        kind = "" if carried else "legs"
    else:
        parts = []
    if kind == "panel":
        thick = draw.between(0.016, 0.05)
        parts.append(box((end * (x - thick / 2), y / 2, 0), (thick, y, 2 * z * 0.95)))
    elif kind == "legs":
        thick = draw.between(0.025, 0.06)
        at = np.array([[end * (x - thick / 2), y, s * (z - thick)] for s in (-1, 1)])
        parts.append(bars(at, at * (1, 0, 1), thick))
    return parts


def _corner_desk(draw: Draw) -> list[Part]:
    """An L-shaped desk: a second board runs forward at one end."""
    top = draw_top(draw, width=(1.3, 1.9), depth=(0.5, 0.75), height=(0.7, 0.78),
                   outlines={"rectangle": 1.0})  # fmt: skip
    wide, long = draw.between(0.4, 0.65), draw.between(0.4, 1.1)
    side = 1 if draw.chance(0.5) else -1
    thick = max(top.thickness, 0.014)
    y, z = top.height - thick, top.depth / 2 + long
    x = side * (top.width / 2 - wide / 2)
    wing = box((x, top.height - thick / 2, top.depth / 2 + long / 2), (wide, thick, long))
    parts = [*top_parts(draw, top._replace(thickness=thick), {"board": 1.0}), wing]
    post = draw.between(0.03, 0.07)
    near, far = side * (top.width / 2 - post), -side * (top.width / 2 - post)
    back, ahead = -top.depth / 2 + post, z - post
    inner = side * (top.width / 2 - wide + post)
    kind = draw.named("base", {"legs": 0.4, "sides": 0.35, "cabinet": 0.25})
    if kind == "sides":
        parts += [box((far, y / 2, 0), (post, y, top.depth * 0.95)),
                  box((x, y / 2, ahead), (wide * 0.95, y, post)),
                  box((0, y * 0.7, back), (top.width * 0.95, y * 0.6, 0.02))]  # fmt: skip
        at = [(near, back)]
    elif kind == "cabinet":
        deep = min(long, 0.6)
        case = storage.cabinet(draw, (x - wide * 0.45, x + wide * 0.45), top._replace(depth=deep))
        parts += [shift(part, (0, 0, z - deep / 2)) for part in case]
        at = [(far, back), (far, -back), (near, back), (near, ahead), (inner, ahead)]
    else:
        at = [(far, back), (far, -back), (near, back), (near, ahead), (inner, ahead)]
    feet = np.array([[a, 0.0, c] for a, c in at])
    return [*parts, bars(feet, feet + np.array([0, y, 0]), post)]


def _standing_desk(draw: Draw) -> list[Part]:
    top = draw_top(draw, width=(1.0, 1.9), depth=(0.6, 0.85), height=(0.65, 1.2),
                   outlines={"rectangle": 1.0})  # fmt: skip
    parts = top_parts(draw, top, {"board": 1.0})
    parts += frames(draw, top, {"T": 0.8, "columns": 0.2}, beam=0.9)
    return parts + (storage.riser(draw, top) if draw.chance(0.1) else [])


def _coffee(draw: Draw) -> list[Part]:
    top = draw_top(draw, width=(0.7, 1.5), depth=(0.45, 0.85), height=(0.28, 0.5))
    column = "pedestal" if top.width < 1.4 * top.depth else "two pedestals"
    bases = {"legs": 0.44, "frames": 0.22, "sides": 0.12, column: 0.1, "hairpin": 0.06,
             "tripod": 0.04, "bows": 0.03}  # fmt: skip
    return _plain(draw, top, bases, shelf=0.35, drawers=0.12)


def _cubic(draw: Draw) -> list[Part]:
    """A coffee table that is a box: open on one side, of drawers, or solid."""
    top = draw_top(draw, width=(0.5, 1.3), depth=(0.4, 0.8), height=(0.25, 0.5), outlines=STRAIGHT)
    kind = draw.named("base", {"case": 0.4, "cabinet": 0.35, "block": 0.25})
    x = top.width / 2 - draw.between(0.0, 0.03)
    under = top._replace(thickness=min(top.thickness, top.height / 4))
    if kind == "block":
        return top_parts(draw, under) + base_parts(draw, under, {"block": 1.0})
    parts = top_parts(draw, under, {"board": 0.8, "tray": 0.2})
    if kind == "cabinet":
        half = 0.0 if draw.chance(0.5) else x
        left = storage.cabinet(draw, (-x, half), under) if half else []
        return parts + (left or _two_cabinets(draw, x, under))
    y, deep = (0.0, under.height - under.thickness), under.depth * 0.97
    return parts + storage.case(draw, (-x, x), y, deep, shelves=draw.count(0, 1))


def _two_cabinets(draw: Draw, x: float, top: Board) -> list[Part]:
    left = storage.cabinet(draw, (-x, 0.0), top)
    return [*left, *(part._replace(vertices=part.vertices * (-1, 1, 1)) for part in left)]


def _side_table(draw: Draw) -> list[Part]:
    top = draw_top(draw, width=(0.35, 0.7), depth=(0.3, 0.5), height=(0.42, 0.72),
                   outlines={"rectangle": 0.3, "square": 0.35, "round": 0.35})  # fmt: skip
    bases = {"legs": 0.5, "pedestal": 0.14, "frames": 0.12, "tripod": 0.08, "hairpin": 0.05,
             "crossed": 0.04, "block": 0.04, "bows": 0.03}  # fmt: skip
    return _plain(draw, top, bases, shelf=0.4, drawers=0.25)


def _night_stand(draw: Draw) -> list[Part]:
    """A small case of drawers or shelves, on feet or not."""
    top = draw_top(draw, width=(0.36, 0.65), depth=(0.32, 0.5), height=(0.42, 0.7),
                   outlines={"rectangle": 1.0})  # fmt: skip
    x = top.width / 2 - draw.between(0.0, 0.02)
    parts = top_parts(draw, top, {"board": 0.9, "tray": 0.1}) + storage.cabinet(draw, (-x, x), top)
    if min(part.vertices[..., 1].min() for part in parts) > 0.01:
        parts += legs.four_legs(draw, inside(top, 0.97), raked=0.0, tied=0.1)
    return parts


def _bracket(draw: Draw) -> list[Part]:
    """A C: foot, upright and top; it reaches over a bed or a sofa."""
    top = draw_top(draw, width=(0.35, 0.8), depth=(0.3, 0.5), height=(0.55, 0.75),
                   outlines={"rectangle": 0.6, "square": 0.2, "round": 0.2})  # fmt: skip
    thick, x = draw.between(0.015, 0.04), top.width / 2 * draw.between(0.4, 0.9)
    y, back = top.height - top.thickness, -top.depth / 2 + 0.03
    draw.record["base"] = "bracket"
    if draw.chance(0.35):
        foot = box((0, thick / 2, 0), (top.width * 0.9, thick, top.depth))
        upright = box((0, y / 2, back), (2 * x, y, thick))
        return [*top_parts(draw, top), foot, upright]
    level = thick / 2
    starts = np.array([[x, level, top.depth / 2], [x, level, back], [x, y - level, back]])
    ends = np.array([[x, level, back], [x, y, back], [x, y - level, top.depth / 3]])
    tie = np.array([x, level, back])
    return [*top_parts(draw, top), both_sides(bars(starts, ends, thick)),
            bars(tie, tie * (-1, 1, 1), thick)]  # fmt: skip


def _console(draw: Draw) -> list[Part]:
    top = draw_top(draw, width=(0.8, 1.7), depth=(0.25, 0.45), height=(0.7, 0.95),
                   outlines={"rectangle": 0.9, "oval": 0.1})  # fmt: skip
    bases = {"legs": 0.5, "frames": 0.28, "sides": 0.14, "hairpin": 0.04, "crossed": 0.04}
    return _plain(draw, top, bases, shelf=0.45, drawers=0.35)


def _bar(draw: Draw) -> list[Part]:
    top = draw_top(draw, width=(0.6, 1.6), depth=(0.5, 0.75), height=(0.9, 1.12))
    column = "pedestal" if top.width < 1.4 * top.depth else "two pedestals"
    bases = {column: 0.45, "legs": 0.4, "frames": 0.15}
    return _plain(draw, top, bases, shelf=0.12)


def _folding(draw: Draw) -> list[Part]:
    top = draw_top(draw, width=(0.5, 1.4), depth=(0.4, 0.75), height=(0.5, 0.75),
                   outlines={"rectangle": 0.7, "square": 0.2, "round": 0.1})  # fmt: skip
    tops = {"board": 0.6, "planks": 0.3, "tray": 0.1}
    bases = {"scissors": 0.75, "crossed": 0.25}
    return top_parts(draw, top, tops) + base_parts(draw, top, bases)


def _drop_leaf(draw: Draw) -> list[Part]:
    """Leaves that hang down along both long sides, or along one."""
    top = draw_top(draw, width=(0.7, 1.4), depth=(0.3, 0.7), height=(0.68, 0.78),
                   outlines={"rectangle": 1.0})  # fmt: skip
    parts = _plain(draw, top, {"legs": 0.7, "sides": 0.2, "trestle": 0.1}, drawers=0.1)
    long, thick = draw.between(0.2, 0.55), max(min(top.thickness, 0.03), 0.012)
    leaf = box((0, top.height - long / 2, top.depth / 2 + thick / 2), (top.width, long, thick))
    lift = 0.0 if draw.chance(0.7) else draw.between(0.3, 1.2)
    hinge = (0, top.height, top.depth / 2)
    leaf = tilt(leaf, -lift, hinge)
    other = leaf._replace(vertices=leaf.vertices * (1, 1, -1))
    return [*parts, other] if draw.chance(0.25) else [*parts, leaf, other]


def _picnic(draw: Draw) -> list[Part]:
    """A table and two benches on the same trestles."""
    width, depth, height = draw.between(1.3, 2.2), draw.between(0.6, 0.85), draw.between(0.7, 0.78)
    top = Board(width, depth, height, draw.between(0.03, 0.05), 40.0)
    bench, seat = draw.between(0.22, 0.3), draw.between(0.42, 0.47)
    out = depth / 2 + draw.between(0.18, 0.3)
    plank = top._replace(depth=bench, height=seat)
    sets = [(slats(draw, top), 0.0), (slats(draw, plank), out), (slats(draw, plank), -out)]
    parts = [shift(part, (0, 0, z)) for group, z in sets for part in group]
    x, thick = width / 2 * draw.between(0.6, 0.85), draw.between(0.04, 0.07)
    level, under = seat - 0.06, height - 0.06
    cross = draw.chance(0.3)
    head, foot = depth * draw.between(0.2, 0.4), out * draw.between(0.8, 1.05)
    head = -head if cross else head
    starts = np.array([[x, under, head], [x, under, -head], [x, level, -out - bench * 0.4]])
    ends = np.array([[x, 0, foot], [x, 0, -foot], [x, level, out + bench * 0.4]])
    draw.record.update(outline="rectangle", top="planks", base="picnic")
    return [*parts, both_sides(bars(starts, ends, thick, draw.between(0.06, 0.1))),
            bars((-x, under, 0), (x, under, 0), thick)]  # fmt: skip


def _trolley(draw: Draw) -> list[Part]:
    """Shelves between four posts, on castors or not: kitchen trolleys, work benches, tea tables."""
    top = draw_top(draw, width=(0.5, 1.5), depth=(0.35, 0.75), height=(0.6, 0.95),
                   outlines={"rectangle": 1.0})  # fmt: skip
    draw.record["base"] = "posts"
    parts = top_parts(draw, top, {"board": 0.6, "tray": 0.25, "block": 0.15})
    count, low = draw.count(1, 3), draw.between(0.1, 0.25)
    for share in low + (1 - low) * np.arange(count) / count:
        parts += storage.shelf(draw, inside(top, 0.95), float(share))
    wheel = draw.between(0.02, 0.05) if draw.chance(0.5) else 0.0
    under, thick = inside(top, 0.92), draw.between(0.02, 0.07)
    x, z = under.width / 2, under.depth / 2
    at = np.array([[a * x, 0.0, c * z] for a in (-1, 1) for c in (-1, 1)])
    rise = np.array([0, top.height - top.thickness, 0])
    sides_of_post = 8 if draw.chance(0.4) else 4
    parts.append(bars(at + np.array([0, 1.5 * wheel, 0]), at + rise, thick, sides=sides_of_post))
    if wheel:
        hub, half = at + np.array([0, wheel, 0]), np.array([0.012, 0, 0])
        parts.append(bars(hub - half, hub + half, 2 * wheel, sides=10))
    return parts


def _drafting(draw: Draw) -> list[Part]:
    """A sloping board on frames or legs; the low edge is in front."""
    top = draw_top(draw, width=(0.6, 1.5), depth=(0.45, 0.9), height=(0.68, 0.9),
                   outlines={"rectangle": 1.0})  # fmt: skip
    slope = draw.between(0.08, 0.5)
    rise = 0.45 * top.depth * np.tan(slope)
    board = [
        tilt(part, -slope, (0, top.height, 0)) for part in top_parts(draw, top, {"board": 1.0})
    ]
    draw.record["base"] = kind = draw.pick({"frames": 0.5, "legs": 0.5})
    low = top._replace(height=top.height - rise)
    if kind == "frames":
        carried = frames(draw, low, TRESTLES, beam=0.9)
    else:
        carried = legs.four_legs(draw, inside(low, 0.9), scale=1.3, raked=0.0, tied=0.6)
    z, y = 0.45 * top.depth, low.height - low.thickness - 0.02
    x = top.width * 0.42
    prop = bars((x, y, -z), (x, top.height + rise - 0.01, -z), draw.between(0.02, 0.05))
    return [*board, *carried, both_sides(prop),
            box((0, y + 0.01, 0), (2 * x, 0.02, 2 * z))]  # fmt: skip


def _nest(draw: Draw) -> list[Part]:
    """Two or three small tables, each partly under the previous one."""
    top = draw_top(
        draw, width=(0.45, 0.7), depth=(0.35, 0.5), height=(0.45, 0.6), outlines=STRAIGHT
    )
    kind = {draw.pick({"legs": 0.5, "frames": 0.3, "sides": 0.2}): 1.0}
    parts, ahead = [], 0.0
    for size in range(draw.count(2, 3)):
        one = top._replace(width=top.width * (1 - 0.17 * size), height=top.height - 0.06 * size)
        placed = top_parts(draw, one, {"board": 1.0}) + base_parts(draw, one, kind)
        parts += [shift(part, (0, 0, ahead)) for part in placed]
        ahead += draw.between(0.1, 0.25)
    return parts


def _games(draw: Draw) -> list[Part]:
    """A deep tray on stout legs: for billiards, football, sand."""
    top = draw_top(draw, width=(1.2, 2.4), depth=(0.7, 1.3), height=(0.75, 0.88),
                   outlines={"rectangle": 1.0})  # fmt: skip
    deep, rim = draw.between(0.12, 0.3), draw.between(0.03, 0.1)
    body = box((0, top.height - deep / 2, 0), (top.width * 0.97, deep, top.depth * 0.97))
    edge = ring(top, draw.between(0.02, 0.05), 0.1 + rim, top.height + rim - (0.1 + rim) / 2)
    under = top._replace(thickness=deep)
    return [body, edge, *base_parts(draw, under, {"legs": 0.8, "frames": 0.2})]


_STYLES: Styles = {
    "dining": (0.15, _dining),
    "small": (0.11, _small),
    "trestle": (0.06, _trestle),
    "pedestal": (0.1, _pedestal),
    "conference": (0.035, _conference),
    "sides": (0.04, _sides),
    "writing desk": (0.07, _plain_desk),
    "desk": (0.08, _desk),
    "corner desk": (0.015, _corner_desk),
    "standing desk": (0.025, _standing_desk),
    "coffee": (0.11, _coffee),
    "cubic": (0.03, _cubic),
    "side table": (0.055, _side_table),
    "night stand": (0.02, _night_stand),
    "bracket": (0.015, _bracket),
    "console": (0.035, _console),
    "bar": (0.03, _bar),
    "folding": (0.025, _folding),
    "drop leaf": (0.015, _drop_leaf),
    "picnic": (0.01, _picnic),
    "trolley": (0.025, _trolley),
    "drafting": (0.01, _drafting),
    "nest": (0.01, _nest),
    "games": (0.01, _games),
}

TABLES = Family("table", _STYLES)
FREQUENCIES: Weights = TABLES.frequencies
STYLES: tuple[str, ...] = tuple(FREQUENCIES)


def random_table(seed: int | np.integer, *, style: str | None = None) -> trimesh.Trimesh:
    """Make the procedural table of a seed. [host]

    Args:
        seed: Seed of the table, 0 or more; seeds from 1,000,000 on are kept for tests.
        style: One of the styles of `jaxshape.data.tables.STYLES`; None to draw one by its
            frequency.

    Returns:
        A mesh of closed parts that face outwards, in metres, +y up, box centred at the origin, the
        long side of the top along x and the front, where there is one, along +z. Its `metadata`
        holds `style`, `seed` and `drawn`, the named choices (outline, top, base, ...).

    Raises:
        ValueError: The seed is negative, or the style is unknown.
    """
    return make(TABLES, seed, style)
