"""Procedural objects of all families, by name and seed. [host]"""

from typing import NamedTuple

import trimesh

from jaxshape.data.chairs import random_chair
from jaxshape.data.config import FamilyName
from jaxshape.data.tables import random_table

FAMILIES = {"chair": random_chair, "table": random_table}
"""The function that makes the object of a seed, for each family."""

TEST_SEEDS = 1_000_000
"""Procedural objects from this seed on are for tests; training uses smaller ones."""


class Procedural(NamedTuple):
    """A procedural object that is not made yet.

    Attributes:
        family: Name of its family: "chair", "table".
        seed: Seed of the object, 0 or more.
    """

    family: FamilyName
    seed: int

    @property
    def name(self) -> str:
        """The family and the seed, as "table-7"."""
        return f"{self.family}-{self.seed}"

    def make(self) -> trimesh.Trimesh:
        """The mesh."""
        return FAMILIES[self.family](self.seed)


def procedural_objects(family: FamilyName, count: int, start: int = 0) -> list[Procedural]:
    """`count` objects of a family, of seeds from `start` on: `TEST_SEEDS` for tests."""
    return [Procedural(family, seed) for seed in range(start, start + count)]
