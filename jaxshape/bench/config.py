"""Budgets, targets and settings of the benchmark. Nothing here imports JAX."""

from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, get_args

from jaxshape import checks
from jaxshape.search.config import Number, RefineConfig, Space

KindName = Literal["clean", "noisy"]
KINDS: tuple[KindName, ...] = get_args(KindName)
"""Grids from points of the paper's camera without noise, and from signed distances of a Kinect's
noisy frames."""

FRAMES = (1, 4, 8)
"""Numbers of fused frames, the first of an orbit at 30 degrees elevation."""

BUDGETS = (128, 512, 2048)
"""Decoder calls after which searches are compared."""

SECONDS = 1.0
"""Wall-clock budget of a shape."""

LADDER = (0, *(2**k for k in range(3, 12)))
"""Numbers of decoder calls at which the best code so far is decoded."""

LEFT = tuple(10 ** (-k / 10) for k in range(1, 21))
"""Targets by objective: remaining share of the gap between the objective of the first code and the
lowest known objective, from 0.79 to 0.01."""

GAINS = (0.01, 0.02, 0.04, 0.08, 0.16)
"""Targets by IoU: gains over the IoU of the first code."""

AT_A_TIME = 8
"""Default number of problems searched together: as many as the rows that a CPU scores together."""


@dataclass(frozen=True)
class BenchConfig:
    """Settings of the searches of a benchmark; `RefineConfig` explains those of the search.

    Attributes:
        population: Candidates per iteration of a population search, 3 or more.
        sigma0: First standard deviation of a population, above 0, in units of the search space.
        step_size: Learning rate of gradient methods, above 0; None for the method's own.
        space: Coordinates of the search: `whitened`, or `raw`, the codes themselves.
        bound: The search keeps every coordinate within this distance of the centre; above 0, in
            units of the search space. None for no bounds.
        tolerance: The search stops when the objectives of recent candidates differ by less than
            this, 0 or more, in nats per voxel; 0 never stops it.
        budget: Decoder calls that each problem may spend, 8 to 2,048; a gradient counts as three.
        seed: Seed of the searches, 0 or more.
        at_a_time: Problems searched together, 1 or more. It changes only the seconds.

    Raises:
        ValueError: A setting is outside its range.
    """

    population: int = RefineConfig.population
    sigma0: Number = RefineConfig.sigma0
    step_size: float | None = None
    space: Space = RefineConfig.space
    bound: float | None = None
    tolerance: Number = RefineConfig.tolerance
    budget: int = BUDGETS[-1]
    seed: int = 0
    at_a_time: int = AT_A_TIME

    def __post_init__(self) -> None:
        self.search()
        checks.whole("budget", self.budget, LADDER[1])
        checks.within("budget", self.budget, LADDER[1], LADDER[-1])
        checks.whole("seed", self.seed, 0)
        checks.whole("at_a_time", self.at_a_time, 1)

    def search(self) -> RefineConfig:
        """The settings with which searches are built."""
        iterations = max(1, self.budget // max(1, self.population))
        return RefineConfig(iterations=iterations, **self.of_search())

    def of_search(self) -> dict[str, Any]:
        """The settings of the search, by name."""
        own = {field.name for field in fields(RefineConfig)}
        return {name: value for name, value in asdict(self).items() if name in own}

    def name_of(self, method: str) -> str:
        """The name of an entry: the method, and the settings that differ from the defaults.

        Args:
            method: Name of the search.
        """
        usual = BenchConfig().of_search()
        other = [f"{k}={v}" for k, v in self.of_search().items() if v != usual[k]]
        return " ".join([method, *other])
