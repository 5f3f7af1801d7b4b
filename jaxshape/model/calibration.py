"""Calibration of decoded logits as probabilities.

Networks are too sure of voxels that nobody saw. Three numbers, fitted to objects that the network
was not trained on and stored with its weights, correct that: see `Calibration`.
"""

from typing import NamedTuple

import jax
from jaxtyping import Array, Float


class Calibration(NamedTuple):
    """A map from logits to probabilities that come true as often as they say.

    It is Platt scaling with a slope that falls with the spread of the samples of the posterior:
    where shapes that explain the measurement equally well differ, a logit is believed less.

    Attributes:
        slope: Factor of a logit on which all samples agree, above 0.
        doubt: By how much the slope falls for a standard deviation of the samples' logits of 1, 0
            or more.
        offset: Logit to add.
    """

    slope: Float[Array, ""] | float = 1.0
    doubt: Float[Array, ""] | float = 0.0
    offset: Float[Array, ""] | float = 0.0

    def probability(
        self, logits: Float[Array, "*voxel"], spread: Float[Array, "*voxel"]
    ) -> Float[Array, "*voxel"]:
        """The probability that voxels are occupied, from 0 to 1.

        Args:
            logits: Logits of voxels of the decoded shape `[*voxel]`.
            spread: Standard deviation of their samples' logits `[*voxel]`, 0 or more.
        """
        slope = jax.nn.relu(self.slope - self.doubt * spread)
        return jax.nn.sigmoid(slope * logits + self.offset)


UNCALIBRATED = Calibration()
"""Takes logits at their word, for weights that were not calibrated."""
