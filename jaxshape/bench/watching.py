"""Count every evaluation of a search on the side of the problem, not of the search. [host]

A watched objective is the objective itself with one side effect: each evaluation, in a compiled
loop or outside, reports its codes and losses to the observer. A search can thus neither forget an
evaluation nor count one twice, and its own count does not matter. A candidate is one decoder call.
A gradient needs a forward and a backward pass, takes the time of three calls and counts as three.
"""

import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, Float, Int

from jaxshape.search.curvature import Composed

GRADIENT = 3
"""Number of decoder calls that one value with its gradient costs."""


class Improvement(NamedTuple):
    """A code that was better than all earlier ones.

    Attributes:
        calls: Decoder calls spent up to it, itself included; 0 for the first code.
        seconds: Time since the search began.
        loss: Objective of the code, in nats per voxel.
        code: The code `[d]`.
    """

    calls: int
    seconds: float
    loss: float
    code: Float[np.ndarray, " d"]


class Observer:
    """The evaluations of some problems by a search; each problem has the same budget.

    Evaluations after the budget is spent do not count. An improvement does not count, either, if
    its gradient only begins within the budget.

    Attributes:
        budget: Decoder calls that each problem may spend.
        calls: Decoder calls spent on each problem.
        seconds: Time from the start of each problem to its last evaluation, in seconds.
        improvements: The codes of each problem that were better than all earlier ones.
    """

    def __init__(self, budget: int) -> None:
        self.budget = budget
        self.calls: list[int] = []
        self.seconds: list[float] = []
        self.improvements: list[list[Improvement]] = []
        self._clocks: list[tuple[float, float]] = []

    def begin(
        self,
        codes: Float[Array | np.ndarray, "problem d"],
        losses: Float[Array | np.ndarray, " problem"],
    ) -> None:
        """Start counting for problems that are searched together, after compilation.

        Args:
            codes: First codes of the problems `[problem d]`, which cost nothing.
            losses: Their objectives `[problem]`.
        """
        count = len(codes)
        starts = zip(np.asarray(codes), np.asarray(losses).tolist(), strict=True)
        self.calls, self.seconds = [0] * count, [0.0] * count
        self.improvements = [[Improvement(0, 0.0, loss, code)] for code, loss in starts]
        # All problems share the elapsed time evenly.
        self._clocks = [(time.perf_counter(), 1 / count)] * count

    def begin_alone(self, problem: int) -> None:
        """Restart the count of one of these problems at 0; from now on it is searched alone.

        Args:
            problem: Number of the problem.
        """
        self.calls[problem], self.seconds[problem] = 0, 0.0
        self.improvements[problem] = self.improvements[problem][:1]
        self._clocks[problem] = time.perf_counter(), 1.0

    @property
    def spent(self) -> Bool[np.ndarray, " problem"]:
        """Whether the budget of each problem is spent, by the evaluations received so far."""
        return np.array(self.calls) >= self.budget

    def note(self, cost: int, owner: Any, codes: Any, losses: Any) -> None:
        """Count some evaluations; codes that are not finite were not decoded and cost nothing.

        Args:
            cost: Decoder calls that each evaluation costs.
            owner: The problem of each code `[n]`.
            codes: The codes `[n d]`.
            losses: Their objectives `[n]`.
        """
        now, codes = time.perf_counter(), np.asarray(codes)
        decoded = np.flatnonzero(np.isfinite(codes).all(axis=-1))
        owners, values = np.asarray(owner).tolist(), np.asarray(losses).tolist()
        for row in decoded.tolist():
            problem, loss = owners[row], values[row]
            if self.calls[problem] >= self.budget:
                continue
            began, share = self._clocks[problem]
            self.calls[problem] += cost
            self.seconds[problem] = share * (now - began)
            found, calls = self.improvements[problem], self.calls[problem]
            if calls <= self.budget and loss < found[-1].loss:  # NaN is not lower
                better = Improvement(calls, self.seconds[problem], loss, codes[row].copy())
                found.append(better)


def watched(
    objective_of: Callable[[Int[Array, ""]], Any],
    observer: Observer,
    to_code: Callable[[Float[Array, " d"]], Float[Array, " d"]] = lambda point: point,
) -> Callable[[Int[Array, ""]], Any]:
    """Make the objectives of some problems report to an observer.

    Args:
        objective_of: The objective of a problem, by its number. A `Composed` objective stays
            `Composed`, so that a search can expand it to second order.
        observer: The observer that counts every evaluation.
        to_code: Maps a point, which the objectives take, to its code.

    Returns:
        The watched objective of a problem, by its number, to be used under any `jax.vmap`s and
        under `jax.grad`.
    """

    def reported(cost, owner, point, loss):
        return _telling(observer, cost)(owner, to_code(point), loss)

    @jax.custom_vjp
    def loss_of(point, owner):
        return reported(1, owner, point, objective_of(owner)(point))

    def with_slope(point, owner):
        value, slope = jax.value_and_grad(objective_of(owner))(point)
        return reported(GRADIENT, owner, point, value), slope

    loss_of.defvjp(with_slope, lambda slope, ct: (ct * slope, None))

    def watched_of(owner):
        objective = objective_of(owner)

        def loss(point):
            return loss_of(point, owner)

        def expansion(point, directions):
            """Count each product with the matrix as a gradient, which takes the same time."""
            found = objective.expansion(point, directions)
            cost = GRADIENT * (1 + len(found.directions))
            return found._replace(loss=reported(cost, owner, point, found.loss))

        return Composed(loss, expansion) if isinstance(objective, Composed) else loss

    return watched_of


def _telling(observer: Observer, cost: int) -> Callable[..., Float[Array, ""]]:
    """`(owner, code, loss) -> loss`, which reports to the observer; a batch reports in one call."""

    @custom_vmap
    def rows(owner, codes, losses):
        jax.debug.callback(partial(observer.note, cost), owner, codes, losses)
        return losses

    @rows.def_vmap
    def more_rows(size, batched, owner, codes, losses):
        def flat(x, has_axis):
            x = x if has_axis else jnp.broadcast_to(x, (size, *x.shape))
            return x.reshape(-1, *x.shape[2:])

        out = rows(*map(flat, (owner, codes, losses), batched))
        return out.reshape(size, -1), True

    return lambda owner, code, loss: rows(owner[None], code[None], loss[None])[0]


def evaluates_in_a_branch(step: Callable[..., Any], *examples: Any) -> bool:
    """Whether a step evaluates a watched objective in a branch or in a loop of unknown length.

    In a batch, such a loop runs until the last problem has finished, and every branch is taken:
    each problem would pay for the others.

    Args:
        step: One step of one problem.
        examples: Example arguments of the step, for their shapes.
    """
    return any(_has_effects(jax.make_jaxpr(step)(*examples).jaxpr))


def _has_effects(program: Any):
    """For each loop and branch of a program, whether it contains side effects."""
    for equation in program.eqns:
        if equation.primitive.name in ("while", "cond"):
            yield bool(equation.effects)
        for inner in jax.tree.leaves(equation.params, is_leaf=lambda x: hasattr(x, "eqns")):
            inner = getattr(inner, "jaxpr", inner)
            if hasattr(inner, "eqns"):
                yield from _has_effects(inner)
