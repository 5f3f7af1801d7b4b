"""Watch your own loop over problems, so that its result can appear on the board. [host]"""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxshape import checks
from jaxshape.bench.config import BUDGETS, LADDER
from jaxshape.bench.entries import (
    file_name,
    new_entry,
    read_entry,
    require_rows,
    with_rows,
    write_entry,
)
from jaxshape.bench.problems import Problem, objectives, stacked_targets
from jaxshape.bench.scoring import Row, rows_of
from jaxshape.bench.watching import Observer, watched
from jaxshape.search.residuals import Target


@dataclass(frozen=True)
class Watch:
    """The objectives of problems; every evaluation is counted, with its time.

    Attributes:
        problems: The problems, one or more.
        budget: Decoder calls that count, 8 to 2,048 for each problem: a value costs 1, a value with
            its gradient 3.

    Raises:
        ValueError: There is no problem, or the budget is outside its range.
    """

    problems: Sequence[Problem]
    budget: int = BUDGETS[-1]

    def __post_init__(self) -> None:
        if not self.problems:
            checks.refuse("problems", self.problems, "one problem or more")
        checks.whole("budget", self.budget, LADDER[1])
        checks.within("budget", self.budget, LADDER[1], LADDER[-1])
        self.begin()
        _ = self._watched  # makes its arrays now, before anything is traced

    @cached_property
    def _observer(self) -> Observer:
        return Observer(self.budget)

    @cached_property
    def _targets(self) -> Target:
        return stacked_targets(self.problems)

    @cached_property
    def _first(self) -> tuple[Float[Array, "problem d"], Float[np.ndarray, " problem"]]:
        codes = jnp.stack([one.first_code for one in self.problems])
        return codes, np.array([one.first_objective for one in self.problems])

    @cached_property
    def _watched(self) -> Callable[[Int[Array, ""]], Any]:
        return watched(objectives(self.problems[0].decoder, self._targets), self._observer)

    def objective(
        self, code: Float[Array, " d"], number: Int[Array, ""] | int = 0
    ) -> Float[Array, ""]:
        """The objective of a problem, in nats per voxel; each evaluated code is counted.

        Use it under `jax.jit`, `jax.vmap` and `jax.grad`, in any loop.

        Args:
            code: A code `[d]`.
            number: Index of the problem; it may be traced, so that one program serves all problems.
        """
        return self._watched(jnp.asarray(number, jnp.int32))(code)

    def begin(self, number: int | None = None) -> None:
        """Restart the clock and the count at 0, so that compilation does not count.

        Args:
            number: Index of the one problem that is searched from now on; None if all are searched
                together, and then they share the time evenly.
        """
        jax.effects_barrier()
        if number is None:
            self._observer.begin(*self._first)
        else:
            self._observer.begin_alone(number)

    def spent(self, number: int = 0) -> bool:
        """Whether the budget of a problem is spent.

        Args:
            number: Number of the problem.
        """
        jax.effects_barrier()
        return bool(self._observer.spent[number])

    def rows(self, stop: str = "budget") -> dict[str, Row]:
        """The results, for `enter_benchmark`.

        Args:
            stop: Why the searches ended, in a word.

        Returns:
            Results by the names of the problems.
        """
        jax.effects_barrier()
        return rows_of(self.problems, self._observer, [stop] * len(self.problems))


def enter_benchmark(
    folder: str | os.PathLike[str],
    name: str,
    rows: dict[str, Row],
    *,
    settings: dict[str, Any] | None = None,
    budget: int = BUDGETS[-1],
    seed: int = 0,
) -> Path:
    """Write the results of your own loop where `jaxshape bench` finds them. [host]

    Results of other problems that are already in the file are kept.

    Args:
        folder: Folder of the board.
        name: Name of your search on the board.
        rows: Results by the names of the problems (`Watch.rows`).
        settings: Everything that a reader needs to repeat the search, as JSON can hold it.
        budget: The budget that was watched.
        seed: Seed of the searches.

    Returns:
        The file.

    Raises:
        ValueError: There are no rows, they contradict the budget, or the file holds results that
            were made in another way.
    """
    _require_complete(rows, budget)
    path = Path(folder) / file_name(name)
    try:
        entry = new_entry(name, settings=settings, budget=budget, seed=seed)
    except TypeError as problem:
        raise ValueError(
            f"JSON cannot hold the settings, name, budget or seed ({problem})."
        ) from None
    before = read_entry(path) if path.exists() else entry
    if before.about != entry.about:
        raise ValueError(f"{str(path)!r} holds results of other settings; give another name.")
    together = {key: row | {"together": len(rows)} for key, row in rows.items()}
    write_entry(path, with_rows(before, together))
    return path


def _require_complete(rows: dict[str, Row], budget: int) -> None:
    """Refuse rows that would claim another budget than the one that was watched."""
    if not rows:
        raise ValueError("There are no rows; give those of a watch, watch.rows().")
    try:
        require_rows(rows)
    except (ValueError, AttributeError) as problem:
        raise ValueError(
            f"The rows are not those of a watch, watch.rows() ({problem})."
        ) from problem
    for name, row in rows.items():
        if row["stop"] == "budget" and row["calls"] < budget:
            raise ValueError(
                f"The search of {name} stopped at its budget after {row['calls']} decoder calls,"
                f" but budget is {budget}; give the budget of the watch, or say why the search"
                " stopped before: watch.rows(stop='converged')."
            )
