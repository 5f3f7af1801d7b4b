"""Storage in tables: shelves, drawers under the top, the cabinets and shelves of desks."""

import numpy as np

from jaxshape.data.procedural.boards import Board, outline_of, slats
from jaxshape.data.procedural.draw import Draw, Number, Range
from jaxshape.data.procedural.primitives import Part, bars, box, lathe, plate, shift, tilt
from jaxshape.data.tables.tops import inside


def shelf(draw: Draw, top: Board, share: Number | None = None) -> list[Part]:
    """A shelf between the legs at a share of their height, of one board or of slats.

    `top` has the size of the board above the legs.
    """
    share = draw.between(0.12, 0.5) if share is None else share
    under = inside(top, draw.between(0.96, 1.0))
    under = under._replace(height=top.height * share, thickness=draw.between(0.012, 0.035))
    draw.record["shelf"] = round(share, 2)
    if draw.chance(0.2) and under.exponent > 2.5:
        return slats(draw, under._replace(thickness=0.03))
    size = (under.width, under.thickness, under.depth)
    return [plate(outline_of(under), size, under.height)]


def drawers_under(draw: Draw, top: Board) -> list[Part]:
    """A flat case under the top with one to four drawers side by side."""
    high = draw.between(0.07, 0.2)
    wide, deep = top.width * draw.between(0.7, 0.97), top.depth * draw.between(0.75, 0.97)
    y = top.height - top.thickness
    count = max(1, min(4, round(wide / draw.between(0.35, 0.9))))
    draw.record["drawers"] = count
    case = box((0, y - high / 2, 0), (wide, high, deep))
    return [case, *_fronts(draw, (-wide / 2, wide / 2), (y - high, y), deep / 2, (count, 1))]


def _fronts(draw: Draw, x: Range, y: Range, z: Number, grid: tuple[int, int]) -> list[Part]:
    """Drawer fronts with handles on a case's face at z; `grid` is their number across and up."""
    across, upward = grid
    out, gap = draw.between(0.006, 0.02), draw.between(0.006, 0.02)
    wide, high = (x[1] - x[0]) / across, (y[1] - y[0]) / upward
    center = np.array([[x[0] + (i + 0.5) * wide, y[0] + (j + 0.5) * high, z + out / 2]
                       for i in range(across) for j in range(upward)])  # fmt: skip
    parts = [box(c, (wide - gap, high - gap, out)) for c in center]
    handle = draw.pick({"none": 0.3, "bar": 0.4, "knob": 0.3})
    tip = center + np.array([0, 0, out / 2])
    reach = draw.between(0.015, 0.035)
    if handle == "knob":
        parts.append(bars(tip, tip + np.array([0, 0, reach]), draw.between(0.015, 0.035), sides=8))
    elif handle == "bar":
        half = wide * draw.between(0.1, 0.35)
        middle = tip + np.array([0, 0, reach / 2])
        parts.append(bars(middle - (half, 0, 0), middle + (half, 0, 0), reach, 0.012))
    return parts


def cabinet(draw: Draw, x: Range, top: Board) -> list[Part]:
    """A case of drawers, a cupboard or open shelves between two places along x, under the top."""
    y, deep = top.height - top.thickness, top.depth * draw.between(0.85, 0.98)
    kind = draw.pick({"drawers": 0.6, "door": 0.15, "open": 0.25})
    low = draw.pick({"floor": 0.5, "plinth": 0.25, "hung": 0.25})
    foot = {"floor": 0.0, "plinth": draw.between(0.04, 0.14), "hung": y * 0.45}[low]
    middle, wide = (x[0] + x[1]) / 2, x[1] - x[0]
    parts = []
    if low == "plinth":
        at = np.array([[a, 0.0, c * (deep / 2 - 0.05)] for a in (x[0] + 0.04, x[1] - 0.04)
                       for c in (-1, 1)])  # fmt: skip
        parts.append(bars(at, at + np.array([0, foot + 0.01, 0]), draw.between(0.02, 0.045)))
    if kind == "open":
        return parts + case(draw, x, (foot, y), deep, shelves=draw.count(0, 2))
    parts.append(box((middle, (foot + y) / 2, 0), (wide, y - foot, deep)))
    count = 1 if kind == "door" else draw.count(2, 4)
    if low == "hung":
        count = min(count, 2)
    return parts + _fronts(draw, x, (foot, y), deep / 2, (1, count))


def case(draw: Draw, x: Range, y: Range, deep: Number, *, shelves: int) -> list[Part]:
    """A box of boards that is open in front."""
    thick, wide, high = draw.between(0.014, 0.03), x[1] - x[0], y[1] - y[0]
    center, middle = (x[0] + x[1]) / 2, (y[0] + y[1]) / 2
    parts = [box((at, middle, 0), (thick, high, deep)) for at in (x[0] + thick / 2,
                                                                  x[1] - thick / 2)]  # fmt: skip
    level = y[0] + thick / 2 + (high - thick) * np.arange(shelves + 2) / (shelves + 1)
    parts += [box((center, at, 0), (wide, thick, deep)) for at in level]
    if draw.chance(0.75):
        parts.append(box((center, middle, -deep / 2 + 0.006), (wide, high, 0.012)))
    return parts


def riser(draw: Draw, top: Board) -> list[Part]:
    """Attachments at the back of a desk's top: shelves, a low gallery, a screen or a mirror."""
    kind = draw.named("riser", {"shelves": 0.5, "gallery": 0.25, "screen": 0.15, "mirror": 0.1})
    wide, back = top.width * draw.between(0.8, 1.0), -top.depth / 2
    if kind == "mirror":
        radius = draw.between(0.2, 0.32)
        pane = lathe([(radius, -0.01), (radius, 0.01)], sides=24)
        up = tilt(pane, np.pi / 2, (0, 0, 0))
        post = bars((0, top.height - 0.01, back + 0.03), (0, top.height + 0.1, back + 0.03), 0.05)
        return [post, shift(up, (0, top.height + 0.06 + radius, back + 0.03))]
    if kind == "screen":
        high = draw.between(0.15, 0.45)
        return [box((0, top.height + high / 2, back + 0.012), (wide, high, 0.024))]
    low = kind == "gallery"
    high = draw.between(0.08, 0.2) if low else draw.between(0.25, 0.75)
    deep = top.depth * draw.between(0.25, 0.45)
    levels = (top.height - 0.01, top.height + high)
    parts = case(draw, (-wide / 2, wide / 2), levels, deep, shelves=0 if low else draw.count(0, 2))
    return [shift(part, (0, 0, back + deep / 2)) for part in parts]
