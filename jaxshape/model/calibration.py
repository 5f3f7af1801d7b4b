"""Calibration of decoded logits as probabilities.

Networks are overconfident in voxels that were not measured. Three numbers correct this; they are
fitted to objects outside the training set and stored with the weights: see `Calibration`.
"""

from typing import NamedTuple

import jax
from jaxtyping import Array, Float


class Calibration(NamedTuple):
    """A map from logits to calibrated probabilities.

    It is Platt scaling with a slope that decreases with the spread of the posterior samples: where
    shapes that explain the measurement equally well differ, a logit counts less.

    Attributes:
        slope: Factor of a logit on which all samples agree, above 0.
        doubt: Decrease of the slope per unit of standard deviation of the samples' logits, 0 or
            more.
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
"""The sigmoid of the logits without correction, for weights that were not calibrated."""
