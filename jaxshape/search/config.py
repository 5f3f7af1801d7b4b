"""Settings of a search. Nothing here imports JAX, so that the command line answers at once."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

from jaxshape.checks import at_least, one_of, positive, whole, within
from jaxshape.limits import POPULATION, STEPS
from jaxshape.model.config import Precision

if TYPE_CHECKING:
    from jax import Array

    Number = float | Array
else:
    Number = float  # JAX is not imported, and the command line reads its options from the types

ObjectiveName = Literal["balanced", "paper", "soft"]
Space = Literal["whitened", "raw"]


def objective_for(fusion: str) -> ObjectiveName:
    """The objective that suits the grids of a fusion method.

    Args:
        fusion: "distance", whose F and M are soft, or "points", whose F and M are binary.
    """
    return "soft" if fusion == "distance" else "balanced"


@dataclass(frozen=True)
class RefineConfig:
    """Settings of a search for the shape of an object.

    Numbers that are not counts may be traced by JAX, so that `jax.vmap` searches with many values
    in one program (docs/examples/sweep.py); traced values are not checked.

    Attributes:
        objective: The residual that is minimised: `paper` is Eq. 7 as printed; in `balanced`
            measured free space counts a third; in `soft` each voxel counts by how sure its
            measurement is. None selects `soft` if F and M are soft, as signed distances give them,
            and `balanced` if they are binary.
        iterations: Steps of the search at most, 1 or more (paper: 350).
        population: Candidates per iteration of a population search, 3 or more (pycma's default for
            100 dimensions is 17).
        sigma0: First standard deviation of a population, above 0, in units of the search space.
        step_size: Learning rate of gradient methods, above 0; None for the method's own.
        space: Coordinates of the search: `whitened`, in which the training codes have mean 0 and
            covariance I, or `raw`, the codes themselves (paper).
        bound: The search keeps every coordinate within this distance of the centre, which is the
            mean code in the whitened space and 0 in the raw one. Above 0, in units of the search
            space; None for no bounds.
        prior_weight: Weight of the codes' prior density, 0 or more: 1 adds the negative log-density
            of the code, under the training codes, to the objective.
        tolerance: The search stops when the objectives of recent candidates differ by less than
            this, 0 or more, in nats per voxel; 0 never stops it.
        target: The search stops when the objective has fallen to this value, in nats per voxel;
            None for no target.
        precision: Precision of the decoder's matrix products during the search, `float32` or
            `bfloat16`.
        symmetry: Fill the hidden part of one side of an object from its mirror image, where the
            measured halves agree (not in the paper). It does not change the search itself.
        samples: Shapes to draw from the posterior of each object after its search, 0 or more; they
            give the uncertainty of each voxel. A single sample gives no uncertainty.

    Raises:
        ValueError: A setting is outside its range.
    """

    objective: ObjectiveName | None = None
    iterations: int = 350
    population: int = 17
    sigma0: Number = 0.1
    step_size: Number | None = None
    space: Space = "whitened"
    bound: Number | None = None
    prior_weight: Number = 0.0
    tolerance: Number = 1e-6
    target: Number | None = None
    precision: Precision = "float32"
    symmetry: bool = True
    samples: int = 0

    def __post_init__(self) -> None:
        if self.objective is not None:
            one_of("objective", self.objective, get_args(ObjectiveName))
        one_of("space", self.space, get_args(Space))
        one_of("precision", self.precision, get_args(Precision))
        one_of("symmetry", self.symmetry, (True, False))
        whole("iterations", self.iterations, 1, STEPS)
        whole("population", self.population, 3, POPULATION, "each is a shape to decode")
        whole("samples", self.samples, 0, POPULATION, "each is a shape to decode")
        for name in ("sigma0", "step_size", "bound"):
            value = getattr(self, name)
            if value is not None or name == "sigma0":
                positive(name, value)
        for name in ("prior_weight", "tolerance"):
            at_least(name, getattr(self, name), 0)
        if self.target is not None:
            within("target", self.target, -math.inf, math.inf)
