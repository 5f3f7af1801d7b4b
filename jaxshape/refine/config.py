"""Settings of a search; free of JAX, so that the command line can show them at once."""

from dataclasses import dataclass
from typing import Literal

Method = Literal["encoder", "gradient", "cma"]
METHODS: tuple[Method, ...] = ("encoder", "gradient", "cma")


@dataclass(frozen=True)
class RefineConfig:
    """How a shape is searched for."""

    objective: Literal["balanced", "paper"] = "balanced"
    """`paper` is Eq. 7 as printed; `balanced` weighs measured occupied voxels three times."""
    iterations: int = 350
    """Steps of the search (paper: 350)."""
    population: int = 17
    """Candidates per CMA-ES iteration (pycma's default for 100 dimensions)."""
    sigma0: float = 0.1
    """First step size of CMA-ES, in standard deviations of the training codes."""
    step_size: float = 0.14
    """Of gradient descent, on the codes themselves (paper: 0.14)."""
