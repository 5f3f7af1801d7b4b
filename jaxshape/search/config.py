"""Settings of a search; free of JAX, so that the command line can show them at once."""

from dataclasses import dataclass
from typing import Literal

from jaxshape.model.config import Precision


@dataclass(frozen=True)
class RefineConfig:
    """How a shape is searched for."""

    objective: Literal["balanced", "paper", "soft"] = "balanced"
    """`paper` is Eq. 7 as printed; in `balanced` measured free space counts a third; in `soft` each
    voxel counts by how sure its measurement is."""
    iterations: int = 350
    """Steps of the search at most (paper: 350)."""
    population: int = 17
    """Candidates per iteration of a population search (pycma's default for 100 dimensions)."""
    sigma0: float = 0.1
    """First standard deviation of a population, in units of the search space."""
    step_size: float | None = None
    """Learning rate of gradient methods; the method's own where it is not given."""
    space: Literal["whitened", "raw"] = "whitened"
    """Coordinates of the search: those in which the training codes have mean 0 and covariance I, or
    the codes themselves (paper)."""
    bound: float | None = None
    """Keep every coordinate within this distance of 0; in the whitened space, the mean code."""
    prior_weight: float = 0.0
    """Of the codes' own distribution: 1 adds its negative log-density to that of the voxels."""
    tolerance: float = 1e-6
    """Stop where the objective of recent candidates differs by less than this; 0 never stops."""
    target: float | None = None
    """Stop where the objective is this low."""
    precision: Precision = "float32"
    """Of the decoder's arithmetic during the search."""
