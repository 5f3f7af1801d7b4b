"""Names of the ways in which frames are fused.

Nothing here imports JAX, so that the command line answers at once.
"""

from typing import Literal

FusionName = Literal["distance", "points"]
"""Signed distances, or the paper's points in voxels (`geometry/fusing`)."""
