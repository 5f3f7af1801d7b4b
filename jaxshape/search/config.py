"""Settings of a search; free of JAX, so that the command line can show them at once."""

import math
from dataclasses import dataclass
from typing import Any, Literal, get_args

from jaxshape.checks import at_least, one_of, positive, whole, within
from jaxshape.model.config import Precision

ObjectiveName = Literal["balanced", "paper", "soft"]
Space = Literal["whitened", "raw"]


def is_array(value: Any) -> bool:
    """Whether a setting is an array of JAX, which may be traced, so that its value is unknown."""
    return hasattr(value, "aval")


@dataclass(frozen=True)
class RefineConfig:
    """How a shape is searched for.

    Attributes:
        objective: `paper` is Eq. 7 as printed; in `balanced` measured free space counts a third; in
            `soft` each voxel counts by how sure its measurement is.
        iterations: Steps of the search at most, 1 or more (paper: 350).
        population: Candidates per iteration of a population search, 3 or more (pycma's default for
            100 dimensions is 17).
        sigma0: First standard deviation of a population, above 0, in units of the search space.
        step_size: Learning rate of gradient methods, above 0; the method's own where it is None.
        space: Coordinates of the search: `whitened`, in which the training codes have mean 0 and
            covariance I, or `raw`, the codes themselves (paper).
        bound: The search keeps every coordinate within this distance of 0, in the whitened space
            the mean code. Above 0, in units of the search space; None for no bounds.
        prior_weight: Weight of the distribution of the training codes, 0 or more: 1 adds their
            negative log-density to that of the voxels.
        tolerance: The search stops where the objective of recent candidates differs by less than
            this, in nats per voxel; 0 never stops it.
        target: The search stops where the objective is this low, in nats per voxel; None for no
            target.
        precision: Arithmetic of the decoder during the search.

    Raises:
        ValueError: A setting is outside its range. Arrays of JAX, which may be traced, are not
            checked.
    """

    objective: ObjectiveName = "balanced"
    iterations: int = 350
    population: int = 17
    sigma0: float = 0.1
    step_size: float | None = None
    space: Space = "whitened"
    bound: float | None = None
    prior_weight: float = 0.0
    tolerance: float = 1e-6
    target: float | None = None
    precision: Precision = "float32"

    def __post_init__(self) -> None:
        one_of("objective", self.objective, get_args(ObjectiveName))
        one_of("space", self.space, get_args(Space))
        one_of("precision", self.precision, get_args(Precision))
        whole("iterations", self.iterations, 1)
        whole("population", self.population, 3)
        for name in ("sigma0", "step_size", "bound"):
            value = getattr(self, name)
            if not (is_array(value) or (value is None and name != "sigma0")):
                positive(name, value)
        for name in ("prior_weight", "tolerance"):
            if not is_array(getattr(self, name)):
                at_least(name, getattr(self, name), 0)
        if not (self.target is None or is_array(self.target)):
            within("target", self.target, -math.inf, math.inf)
