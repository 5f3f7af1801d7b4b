"""A family of procedural objects: its styles, how often each is drawn, and how one is made."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import trimesh

from jaxshape.data.procedural.draw import Draw, Weights
from jaxshape.data.procedural.primitives import Part, assemble

Styles = dict[str, tuple[float, Callable[[Draw], list[Part]]]]
"""The weight of each style and the function that draws its parts."""

CHILD_SHARE = 0.04
STOUT_SHARE = 0.3


class Family(NamedTuple):
    """Procedural objects of one class.

    Attributes:
        name: Name of the class: "chair", "table".
        styles: Styles of the class, each with its weight and the function that draws its parts.
    """

    name: str
    styles: Styles

    @property
    def frequencies(self) -> Weights:
        """The share of each style among the objects of the family."""
        total = sum(weight for weight, _ in self.styles.values())
        return {name: weight / total for name, (weight, _) in self.styles.items()}


def make(family: Family, seed: int | np.integer, style: str | None = None) -> trimesh.Trimesh:
    """Make the object of a seed, for `random_chair` and `random_table`. [host]"""
    if seed < 0:
        raise ValueError(f"A {family.name}'s seed was {seed}; give a whole number from 0 up.")
    styles = family.styles
    if style is not None and style not in styles:
        raise ValueError(
            f"Unknown {family.name} style {style!r}; choose one of {', '.join(styles)}."
        )
    draw = Draw(np.random.default_rng(seed))
    drawn_style = draw.pick(family.frequencies)
    style = drawn_style if style is None else style
    if draw.chance(STOUT_SHARE):
        draw.stoutness = draw.between(0.7, 2.6)
    mesh = assemble(styles[style][1](draw))
    if draw.chance(CHILD_SHARE):
        mesh.apply_scale(draw.between(0.55, 0.8))
        draw.record["for"] = "child"
    mesh.metadata.update(style=style, seed=int(seed), drawn=draw.record)
    return mesh
