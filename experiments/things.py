"""Things that are neither chairs nor tables: boxes, plants, lamps, bins and balls.

Made of trimesh's primitives, +y up, metres, their boxes centred at the origin.
"""

from typing import Any

import numpy as np
import trimesh

KINDS = ("box", "plant", "lamp", "bin", "ball")


def thing(kind: str, seed: int) -> trimesh.Trimesh:
    """An object of a kind, from a seed."""
    rng = np.random.default_rng([KINDS.index(kind), seed])
    mesh = {"box": _box, "plant": _plant, "lamp": _lamp, "bin": _bin, "ball": _ball}[kind](rng)
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    return mesh


def _box(rng: np.random.Generator) -> trimesh.Trimesh:
    return trimesh.creation.box(rng.uniform(0.3, 0.8, 3))


def _plant(rng: np.random.Generator) -> trimesh.Trimesh:
    """A pot, a stem, and leaves: thin ellipsoids all around."""
    radius, height = rng.uniform(0.12, 0.2), rng.uniform(0.2, 0.35)
    parts = [_upright(radius, height, 0)]
    stem = rng.uniform(0.3, 0.7)
    parts.append(_upright(0.015, stem, height))
    for _ in range(rng.integers(14, 30)):
        leaf = trimesh.creation.icosphere(subdivisions=2)
        leaf.apply_scale([rng.uniform(0.08, 0.16), 0.012, rng.uniform(0.04, 0.07)])
        leaf.apply_transform(trimesh.transformations.random_rotation_matrix(rng.random(3)))
        spread = rng.uniform(0.05, 0.25)
        angle = rng.uniform(0, 2 * np.pi)
        y = height + stem * rng.uniform(0.4, 1.1)
        leaf.apply_translation([spread * np.cos(angle), y, spread * np.sin(angle)])
        parts.append(leaf)
    return _together(parts)


def _lamp(rng: np.random.Generator) -> trimesh.Trimesh:
    """A foot, a pole and a shade."""
    height = rng.uniform(0.9, 1.6)
    shade = trimesh.creation.cone(rng.uniform(0.18, 0.3), rng.uniform(0.25, 0.4), sections=24)
    shade.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))
    shade.apply_translation([0, height - 0.1, 0])
    return _together([_upright(rng.uniform(0.12, 0.2), 0.03, 0), _upright(0.02, height, 0), shade])


def _together(parts: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    mesh: Any = trimesh.util.concatenate(parts)
    return mesh


def _bin(rng: np.random.Generator) -> trimesh.Trimesh:
    return _upright(rng.uniform(0.14, 0.28), rng.uniform(0.3, 0.75), 0)


def _ball(rng: np.random.Generator) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=3, radius=rng.uniform(0.15, 0.35))


def _upright(radius: float, height: float, bottom: float) -> trimesh.Trimesh:
    """A cylinder that stands at a height."""
    mesh = trimesh.creation.cylinder(radius, height, sections=24)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))
    mesh.apply_translation([0, bottom + height / 2, 0])
    return mesh
