"""Readable draws from a random generator, recorded by name."""

import numpy as np

Number = float | int
Range = tuple[Number, Number]
Weights = dict[str, float]


class Draw:
    """The random choices of one object.

    `record` keeps the named choices for the mesh's metadata; `stoutness` makes all bars of the
    frame thicker or thinner than usual.
    """

    def __init__(self, rng: np.random.Generator):
        self._rng = rng
        self.stoutness = 1.0
        self.record: dict[str, str | float] = {}

    def between(self, low: Number, high: Number) -> float:
        return low + (high - low) * self._rng.random()

    def thick(self, low: Number, high: Number) -> float:
        """A thickness, in metres: `between`, times this object's stoutness."""
        return self.stoutness * self.between(low, high)

    def chance(self, probability: Number) -> bool:
        return self._rng.random() < probability

    def count(self, low: int, high: int) -> int:
        """A whole number from low to high, both included."""
        return low + int(self._rng.random() * (high - low + 1))

    def pick(self, options: Weights) -> str:
        """A name drawn in proportion to its weight."""
        mark = self._rng.random() * sum(options.values())
        *others, last = options
        for name in others:
            mark -= options[name]
            if mark < 0:
                return name
        return last

    def named(self, trait: str, options: Weights) -> str:
        """`pick`, recorded under the name of the trait."""
        name = self.pick(options)
        self.record[trait] = name
        return name
