"""What every search over a latent code has in common.

A `Refiner` is two pure functions over ONE code. Batch it with one `jax.vmap` and loop it with
`lax.scan`; the candidates of all objects then reach the decoder as one batch:

    def refine(key, code, grid):                       # one object
        def objective(code): ...                       # closes over the grid

        def body(state, key):
            return refiner.step(key, state, objective)

        init_key, loop_key = jax.random.split(key)
        state = refiner.init(init_key, code, objective(code))
        return jax.lax.scan(body, state, jax.random.split(loop_key, iterations))

    states, traces = jax.jit(jax.vmap(refine))(keys, codes, grids)
    states.best.code, states.best.loss, states.mean    # [object, d], [object], [object, d]
    traces.best_loss                                   # [object, iteration]
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

# The loss of one code; a refiner calls it under `jax.vmap` or `jax.grad`.
Objective = Callable[[Float[Array, " d"]], Float[Array, ""]]


class Candidate(NamedTuple):
    """A code together with its loss as it was evaluated."""

    code: Float[Array, " d"]
    loss: Float[Array, ""]


class Trace(NamedTuple):
    """What a reader plots of one iteration: scalars only, so that a long scan stays small."""

    best_loss: Float[Array, ""]  # lowest loss so far, the start included; never rises
    loss: Float[Array, ""]  # lowest finite loss of this iteration's candidates; else +inf
    spread: Float[Array, ""]  # standard deviation of the candidates, rms over the coordinates


class Refiner(NamedTuple):
    """A search over one latent code; every state has `best` (a `Candidate`) and `mean` (a code).

    `init(key, code, loss)` takes the loss of the first code, so that `best` is never worse than
    the start and no iteration spends an evaluation on it. `step(key, state, objective)` is one
    iteration. `mean` is where the search stands: the centre of the distribution it samples, or
    the current iterate of a gradient method, whose loss may not have been evaluated.
    """

    init: Callable[..., Any]  # (key, code, loss) -> state
    step: Callable[..., tuple[Any, Trace]]  # (key, state, objective) -> state, trace


def finite_or_inf(losses: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Losses with NaN and both infinities set to +inf: a failed evaluation ranks last."""
    return jnp.where(jnp.isfinite(losses), losses, jnp.inf)


def keep_better(
    best: Candidate, codes: Float[Array, "n d"], losses: Float[Array, " n"]
) -> Candidate:
    """The best candidate so far; ties and failed evaluations keep the earlier one."""
    losses = finite_or_inf(losses)
    winner = jnp.argmin(losses)
    improved = losses[winner] < best.loss
    return Candidate(
        jnp.where(improved, codes[winner], best.code),
        jnp.where(improved, losses[winner], best.loss),
    )


def summarise(best: Candidate, codes: Float[Array, "n d"], losses: Float[Array, " n"]) -> Trace:
    """The trace of one iteration that evaluated `codes`; `best` includes them already."""
    return Trace(
        best_loss=best.loss,
        loss=jnp.min(finite_or_inf(losses)),
        spread=jnp.sqrt(jnp.mean(jnp.var(codes, axis=0))),
    )
