"""Names of the fusion methods.

Nothing here imports JAX, so that the command line starts quickly.
"""

from typing import Literal

FusionName = Literal["distance", "points"]
"""Signed distances, or the paper's points in voxels (`geometry/fusing`)."""
