"""Closed surfaces from plain arrays: all procedural objects are made of lofts, tubes and slabs.

Construction frame: metres, +y up, +z front, the floor at y = 0. A `Part` may be inside out:
`assemble` turns every piece outward, so the primitives need no winding order.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float, Int

from jaxshape.data.procedural.draw import Number

Numbers = np.ndarray | Sequence  # anything that numpy reads as coordinates

X, Y, Z = np.eye(3)


class Part(NamedTuple):
    """`pieces` closed surfaces that share one connectivity.

    Attributes:
        vertices: Vertices of each piece, in metres.
        faces: Indices of the vertices of each triangle.
    """

    vertices: Float[np.ndarray, "pieces v 3"]
    faces: Int[np.ndarray, "f 3"]


@lru_cache(maxsize=256)
def _loft_faces(rings: int, sides: int, loop: bool) -> np.ndarray:
    """Side walls between consecutive rings, and a strip of quads over each end ring."""
    ring, side = np.meshgrid(np.arange(rings if loop else rings - 1), np.arange(sides))
    ring, side = ring.ravel(), side.ravel()
    above, beside = (ring + 1) % rings, (side + 1) % sides
    a, b = ring * sides + side, ring * sides + beside
    c, d = above * sides + beside, above * sides + side
    faces = [np.stack([a, b, c], 1), np.stack([a, c, d], 1)]
    if not loop:
        j = np.arange(sides // 2 - 1)
        bottom, top = np.stack([j, sides - 1 - j, sides - 2 - j, j + 1]), (rings - 1) * sides
        quads = [bottom, bottom[::-1] + top]
        faces += [q[list(k)].T for q in quads for k in ((0, 1, 2), (0, 2, 3)) if j.size]
    return np.concatenate([f for f in faces if len(f)])


def loft(rings: np.ndarray, *, loop: bool = False) -> Part:
    """Skin rings of shape [..., rings, sides, 3]; the ends are capped, or joined by `loop`.

    A cap connects vertex j with vertex sides-1-j: `sides` must be even, and an end ring must be
    convex, or a strip that runs back and forth.
    """
    rings = rings.reshape(-1, *rings.shape[-3:])
    pieces, count, sides, _ = rings.shape
    return Part(rings.reshape(pieces, count * sides, 3), _loft_faces(count, sides, loop))


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.sqrt((v * v).sum(-1, keepdims=True))


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """`np.cross` of 3-vectors, several times faster on the short arrays used here."""
    turned = a * b[..., [1, 2, 0]] - a[..., [1, 2, 0]] * b
    return turned[..., [1, 2, 0]]


@lru_cache(maxsize=64)
def polygon(sides: int) -> np.ndarray:
    """A cross-section that fills [-1, 1]^2: the square for 4 sides, otherwise a circle."""
    angle = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    circle = np.stack([np.cos(angle), np.sin(angle)], 1)
    return np.sign(circle) if sides == 4 else circle


def superellipse(exponent: Number, sides: int = 20, taper: Number = 0) -> np.ndarray:
    """Outline (x, z) in [-1, 1]^2: exponent 2 is round, 10 nearly square; taper narrows z = -1."""
    angle = 2 * np.pi * np.arange(sides) / sides
    c, s = np.cos(angle), np.sin(angle)
    x, z = np.sign(c) * np.abs(c) ** (2 / exponent), np.sign(s) * np.abs(s) ** (2 / exponent)
    return np.stack([x * (1 - taper * (1 - z) / 2), z], 1)


def box(center: Numbers, size: Numbers) -> Part:
    """An axis-aligned block."""
    half_x, half_y, half_z = np.asarray(size) / 2
    x, z = (polygon(4) * (half_x, half_z)).T
    y = np.array([-half_y, half_y])
    corners = np.stack(np.broadcast_arrays(x, y[:, None], z), -1)
    return loft(corners + np.asarray(center))


def bars(
    starts: Numbers,
    ends: Numbers,
    width: Number,
    depth: Number | None = None,
    *,
    sides: int = 4,
    profile: Numbers = (1.0, 1.0),
) -> Part:
    """Straight bars; `profile` scales the cross-section at equal intervals from start to end.

    `width` is measured along x on upright bars and horizontally on lying ones.
    """
    starts, ends = np.atleast_2d(starts), np.atleast_2d(ends)
    profile = np.asarray(profile)
    axis = unit(ends - starts)
    upright = np.abs(axis[:, 1:2]) > 0.7
    side = unit(cross(axis, np.where(upright, Z, Y)))
    other = cross(side, axis)
    along = np.linspace(0, 1, len(profile))[:, None, None]
    section = polygon(sides) * (width / 2, (depth or width) / 2)
    ring = section[:, :1] * side[:, None, None] + section[:, 1:] * other[:, None, None]
    centers = starts[:, None, None] * (1 - along) + ends[:, None, None] * along
    return loft(centers + ring * profile[:, None, None])


def tubes(
    paths: np.ndarray,
    radius: Number | np.ndarray,
    *,
    across: Number | None = None,
    sides: int = 8,
    loop: bool = False,
) -> Part:
    """Bent tubes along paths of shape [..., points, 3].

    `radius` lies in the plane of the path, `across` out of it; both may vary with the point.
    """
    paths = paths.reshape(-1, *paths.shape[-2:])
    if loop:
        tangent = unit(np.roll(paths, -1, 1) - np.roll(paths, 1, 1))
    else:
        step = unit(np.diff(paths, axis=1))
        tangent = np.concatenate([step[:, :1], step[:, 1:] + step[:, :-1], step[:, -1:]], 1)
        tangent = unit(tangent)
    centered = paths - paths.mean(1, keepdims=True)
    _, directions = np.linalg.eigh(centered.swapaxes(1, 2) @ centered)
    binormal = np.broadcast_to(directions[:, None, :, 0], tangent.shape)
    binormal = unit(binormal - (binormal * tangent).sum(-1, keepdims=True) * tangent)
    normal = cross(binormal, tangent)
    inward = np.broadcast_to(np.asarray(radius), paths.shape[1:2])[:, None]
    outward = inward if across is None else np.full_like(inward, across)
    section = polygon(sides)
    ring = (inward * section[:, 0])[..., None] * normal[:, :, None]
    ring = ring + (outward * section[:, 1])[..., None] * binormal[:, :, None]
    return loft(paths[:, :, None] + ring, loop=loop)


def bend(corners: Numbers, radius: Number, steps: int = 4) -> np.ndarray:
    """A polyline with every inner corner rounded: the path of a bent tube, [points, 3]."""
    corners = np.asarray(corners, float)
    before, corner, after = corners[:-2], corners[1:-1], corners[2:]

    def toward(other: np.ndarray) -> np.ndarray:
        length = np.sqrt(((other - corner) ** 2).sum(-1, keepdims=True))
        return (other - corner) / length * np.minimum(radius, 0.49 * length)

    t = np.linspace(0, 1, steps)[:, None]
    arcs = corner[:, None] + (1 - t) ** 2 * toward(before)[:, None] + t**2 * toward(after)[:, None]
    return np.concatenate([corners[:1], arcs.reshape(-1, 3), corners[-1:]])


def slab(surface: np.ndarray, thickness: Number | np.ndarray) -> Part:
    """Thicken surface grids [..., rows, columns, 3] by half to each side."""
    surface = surface.reshape(-1, *surface.shape[-3:])
    rows = np.concatenate(
        [surface[:, 1:2] - surface[:, :1], surface[:, 2:] - surface[:, :-2],
         surface[:, -1:] - surface[:, -2:-1]], 1)  # fmt: skip
    columns = np.concatenate(
        [surface[:, :, 1:2] - surface[:, :, :1], surface[:, :, 2:] - surface[:, :, :-2],
         surface[:, :, -1:] - surface[:, :, -2:-1]], 2)  # fmt: skip
    half = unit(cross(rows, columns)) * (np.asarray(thickness)[..., None] / 2)
    return loft(np.concatenate([surface + half, (surface - half)[:, :, ::-1]], 2))


def plate(outline: np.ndarray, size: Numbers, top: Number, dip: Number = 0.0) -> Part:
    """A board of the given outline (x, z) whose upper face lies at `top`; `dip` bevels its foot."""
    width, thickness, depth = np.asarray(size)
    rings = np.empty((2, len(outline), 3))
    rings[:, :, 0::2] = outline * (width / 2, depth / 2)
    rings[0, :, 0::2] *= 1 - dip
    rings[:, :, 1] = np.array([top - thickness, top])[:, None]
    return loft(rings)


def cushion(
    center: Numbers,
    size: Numbers,
    *,
    outline: np.ndarray | None = None,
    edge: Number = 0.3,
    crown: Number = 0,
) -> Part:
    """A pad with rounded edges, flat in y; `edge` is the edge radius over the smallest size.

    `crown` lifts the middle of both faces, in metres.
    """
    outline = superellipse(7.0) if outline is None else outline
    width, thickness, depth = np.asarray(size)
    narrow = min(width, depth) / 2
    radius = edge * min(narrow * 2, thickness)
    inset = np.array([radius + 0.3 * narrow, radius, 0.3 * radius, 0.0])
    height = thickness / 2 - np.array([-crown, 0.0, 0.3 * radius, radius])
    shrink = np.r_[1 - inset / narrow, 1 - inset[::-1] / narrow]
    rings = np.empty((8, len(outline), 3))
    rings[:, :, 0::2] = shrink[:, None, None] * outline * (width / 2, depth / 2)
    rings[:, :, 1] = np.r_[height, -height[::-1]][:, None]
    return loft(rings + np.asarray(center))


def lathe(profile: Numbers, center: Numbers = (0.0, 0.0), sides: int = 16) -> Part:
    """Revolve (radius, y) pairs about the vertical through `center` (x, z)."""
    radius, y = np.asarray(profile, float).T
    rings = np.empty((len(radius), sides, 3))
    rings[:, :, 0::2] = polygon(sides) * radius[:, None, None] + np.asarray(center)
    rings[:, :, 1] = y[:, None]
    return loft(rings)


def tilt(part: Part, angle: Number, pivot: Numbers) -> Part:
    """Rotate about the x axis through `pivot`; a positive angle leans the top backward."""
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.array([[1, 0, 0], [0, c, s], [0, -s, c]])
    pivot = np.asarray(pivot)
    return part._replace(vertices=(part.vertices - pivot) @ rotation.T + pivot)


def turn(part: Part, angle: Number) -> Part:
    """Rotate about the vertical through the origin."""
    c, s = np.cos(angle), np.sin(angle)
    return part._replace(vertices=part.vertices @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]))


def shift(part: Part, offset: Numbers) -> Part:
    return part._replace(vertices=part.vertices + np.asarray(offset))


def both_sides(part: Part) -> Part:
    """The part and its mirror image in x = 0."""
    return part._replace(vertices=np.concatenate([part.vertices, part.vertices * (-1, 1, 1)]))


def assemble(parts: Sequence[Part]) -> trimesh.Trimesh:
    """Join the parts into one mesh, each piece facing outward, its box centred at the origin."""
    vertices = np.concatenate([part.vertices.reshape(-1, 3) for part in parts])
    faces, sizes, offset = [], [], 0
    for part in parts:
        pieces, count, _ = part.vertices.shape
        starts = offset + count * np.arange(pieces)
        faces.append((part.faces + starts[:, None, None]).reshape(-1, 3))
        sizes += [len(part.faces)] * pieces
        offset += pieces * count
    faces = np.concatenate(faces)
    vertices = vertices - (vertices.min(0) + vertices.max(0)) / 2
    a, b, c = vertices[faces.T]
    starts = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    volume = np.add.reduceat((a * cross(b, c)).sum(-1), starts)
    inside_out = np.repeat(volume < 0, sizes)
    faces[inside_out] = faces[inside_out][:, ::-1]
    return trimesh.Trimesh(vertices, faces, process=False)
